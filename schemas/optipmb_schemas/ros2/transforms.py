"""Transforms between frames over time: what tf2 calls a buffer, as far as poses of sensors need it.

A frame has one parent. Between two stamps the translation is interpolated linearly and the rotation along the shortest
arc; a stamp that was given is answered with the values that were given, to the bit. Nothing is extrapolated.
"""

import bisect
import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optipmb_schemas.errors import invalid

__all__ = ["Transform", "TransformError", "Transforms"]

_NORM: Final = 1e-2
_PARALLEL: Final = 1 - 1e-9
_DEEPEST: Final = 64
"""Frames between a frame and its root; more are a circle."""

Vector = NDArray[np.float64]


class Transform(NamedTuple):
    """Target from source: x_target = R(quaternion) x_source + translation."""

    translation: Vector
    """(3,) m."""
    quaternion: Vector
    """(4,) w x y z, unit."""


class TransformError(Exception):
    """A transform is not known.

    Attributes:
        later: Whether a later message can make it known: the stamp lies ahead of the known ones.
    """

    def __init__(self, text: str, *, later: bool = False) -> None:
        super().__init__(text)
        self.later = later


@dataclass
class _Edge:
    """The transforms of a frame from its parent over time."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    values: list[Transform] = field(default_factory=list)

    def at(self, child: str, stamp_ns: int) -> Transform:
        if self.static:
            return self.values[-1]
        after = bisect.bisect_left(self.stamps, stamp_ns)
        if after < len(self.stamps) and self.stamps[after] == stamp_ns:
            return self.values[after]
        if not self.stamps:
            raise TransformError(f"{self.parent} from {child}: expected a transform, none has come yet", later=True)
        if after in {0, len(self.stamps)}:
            edge, side = (self.stamps[0], "before") if after == 0 else (self.stamps[-1], "after")
            raise TransformError(
                f"{self.parent} from {child}: expected a transform at {stamp_ns} ns, which is "
                f"{abs(stamp_ns - edge) / 1e9:.3f} s {side} the {'first' if after == 0 else 'last'} one",
                later=after > 0,
            )
        low, high = self.stamps[after - 1], self.stamps[after]
        return _between(self.values[after - 1], self.values[after], (stamp_ns - low) / (high - low))


class Transforms:
    """Transforms as they come in, and poses of frames from them.

    Args:
        kept: Most stamps that are kept of each frame; the oldest go first. None: all.
        frames: Most frames.
    """

    def __init__(self, *, kept: int | None = None, frames: int = 10_000) -> None:
        self._kept = kept
        self._most = frames
        self._edges: dict[str, _Edge] = {}

    def __len__(self) -> int:
        return len(self._edges)

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames that are known, ordered by name."""
        return tuple(sorted(set(self._edges) | {edge.parent for edge in self._edges.values()}))

    def add(
        self, parent: str, child: str, stamp_ns: int, translation: Vector, quaternion: Vector, *, static: bool = False
    ) -> None:
        """Add the pose of a frame in its parent.

        A frame with another parent, or static after moving, starts again. An older value of the same stamp is replaced.

        Args:
            parent: the frame that the pose is given in.
            child: the frame whose pose it is.
            stamp_ns: when it holds.
            translation: (3,) m.
            quaternion: (4,) w x y z.
            static: it holds at all times.

        Raises:
            MessageError: the numbers are no pose, a frame has no name or is its own parent, or there are too many.
        """
        parent, child = parent.removeprefix("/"), child.removeprefix("/")
        if not parent or not child or parent == child:
            raise invalid("child_frame_id", "two different frames", f"{parent!r} and {child!r}")
        norm = float(np.linalg.norm(quaternion))
        if not (np.isfinite(translation).all() and abs(norm - 1) <= _NORM):
            raise invalid("transform", "finite numbers and a unit quaternion", f"norm {norm:.6g} of {child!r}")
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.static != static:
            if edge is None and len(self._edges) >= self._most:
                raise invalid("child_frame_id", f"at most {self._most} frames", child)
            edge = self._edges[child] = _Edge(parent, static)
        value = Transform(np.array(translation, dtype=np.float64), np.array(quaternion, dtype=np.float64) / norm)
        if static:
            edge.values = [value]
            return
        at = bisect.bisect_left(edge.stamps, stamp_ns)
        if at < len(edge.stamps) and edge.stamps[at] == stamp_ns:
            edge.values[at] = value
            return
        edge.stamps.insert(at, stamp_ns)
        edge.values.insert(at, value)
        if self._kept is not None and len(edge.stamps) > self._kept:
            del edge.stamps[0], edge.values[0]

    def drop_after(self, stamp_ns: int) -> None:
        """Forget moving transforms after a stamp: the clock has gone back, and they are of another past."""
        for edge in self._edges.values():
            if not edge.static:
                at = bisect.bisect_right(edge.stamps, stamp_ns)
                del edge.stamps[at:], edge.values[at:]

    def has_parent(self, frame: str) -> bool:
        """Return whether the pose of a frame in another one is known at any time."""
        return frame in self._edges

    def root(self, frame: str) -> str:
        """Return the frame that all others above `frame` hang from; itself when it hangs from none.

        Raises:
            TransformError: the frames form a circle.
        """
        return self._chain(frame)[-1]

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """Return the transform that takes points of the frame `source` to the frame `target`.

        Raises:
            TransformError: a frame is not known, the two are not connected, or not at that time.
        """
        known = self.frames
        for frame in (target, source):
            if frame not in known and target != source:
                listed = ", ".join(known[:20]) or "none"
                raise TransformError(f"frame {frame!r}: expected one of the frames in tf ({listed})", later=True)
        up, down = self._chain(source), self._chain(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            text = f"{target} from {source}: expected connected frames, but their roots are {down[-1]} and {up[-1]}"
            raise TransformError(text, later=True)
        result = self._to(common, up, stamp_ns)
        if common == target:
            return result
        return _compose(_inverse(self._to(common, down, stamp_ns)), result)

    def _to(self, ancestor: str, chain: list[str], stamp_ns: int) -> Transform:
        result: Transform | None = None
        for frame in chain[: chain.index(ancestor)]:
            step = self._edges[frame].at(frame, stamp_ns)
            result = step if result is None else _compose(step, result)
        return result if result is not None else Transform(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def _chain(self, frame: str) -> list[str]:
        """Return a frame and those above it."""
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None:
            chain.append(edge.parent)
            if len(chain) > _DEEPEST:
                raise TransformError(f"frame {frame!r}: expected a tree, but the frames above it form a circle")
        return chain


def _compose(first: Transform, second: Transform) -> Transform:
    """Return the transform that applies `second`, then `first`."""
    quaternion = _product(first.quaternion, second.quaternion)
    moved = _turned(first.quaternion, second.translation) + first.translation
    return Transform(moved, quaternion / np.linalg.norm(quaternion))


def _inverse(transform: Transform) -> Transform:
    back = transform.quaternion * np.array([1.0, -1.0, -1.0, -1.0])
    return Transform(-_turned(back, transform.translation), back)


def _product(p: Vector, q: Vector) -> Vector:
    """Return the Hamilton product of two quaternions."""
    scalar = p[0] * q[0] - p[1:] @ q[1:]
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate([[scalar], vector])


def _turned(quaternion: Vector, vector: Vector) -> Vector:
    """Return a vector (3,) turned by a unit quaternion."""
    axis = quaternion[1:]
    twice = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + quaternion[0] * twice + np.cross(axis, twice), dtype=np.float64)


def _between(low: Transform, high: Transform, share: float) -> Transform:
    """Return the transform at a share of the way: straight for translations, along the great arc for rotations."""
    translation = (1 - share) * low.translation + share * high.translation
    cosine = float(low.quaternion @ high.quaternion)
    end = -high.quaternion if cosine < 0 else high.quaternion
    cosine = abs(cosine)
    if cosine > _PARALLEL:
        quaternion = (1 - share) * low.quaternion + share * end
    else:
        angle = math.acos(min(1.0, cosine))
        quaternion = math.sin((1 - share) * angle) * low.quaternion + math.sin(share * angle) * end
    return Transform(translation, quaternion / np.linalg.norm(quaternion))
