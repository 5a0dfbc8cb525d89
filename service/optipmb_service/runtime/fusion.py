"""Which streams share one session: the sensors of a node that the setting `fuse` names.

Their session has the name `site/node/fused`, as if it were a stream: its tracks, its queries, its owner and its
checkpoint are found by that. Whoever decides where a stream is tracked decides by `session_of`, so all sensors of a
session come to the same process.
"""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

FUSED: Final = "fused"
"""What stands for the sensor in the name of such a session."""


@dataclass(frozen=True)
class Fusion:
    """The streams that share sessions.

    Attributes:
        patterns: of streams, `site/node/sensor`, each part with `*` for any text.
    """

    patterns: Sequence[str] = ()

    def session_of(self, stream: str) -> str:
        """Return the name of the session that a stream feeds: its own, or that of its node."""
        if not self.patterns:
            return stream
        parts = tuple(stream.split("/"))
        matched = any(_matches(parts, pattern) for pattern in self.patterns)
        return f"{parts[0]}/{parts[1]}/{FUSED}" if matched else stream

    def is_session(self, name: str) -> bool:
        """Whether a name is that of a session of several streams; no sensor may have it."""
        site, node, sensor = name.split("/")
        return sensor == FUSED and any(_matches((site, node), pattern) for pattern in self.patterns)

    def seen_by(self, name: str) -> str:
        """Return the pattern of the streams whose detections belong to the tracks of a session, in Zenoh's words."""
        return f"{name.rpartition('/')[0]}/*" if self.is_session(name) else name


def _matches(parts: tuple[str, ...], pattern: str) -> bool:
    """Whether the first parts of a stream are those of a pattern."""
    return all(fnmatchcase(part, wanted) for part, wanted in zip(parts, pattern.split("/"), strict=False))
