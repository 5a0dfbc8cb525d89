"""Names of callers over gRPC, from certificates or tokens; `edges.access` has their rights.

The certificates of the gateway are read again when their files have changed, so that they can be renewed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import grpc
import structlog
from optipmb_client.errors import ClientError

from optipmb_service.edges.access import ANYBODY, Caller, json_file, name_by, token_names
from optipmb_service.edges.grpc.calls import EndCall

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FILES: Final = ("key.pem", "cert.pem", "ca.pem")

log = structlog.get_logger("optipmb_service")


class Access:
    """Finds the names of callers.

    Args:
        certificates: whether callers show one.
        names: a JSON file with a list, the names that are let in; default: all that the authority has certified.
        tokens: `module:function` of one's own, called with the metadata of a call and the name in its certificate (or
            nothing); it returns the name that holds, or None to refuse. It may be a coroutine.
        reads: returns the streams that a node may read besides its own, by its name.

    Raises:
        ClientError: the file or the function cannot be used.
    """

    def __init__(
        self,
        *,
        reads: Callable[[str], frozenset[str]],
        certificates: bool,
        names: Path | None = None,
        tokens: str = "",
    ) -> None:
        self._certificates = certificates
        self._reads = reads
        self._names = None if names is None else _names(names)
        self._tokens = token_names("grpc_tokens", tokens) if tokens else None

    async def caller(self, context: grpc.aio.ServicerContext[Any, Any]) -> Caller:
        """Return who calls.

        Raises:
            EndCall: they are not let in.
        """
        name = ANYBODY
        if self._certificates:
            name = next(iter(context.auth_context().get("x509_common_name", ())), b"").decode(errors="replace")
        if self._tokens is not None:
            metadata = {key: value for key, value in context.invocation_metadata() or () if isinstance(value, str)}
            token = await name_by(self._tokens, metadata, name)
            if not token:
                raise EndCall(grpc.StatusCode.UNAUTHENTICATED, "the token is missing or not valid")
            name = token
        if (self._certificates or self._tokens is not None) and (
            not name or (self._names is not None and name not in self._names)
        ):
            raise EndCall(grpc.StatusCode.PERMISSION_DENIED, f"{name or 'a certificate without a name'} is not let in")
        return Caller(name, self._reads(name))


def _names(file: Path) -> frozenset[str]:
    names = json_file("grpc_names", file)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ClientError(f"setting grpc_names: {file}: expected a JSON list of names")
    return frozenset(names)


def credentials(folder: Path) -> grpc.ServerCredentials:
    """Return credentials that demand a certificate of the authority from every client.

    Args:
        folder: with `key.pem`, `cert.pem` and `ca.pem`, as `docker/security/make.py` makes it.

    Raises:
        ClientError: a file cannot be read.
    """
    try:
        state = [_changed(folder)]
        first = _configuration(folder)
    except OSError as error:
        raise ClientError(f"setting grpc_tls: {error.filename}: {error.strerror}") from error

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
