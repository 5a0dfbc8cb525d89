"""State of the joining of tracks (`optipmb.joining.decision`), as arrays."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb.model.rows import Column, Rows, record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Index

PLACES: Final = 13
"""Places of a live track that are kept."""
EMBEDDING: Final = (2, 512)
"""Least and most numbers of a vector of appearance."""
SETTLES_NS: Final = 2 * 10**9
"""Time after the start of a session or of a sensor in which beginnings are of objects that were there before."""
DISTANCES: Final = 26
"""Bins of the distances of vectors of appearance."""


class Tracklets(Rows):
    """Tracks between their first and last detections, world frame, ascending ids; unknown values are NaN.

    Attributes:
        id: (N,) int64.
        label: (N,) int64 class.
        object: (N,) int64 id of the first track of the object; -1: not decided.
        first_ns: (N,) int64 stamp of the first detection.
        last_ns: (N,) int64 of the last.
        detections: (N,) int64 how many; of all tracks of the object.
        confirmed: (N,) bool, whether it ever was.
        probability: (N,) that all joins of the object are right.
        begin: (N, 2) place at the first detection, m.
        end: (N, 2) at the last.
        begin_velocity: (N, 2) over the first second, m/s.
        begin_variance: (N,) of either component.
        end_velocity: (N, 2) over the last second.
        end_variance: (N,).
        yaw: (N,) last heading, rad.
        size: (N, 3) mean logarithms of length, width and height.
        candidate: (N,) int64 earlier object that fitted best when the track was decided; -1: none did.
        candidate_probability: (N,) that it continues an earlier object, at the decision; NaN where none fitted.
    """

    part = "rejoin.tracks"
    __slots__ = ()

    id = Column(np.int64)
    label = Column(np.int64)
    object = Column(np.int64)
    first_ns = Column(np.int64)
    last_ns = Column(np.int64)
    detections = Column(np.int64)
    confirmed = Column(np.bool_)
    probability = Column(np.float64)
    begin = Column(np.float64, 2)
    end = Column(np.float64, 2)
    begin_velocity = Column(np.float64, 2)
    begin_variance = Column(np.float64)
    end_velocity = Column(np.float64, 2)
    end_variance = Column(np.float64)
    yaw = Column(np.float64)
    size = Column(np.float64, 3)
    candidate = Column(np.int64)
    candidate_probability = Column(np.float64)


class Lost(Tracklets):
    """Objects whose last track has ended."""

    part = "rejoin.lost"
    __slots__ = ()


class Places(Rows):
    """The last places of each live track, in turn in `PLACES` slots.

    Attributes:
        count: (N,) int64 how many there were; the next one is in slot `count % PLACES`.
        stamp_ns: (N, `PLACES`) int64.
        place: (N, `PLACES` * 2) m.
    """

    part = "rejoin.places"
    __slots__ = ()

    count = Column(np.int64)
    stamp_ns = Column(np.int64, PLACES)
    place = Column(np.float64, PLACES * 2)


class Beginnings(Rows):
    """Where tracks have begun lately.

    Attributes:
        id: (N,) int64 of the track.
        kind: (N,) int64 first class of its group.
        stamp_ns: (N,) int64 of the first detection.
        place: (N, 2) m.
        new: (N,) probability that it was a new object.
    """

    part = "rejoin.beginnings"
    __slots__ = ()

    id = Column(np.int64)
    kind = Column(np.int64)
    stamp_ns = Column(np.int64)
    place = Column(np.float64, 2)
    new = Column(np.float64)


class Returns(Rows):
    """Beginnings with the tracks that they may continue: where and when objects return that are lost at a place.

    Attributes:
        id: (N,) int64 of the track that began.
        kind: (N,) int64 first class of its group.
        stamp_ns: (N,) int64 of its first detection.
        start: (N, 2) last place of the other, m.
        end: (N, 2) first place of this one.
        seconds: (N,) between.
        speed: (N,) before and behind, m/s, NaN where unknown.
        weight: (N,) probability that it continued the other.
    """

    part = "rejoin.returns"
    __slots__ = ()

    id = Column(np.int64)
    kind = Column(np.int64)
    stamp_ns = Column(np.int64)
    start = Column(np.float64, 2)
    end = Column(np.float64, 2)
    seconds = Column(np.float64)
    speed = Column(np.float64)
    weight = Column(np.float64)


class Ends(Rows):
    """Where objects were lost, and whether they have returned.

    Attributes:
        id: (N,) int64 of the last track.
        kind: (N,) int64 first class of its group.
        stamp_ns: (N,) int64 when that was known.
        place: (N, 2) m.
        returned: (N,) probability that the object has returned; 0 where nothing was joined in time.
    """

    part = "rejoin.ends"
    __slots__ = ()

    id = Column(np.int64)
    kind = Column(np.int64)
    stamp_ns = Column(np.int64)
    place = Column(np.float64, 2)
    returned = Column(np.float64)


class Statistics(Rows):
    """Of each class (C,); the row of its first class holds a group.

    Attributes:
        since_ns: (C,) int64 stamp from which beginnings are counted.
        settled_ns: (C,) int64 stamp before which a beginning is of an object in view when a session or sensor started.
        count: (C, 3) tracks whose length, width and height are known.
        mean: (C, 3) of their logarithms.
        square: (C, 3) sum of squared differences from it.
    """

    part = "rejoin.classes"
    __slots__ = ()

    since_ns = Column(np.int64)
    settled_ns = Column(np.int64)
    count = Column(np.float64, 3)
    mean = Column(np.float64, 3)
    square = Column(np.float64, 3)


@record
class Appearance:
    """Vectors of tracks and lost objects, and counts of their distances in each class (`optipmb.joining.appearance`).

    A vector has E numbers and a zero behind an odd E, W together.

    Attributes:
        model: (2,) int64 hash of the name of the model, and E.
        total: (N, W) float32 a(t) of each live track at its last vector; zero: it has none.
        first: (N, W) float32 the same when it was decided.
        stamp_ns: (N, 3) int64 of the last vector, of `first` and of the last distance that was counted; -1: none.
        lost: (L, W) float32 `total` of each lost object.
        counts: (C, 3, `DISTANCES`) distances of the same object in view, of different ones, and of one over a gap.
    """

    model: Index
    total: NDArray[np.float32]
    first: NDArray[np.float32]
    stamp_ns: Index
    lost: NDArray[np.float32]
    counts: NDArray[np.float64]

    @classmethod
    def shapes(cls, numbers: int, live: int, lost: int, classes: int) -> dict[str, tuple[tuple[int, ...], Any]]:
        """Return shape and type of each array for vectors of so many numbers."""
        width = numbers + numbers % 2
        return {
            "model": ((2,), np.int64),
            "total": ((live, width), np.float32),
            "first": ((live, width), np.float32),
            "stamp_ns": ((live, 3), np.int64),
            "lost": ((lost, width), np.float32),
            "counts": ((classes, 3, DISTANCES), np.float64),
        }

    @classmethod
    def empty(cls, model: int, numbers: int, live: int, lost: int, classes: int) -> Appearance:
        """Return the state before the first vector."""
        made: dict[str, Any] = {
            name: np.zeros(shape, kind) for name, (shape, kind) in cls.shapes(numbers, live, lost, classes).items()
        }
        made["stamp_ns"][:] = -1
        made["model"][:] = model, numbers
        return cls(**made)


@record
class Rejoining:
    """State of the joining of tracks between two frames; `appearance` is None without vectors."""

    live: Tracklets
    places: Places
    lost: Lost
    beginnings: Beginnings
    returns: Returns
    ends: Ends
    classes: Statistics
    appearance: Appearance | None = None

    @classmethod
    def empty(cls, classes: int, stamp_ns: int) -> Rejoining:
        """Return the state before the first frame."""
        none = np.zeros((classes, 3))
        since = np.full(classes, stamp_ns)
        known = Statistics(since_ns=since, settled_ns=since + SETTLES_NS, count=none, mean=none, square=none)
        begun = Beginnings.empty(), Returns.empty(), Ends.empty()
        return cls(Tracklets.empty(), Places.empty(), Lost.empty(), *begun, known)

    def with_sensor(self, stamp_ns: int) -> Rejoining:
        """Return the state before the first frame of another sensor, which sees objects that were there before."""
        settled = np.full(len(self.classes), stamp_ns + SETTLES_NS)
        return replace(self, classes=self.classes.replaced(settled_ns=settled))
