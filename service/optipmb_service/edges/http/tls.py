"""Certificate of the HTTP server: new connections have the one that its files hold now."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING, Any, Final

import structlog
from optipmb_client.errors import ClientError

if TYPE_CHECKING:
    from pathlib import Path

FILES: Final = ("key.pem", "cert.pem")

log = structlog.get_logger("optipmb_service")


class ServerCertificate:
    """Key and certificate of a folder, read again when their files have changed.

    Attributes:
        context: for the listener; each connection gets the newest one at its handshake.

    Args:
        folder: with `key.pem` and `cert.pem`.

    Raises:
        ClientError: a file cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            self._changed = self._times()
            self.context = self._newest = self._read()
        except OSError as error:  # `ssl.SSLError` is one
            raise ClientError(f"setting http_tls: {folder}: {error.strerror or error}") from error
        self.context.sni_callback = self._renew

    def _renew(self, connection: Any, _name: str | None, _context: ssl.SSLContext) -> None:
        try:
            if (now := self._times()) != self._changed:
                self._changed = now
                self._newest = self._read()
        except OSError as error:
            log.warning("http_certificates", error=str(error))
        connection.context = self._newest

    def _times(self) -> list[int]:
        return [(self._folder / name).stat().st_mtime_ns for name in FILES]

    def _read(self) -> ssl.SSLContext:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        key, certificate = (self._folder / name for name in FILES)
        context.load_cert_chain(certificate, key)
        return context
