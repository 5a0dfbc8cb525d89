"""Callers and their rights: by the name in the certificate, as the routers of a protected network decide.

| name | may |
| --- | --- |
| `site/node` | publish and track its own streams, `site/node/*`, read and command them |
| `service/name` | read and command all streams |
| `viewer/name` | read all streams |

Without certificates and tokens everybody may do everything, as on a network without access control. The certificates of
the gateway are read again when their files have changed, so that they can be renewed.
"""

from __future__ import annotations

import importlib
import inspect
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import grpc
import structlog
from optipmb_client.errors import ClientError

from optipmb_service.grpc.calls import EndCall

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping
    from pathlib import Path

    Tokens = Callable[[Mapping[str, str], str], str | Awaitable[str | None] | None]

ANYBODY: Final = ""
"""Name of a caller where callers have none."""

NODE_CHUNKS: Final = 2

FILES: Final = ("key.pem", "cert.pem", "ca.pem")

log = structlog.get_logger("optipmb_service")


@dataclass(frozen=True)
class Caller:
    """A caller and its rights.

    Attributes:
        name: in the certificate, or of the token; empty: anybody.
    """

    name: str = ANYBODY

    def may_publish(self, stream: str) -> None:
        """Raise EndCall unless the caller may publish a stream."""
        self._check(self.name == ANYBODY or self._owns(stream), f"publish {stream}")

    def may_read(self, pattern: str) -> None:
        """Raise EndCall unless the caller may read all streams of a pattern."""
        self._check(self.name == ANYBODY or bool(self._role) or self._owns(pattern), f"read {pattern}")

    def may_command(self, stream: str) -> None:
        """Raise EndCall unless the caller may reset a stream and set its parameters."""
        self._check(self.name == ANYBODY or self._role == "service" or self._owns(stream), f"command {stream}")

    @property
    def pattern(self) -> str:
        """The widest pattern that the caller may read."""
        return "*/*/*" if self.name == ANYBODY or self._role else f"{self.name}/*"

    @property
    def _role(self) -> str:
        head = self.name.partition("/")[0]
        return head if head in {"viewer", "service"} else ""

    def _owns(self, stream: str) -> bool:
        return not self._role and self.name.count("/") == NODE_CHUNKS - 1 and stream.startswith(f"{self.name}/")

    def _check(self, allowed: bool, what: str) -> None:  # noqa: FBT001 - the one thing that it is given
        if not allowed:
            raise EndCall(grpc.StatusCode.PERMISSION_DENIED, f"{self.name} may not {what}")


class Access:
    """Tells who calls.

    Args:
        certificates: whether callers show one.
        names: a JSON file with a list, the names that are let in; default: all that the authority has certified.
        tokens: `module:function` of one's own, called with the metadata of a call and the name in its certificate (or
            nothing); it returns the name that holds, or None to refuse. It may be a coroutine.

    Raises:
        ClientError: the file or the function cannot be used.
    """

    def __init__(self, *, certificates: bool, names: Path | None = None, tokens: str = "") -> None:
        self._certificates = certificates
        self._names = None if names is None else _names(names)
        self._tokens = _function(tokens) if tokens else None

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
            found = self._tokens(metadata, name)
            token = await found if inspect.isawaitable(found) else found
            if not token:
                raise EndCall(grpc.StatusCode.UNAUTHENTICATED, "the token is missing or not valid")
            name = token
        if (self._certificates or self._tokens is not None) and (
            not name or (self._names is not None and name not in self._names)
        ):
            raise EndCall(grpc.StatusCode.PERMISSION_DENIED, f"{name or 'a certificate without a name'} is not let in")
        return Caller(name)


def _names(file: Path) -> frozenset[str]:
    try:
        names = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ClientError(f"setting grpc_names: {file}: {error}") from error
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ClientError(f"setting grpc_names: {file}: expected a JSON list of names")
    return frozenset(names)


def _function(path: str) -> Tokens:
    module, _, name = path.partition(":")
    try:
        function: Tokens = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ClientError(f"setting grpc_tokens: {path}: {error}") from error
    return function


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
