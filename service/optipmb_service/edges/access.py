"""Rights of callers by their names, as the routers of a protected network decide.

| name | may |
| --- | --- |
| `site/node` | publish and track its own streams, `site/node/*`, read and command them; read what `fused` lets it |
| `service/name` | read and command all streams |
| `viewer/name` | read all streams |

The name comes from a certificate or a token. Without both everybody may do everything, as on a network without access
control.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import json
import re
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import structlog
from optipmb_client.errors import ClientError
from optipmb_schemas.errors import show

Tokens = Callable[[Mapping[str, str], str], str | Awaitable[str | None] | None]
"""Returns the name that holds, by the metadata of a call and the name in its certificate; None to refuse."""

ANYBODY: Final = ""
"""Name of a caller where callers have none."""

BEARER: Final = "bearer "
NAME: Final = re.compile(r"[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+")
"""Names that have rights."""

LOOK_S: Final = 5.0
"""Period in which files of tokens, and the tokens of open connections, are looked at again."""

log = structlog.get_logger("optipmb_service")


class NotAllowedError(Exception):
    """The caller may not do this."""


@dataclass(frozen=True)
class Caller:
    """A caller and its rights.

    Attributes:
        name: in the certificate, or of the token; empty: anybody.
        reads: streams that a node may read besides its own.
    """

    name: str = ANYBODY
    reads: frozenset[str] = frozenset()

    def may_publish(self, stream: str) -> None:
        """Raise NotAllowedError unless the caller may publish a stream."""
        self._check(f"publish {stream}", allowed=self.name == ANYBODY or self._owns(stream))

    def may_read(self, pattern: str) -> None:
        """Raise NotAllowedError unless the caller may read all streams of a pattern."""
        self._check(f"read {pattern}", allowed=self.can_read(pattern))

    def can_read(self, pattern: str) -> bool:
        """Return whether the caller may read all streams of a pattern."""
        return self.name == ANYBODY or bool(self._role) or self._owns(pattern) or pattern in self.reads

    def may_command(self, stream: str) -> None:
        """Raise NotAllowedError unless the caller may reset a stream and set its parameters."""
        allowed = self.name == ANYBODY or self._role == "service" or self._owns(stream)
        self._check(f"command {stream}", allowed=allowed)

    @property
    def pattern(self) -> str:
        """The widest pattern that the caller may read."""
        return "*/*/*" if self.name == ANYBODY or self._role else f"{self.name}/*"

    @property
    def _role(self) -> str:
        head = self.name.partition("/")[0]
        return head if head in {"viewer", "service"} else ""

    def _owns(self, stream: str) -> bool:
        return not self._role and NAME.fullmatch(self.name) is not None and stream.startswith(f"{self.name}/")

    def _check(self, what: str, *, allowed: bool) -> None:
        if not allowed:
            raise NotAllowedError(f"{self.name} may not {what}")


def token_names(setting: str, value: str) -> Tokens:
    """Return the function that finds names: `module:function`, or one for a file with the SHA-256 of each token.

    Raises:
        ClientError: the setting cannot be used.
    """
    module, separator, name = value.partition(":")
    if not separator:
        return TokenFile(setting, Path(value))
    try:
        function: Tokens = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ClientError(f"setting {setting}: {value}: {error}") from error
    return function


async def name_by(tokens: Tokens, metadata: Mapping[str, str], certificate: str = "") -> str | None:
    """Return the name of a token; None where it is missing or not valid."""
    found = tokens(metadata, certificate)
    return await found if inspect.isawaitable(found) else found


def json_file(setting: str, file: Path) -> Any:
    """Return the contents of a file.

    Raises:
        ClientError: it cannot be read.
    """
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ClientError(f"setting {setting}: {file}: {error}") from error


class TokenFile:
    """Names by the SHA-256 of tokens, in a JSON file that is read again when it has changed.

    Args:
        setting: that names the file.
        file: its path.

    Raises:
        ClientError: it cannot be used.
    """

    def __init__(self, setting: str, file: Path) -> None:
        self._setting = setting
        self._file = file
        self._changed, self._looked = self._time(), time.monotonic()
        self._names = self._read()
        if not self._names:
            raise ClientError(f"setting {setting}: {file}: expected names by the SHA-256 of tokens, received none")

    def __call__(self, metadata: Mapping[str, str], _certificate: str) -> str | None:
        """Return the name of a token; None without one that is valid."""
        self._renew()
        value = metadata.get("authorization", "")
        token = value[len(BEARER) :] if value.lower().startswith(BEARER) else ""
        return self._names.get(hashlib.sha256(token.encode()).hexdigest())

    def _renew(self) -> None:
        if time.monotonic() - self._looked < LOOK_S:
            return
        self._looked = time.monotonic()
        if (now := self._time()) != self._changed:
            try:
                self._names = self._read()
            except ClientError as error:
                log.warning("tokens_unusable", error=str(error))  # the ones before hold
            self._changed = now

    def _time(self) -> int:
        try:
            return self._file.stat().st_mtime_ns
        except OSError:
            return 0

    def _read(self) -> dict[str, str]:
        names = json_file(self._setting, self._file)
        where = f"setting {self._setting}: {self._file}"
        if not isinstance(names, dict):
            raise ClientError(f"{where}: expected a JSON object of names by the SHA-256 of their tokens")
        for digest, name in names.items():
            if not re.fullmatch("[0-9A-Fa-f]{64}", digest):
                received = show(digest)
                raise ClientError(
                    f"{where}: expected 64 hexadecimal digits, the SHA-256 of a token, received {received}"
                )
            if digest.lower() == hashlib.sha256(b"").hexdigest():
                raise ClientError(f"{where}: expected the SHA-256 of a token, received that of the empty token")
            if not isinstance(name, str) or not NAME.fullmatch(name):
                hint = ", which reads all as viewer/NAME: name it so" if name == "*/*" else ""
                expected = "a node as site/node, viewer/NAME or service/NAME"
                raise ClientError(f"{where}: expected {expected}, received {show(name)}{hint}")
        return {digest.lower(): name for digest, name in names.items()}
