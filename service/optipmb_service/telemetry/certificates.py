"""The certificates that a process uses: how long they hold, in metrics and log, and which of them has ended.

A listener of Zenoh has the certificate that its file had at the start. Links of a client, gRPC and NATS read the file
again, so that one that is renewed holds without a restart.
"""

from __future__ import annotations

import asyncio
import ssl
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import structlog
from optipmb_schemas.certificates import end_of, ended

from optipmb_service.units import DAY_S

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

LOOK_S: Final = 5.0  # files are read again after so long
WARN_DAYS: Final = 7.0

log = structlog.get_logger("optipmb_service")


class Certificates:
    """The certificates of one process.

    Args:
        files: certificates by use.
        fixed: the use whose certificate stays the one of the start.
    """

    def __init__(self, files: Mapping[str, Path], fixed: str) -> None:
        self._files = files
        self._fixed = fixed
        self._ends: dict[str, datetime] = {}
        self._unusable: dict[str, str] = {}
        """Why files cannot be used, by use; the certificates before are served."""
        self._looked = -LOOK_S
        self._look()

    def days(self) -> dict[str, float]:
        """Return how many days each certificate that is served still holds, by its use."""
        now = datetime.now(UTC)
        return {use: (end - now).total_seconds() / DAY_S for use, end in self._look().items()}

    @property
    def failure(self) -> str:
        """Which certificates have ended, or cannot be used; empty while all hold."""
        return "; ".join([*self._ended(), *self._unusable.values()])

    @property
    def cut_off(self) -> bool:
        """Whether one of Zenoh's has ended: there is no link to the network."""
        return any("zenoh" in use for use in self._ended().values())

    async def watch(self) -> None:
        """Log certificates that end soon once a day, and each that has ended, for ever."""
        warned = -DAY_S
        told: set[str] = set()
        while True:
            now_ended, unusable = self._ended(), set(self._unusable.values())
            for why in now_ended.keys() - told:
                log.error("certificate_ended", error=why)
            for why in unusable - told:
                log.error("certificate_unusable", error=why)
            told = now_ended.keys() | unusable
            soon = {use: round(days, 1) for use, days in self.days().items() if 0 < days < WARN_DAYS}
            if soon and time.monotonic() - warned >= DAY_S:
                warned = time.monotonic()
                log.warning("certificate_ends", days=soon)
            await asyncio.sleep(LOOK_S)

    def _ended(self) -> dict[str, str]:
        """Return one line for each certificate that has ended, with its use."""
        return {why: use for use, end in self._look().items() if (why := ended(self._files[use], end))}

    def _look(self) -> dict[str, datetime]:
        if (now := time.monotonic()) - self._looked >= LOOK_S:
            found = {use: end for use, file in self._files.items() if (end := end_of(file)) is not None}
            self._unusable = {use: why for use, file in self._files.items() if (why := _unusable(file))}
            kept = {use: end for use, end in self._ends.items() if use == self._fixed or use in self._unusable}
            self._ends, self._looked = found | kept, now
        return self._ends


def _unusable(file: Path) -> str:
    """Return why a certificate does not fit the key beside it; empty where it does, or where there is none."""
    key = file.with_name("key.pem")
    if file.name != "cert.pem" or not key.exists():
        return ""
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(file, key, password="")
    except OSError as error:  # `ssl.SSLError` is one
        return f"TLS: {file} does not fit {key.name}, so the one before is served: {error.strerror or error}"
    return ""
