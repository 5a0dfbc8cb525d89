"""Asks a running service how it is, as container engines do: one question, one answer, a few seconds at most."""

from __future__ import annotations

import http.client
from typing import Final

TIMEOUT_S: Final = 3.0

EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104 - what a service may listen on, not us


def ask(address: str, *, ready: bool) -> tuple[bool, str]:
    """Ask at an address, as the setting `http` has it.

    Args:
        address: `host:port`; a host that means all interfaces is asked on the loopback.
        ready: ask whether it can be used; otherwise whether it is alive.

    Returns:
        Whether it said yes, and what it said, one line.
    """
    host, _, port = address.rpartition(":")
    connection = http.client.HTTPConnection(EVERYWHERE.get(host, host).strip("[]"), int(port), timeout=TIMEOUT_S)
    try:
        connection.request("GET", "/readyz" if ready else "/healthz")
        response = connection.getresponse()
        return response.status == http.client.OK, response.read().decode(errors="replace")
    except (OSError, http.client.HTTPException) as error:
        return False, f"no answer at {address}: {error}"
    finally:
        connection.close()
