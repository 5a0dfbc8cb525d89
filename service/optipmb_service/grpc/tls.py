"""The certificates of the gateway: read again when their files have changed, so that they can be renewed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import grpc
import structlog

from optipmb_service.runtime.ports import EdgeError

if TYPE_CHECKING:
    from pathlib import Path

FILES: Final = ("key.pem", "cert.pem", "ca.pem")

log = structlog.get_logger("optipmb_service")


def credentials(folder: Path) -> grpc.ServerCredentials:
    """Return credentials that demand a certificate of the authority from every client.

    Args:
        folder: with `key.pem`, `cert.pem` and `ca.pem`, as `docker/security/make.py` makes it.

    Raises:
        EdgeError: a file cannot be read.
    """
    try:
        state = [_changed(folder)]
        first = _configuration(folder)
    except OSError as error:
        raise EdgeError(f"setting grpc_tls: {error.filename}: {error.strerror}") from error

    def renewed() -> Any:  # the stubs do not know that it may be None
        try:
            if (now := _changed(folder)) == state[0]:
                return None
            fresh = _configuration(folder)
        except OSError as error:
            log.warning("grpc_certificates", error=str(error))
            return None
        state[0] = now
        return fresh

    return grpc.dynamic_ssl_server_credentials(first, renewed, require_client_authentication=True)


def _changed(folder: Path) -> tuple[int, ...]:
    return tuple((folder / name).stat().st_mtime_ns for name in FILES)


def _configuration(folder: Path) -> grpc.ServerCertificateConfiguration:
    key, certificate, authority = ((folder / name).read_bytes() for name in FILES)
    return grpc.ssl_server_certificate_configuration([(key, certificate)], root_certificates=authority)
