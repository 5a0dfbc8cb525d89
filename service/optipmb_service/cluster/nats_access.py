"""How NATS servers know this service, and it them: certificates, and a user's name, token or credentials."""

from __future__ import annotations

import base64
import binascii
import re
import ssl
from typing import TYPE_CHECKING, Any, Final

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from nats.aio.client import Client
from nats.errors import Error as NatsError

from optipmb_service.cluster.store import StoreError

if TYPE_CHECKING:
    from pathlib import Path

    from nats.aio.client import Srv

CA: Final = "ca.pem"
CERTIFICATE: Final = "cert.pem"
KEY: Final = "key.pem"

_JWT: Final = re.compile(r"-+BEGIN NATS USER JWT-+\s+(\S+)\s+-+END")
_SEED: Final = re.compile(r"-+BEGIN USER NKEY SEED-+\s+(\S+)\s+-+END")
_SEED_BYTES: Final = 36
"""Of a user's seed: two that say what it is, the seed, a checksum."""


class NatsAccess:
    """What opens a connection to servers that do not let everybody in.

    Args:
        tls: folder with the authority of the servers and, where they ask for one, the certificate of this service.
            None: the authorities of the system.
        credentials: file with a user's JWT and seed, as NATS' tools write it; or with one line, `user:password` or a
            token. None: what the addresses say.
    """

    def __init__(self, tls: Path | None = None, credentials: Path | None = None) -> None:
        self._tls = tls
        self._credentials = credentials

    def options(self) -> dict[str, Any]:
        """Return the options of NATS' client.

        Raises:
            StoreError: a file cannot be read, or holds something else.
        """
        options: dict[str, Any] = {}
        if self._tls is not None:
            try:
                options["tls"] = _context(self._tls)
            except OSError as error:  # also one of its contents
                raise StoreError(f"cluster_tls: {self._tls}: {error}") from error
        if self._credentials is not None:
            try:
                options |= _user(self._credentials)
            except (OSError, ValueError) as error:
                raise StoreError(f"cluster_credentials: {self._credentials}: {error}") from error
        return options


class SecuredClient(Client):
    """NATS' client, but one that says nothing to a server without TLS where the address wants it.

    A server tells in the clear whether it wants TLS, and whoever stands in between could leave that out: the client
    would go on without, and send the password.

    It also closes a connection that a server ended before it had greeted the client, before it tries the next one.
    """

    async def _connect_to_server(self, s: Srv) -> None:
        if self._transport is not None:
            self._transport.close()  # type: ignore[no-untyped-call]  # NATS' client annotates no `close`
        await super()._connect_to_server(s)

    def _connect_command(self) -> bytes:
        server = self._current_server
        if server is not None and server.uri.scheme == "tls" and not self._server_info.get("tls_required"):
            raise NatsError("tls:// and the server offers no TLS")
        return super()._connect_command()


def _context(folder: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(folder / CA))
    if (folder / CERTIFICATE).exists():
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    return context


def _user(file: Path) -> dict[str, Any]:
    text = file.read_text(encoding="utf-8")
    if _JWT.search(text):
        _read(file)  # fails now rather than at every try to connect
        return {
            "user_jwt_cb": lambda: bytearray(_read(file)[0].encode()),
            "signature_cb": lambda nonce: base64.b64encode(_read(file)[1].sign(nonce.encode())),
        }
    lines = text.split()
    if len(lines) != 1:
        raise ValueError("expected a NATS user's JWT and seed, or one line: user:password, or a token")
    user, colon, password = lines[0].partition(":")
    return {"user": user, "password": password} if colon else {"token": lines[0]}


def _read(file: Path) -> tuple[str, Ed25519PrivateKey]:
    """Return the JWT of a user and the key that signs for it; read each time, so that a new file holds at once."""
    text = file.read_text(encoding="utf-8")
    jwt, seed = _JWT.search(text), _SEED.search(text)
    if jwt is None or seed is None:
        raise ValueError("expected a NATS user's JWT and seed")
    try:
        raw = base64.b32decode(seed[1] + "=" * (-len(seed[1]) % 8))
    except binascii.Error as error:
        raise ValueError("the seed is not written in base 32") from error
    if len(raw) != _SEED_BYTES:
        raise ValueError("the seed has another length")
    return jwt[1], Ed25519PrivateKey.from_private_bytes(raw[2:34])
