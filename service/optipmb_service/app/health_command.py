"""`optipmb-service health` asks a running service how it is, as container engines do.

One question, one answer, a few seconds at most. It loads nothing of the service unless a settings file is given.
"""

from __future__ import annotations

import argparse
import http.client
import os
import ssl
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

TIMEOUT_S: Final = 3.0

EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104 - what a service may listen on, not us


def ask(address: str, *, ready: bool, certificate: Path | None = None) -> tuple[bool, str]:
    """Ask at an address, as the setting `http` has it.

    Args:
        address: `host:port`; a host that means all interfaces is asked on the loopback.
        ready: ask whether it can be used; otherwise whether it is alive.
        certificate: folder of the setting `http_tls`, whose certificate is to answer.

    Returns:
        Whether the answer is yes, and its text, one line.
    """
    host, _, port = address.rpartition(":")
    place = EVERYWHERE.get(host, host).strip("[]"), int(port)
    connection = http.client.HTTPConnection(*place, timeout=TIMEOUT_S)
    try:
        if certificate is not None:
            context = ssl.create_default_context(cafile=str(certificate / "cert.pem"))
            context.check_hostname = False  # it is this very certificate that is asked for, under any name
            context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
            connection = http.client.HTTPSConnection(*place, timeout=TIMEOUT_S, context=context)
        connection.request("GET", "/readyz" if ready else "/healthz")
        response = connection.getresponse()
        return response.status == http.client.OK, response.read().decode(errors="replace")
    except (OSError, http.client.HTTPException) as error:
        return False, f"no answer at {address}: {error}"
    finally:
        connection.close()


def main(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit status: 0 when the service is well, 1 when not, 2 for a wrong use."""
    parser = argparse.ArgumentParser(
        prog="optipmb-service health",
        description="Ask a running service, or router, whether it is alive. Status 0: yes, 1: no.",
    )
    parser.add_argument("--http", metavar="ADDRESS", help="where it answers; default: OPTIPMB_HTTP, or the settings")
    parser.add_argument("--settings", metavar="FILE", type=Path, help="settings of the service, a TOML file")
    parser.add_argument("--ready", action="store_true", help="ask whether it can be used, not only alive")
    given = parser.parse_args(arguments)
    try:
        address, certificate = _address(given.http, given.settings)
    except ValueError as error:
        print(f"optipmb-service: {error}", file=sys.stderr)  # noqa: T201 - the one line of a wrong use
        return 2
    well, text = ask(address, ready=given.ready, certificate=certificate)
    print(text)  # noqa: T201 - the answer
    return 0 if well else 1


def _address(option: str | None, file: Path | None) -> tuple[str, Path | None]:
    """Return where to ask, and the folder of its certificate.

    Raises:
        ValueError: nothing says where.
    """
    address, folder = option or os.environ.get("OPTIPMB_HTTP", ""), os.environ.get("OPTIPMB_HTTP_TLS", "")
    certificate = Path(folder) if folder else None
    if file is not None and not (address and certificate):
        from optipmb_service.app.configuration import load  # noqa: PLC0415 - only this needs the libraries behind it

        settings = load(file).settings
        address, certificate = address or settings.http, settings.http_tls
    if not address.rpartition(":")[2].isdecimal():
        raise ValueError(f"setting http: expected where to ask, as 127.0.0.1:8080, received {address!r}")
    return address, certificate
