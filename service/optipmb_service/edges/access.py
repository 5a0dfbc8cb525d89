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
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from optipmb_client.errors import ClientError

Tokens = Callable[[Mapping[str, str], str], str | Awaitable[str | None] | None]
"""Returns the name that holds, by the metadata of a call and the name in its certificate; None to refuse."""

ANYBODY: Final = ""
"""Name of a caller where callers have none."""

NODE_CHUNKS: Final = 2
BEARER: Final = "bearer "


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
        self._check(self.name == ANYBODY or self._owns(stream), f"publish {stream}")

    def may_read(self, pattern: str) -> None:
        """Raise NotAllowedError unless the caller may read all streams of a pattern."""
        own = self._owns(pattern) or pattern in self.reads
        self._check(self.name == ANYBODY or bool(self._role) or own, f"read {pattern}")

    def may_command(self, stream: str) -> None:
        """Raise NotAllowedError unless the caller may reset a stream and set its parameters."""
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
            raise NotAllowedError(f"{self.name} may not {what}")


def token_names(setting: str, value: str) -> Tokens:
    """Return the function that finds names: `module:function`, or one for a file with the SHA-256 of each token.

    Raises:
        ClientError: the setting cannot be used.
    """
    module, separator, name = value.partition(":")
    if not separator:
        return _file(setting, Path(value))
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


def _file(setting: str, file: Path) -> Tokens:
    names = json_file(setting, file)
    if not isinstance(names, dict) or not all(isinstance(name, str) and name for name in names.values()):
        raise ClientError(f"setting {setting}: {file}: expected a JSON object of names by the SHA-256 of their tokens")

    def name_of(metadata: Mapping[str, str], _certificate: str) -> str | None:
        value = metadata.get("authorization", "")
        token = value[len(BEARER) :] if value.lower().startswith(BEARER) else ""
        found: str | None = names.get(hashlib.sha256(token.encode()).hexdigest())
        return found

    return name_of
