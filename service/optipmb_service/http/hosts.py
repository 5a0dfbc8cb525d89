"""Answers only those who ask by a name that is this service's.

A browser that was led to a page of a stranger can be made to ask a service of its own network: the stranger lets his
name point to its address (DNS rebinding). Such a request carries the stranger's name. Addresses, names without a dot
(`localhost`, a container, a host of the same network) and the names of the settings are answered, others are not.
Probes and Prometheus ask by names with a domain (`tracker.site.svc.cluster.local`): their paths, which show no tracks,
are answered under any name.
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse

from optipmb_service.http.app import MONITORING

if TYPE_CHECKING:
    from collections.abc import Collection

    from starlette.types import ASGIApp, Receive, Scope, Send

MISDIRECTED = 421
ANY = "*"


class KnownHosts:
    """An application behind a check of the `Host` of every request.

    Args:
        application: what answers.
        names: names that are this service's beside addresses and names without a dot; `*`: any.
    """

    def __init__(self, application: ASGIApp, names: Collection[str] = ()) -> None:
        self._application = application
        self._names = {name.lower().rstrip(".") for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        named = scope["type"] == "http" and scope["path"] not in MONITORING
        if named and not self._knows(Headers(scope=scope).get("host", "")):
            refusal = PlainTextResponse("unknown host; see the setting http_hosts", status_code=MISDIRECTED)
            await refusal(scope, receive, send)
            return
        await self._application(scope, receive, send)

    def _knows(self, host: str) -> bool:
        name = host.lower()
        name = name[1:].partition("]")[0] if name.startswith("[") else name.partition(":")[0]
        name = name.rstrip(".")
        if ANY in self._names or name in self._names or "." not in name:
            return bool(name) or ANY in self._names
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True
