"""The PMB density (eq. PMB) as arrays: a Poisson intensity of undetected objects, a multi-Bernoulli of detected ones.

One row per component, structure of arrays, so that kernels run over contiguous memory and a density can be kept,
compared, hashed and stored as it is. Arrays are never written after the density is made.

Motion state x_M = [x, y, v, phi, omega, a]: position on the ground plane (m), speed along the heading (m/s, negative
when reversing), heading (rad, in (-pi, pi]), turn rate (rad/s), acceleration (m/s^2).
Auxiliary state x_A = [length, width, height, z]: box size and height of the box's centre, m.
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import fields
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np

from optipmb.compiled import kernel
from optipmb.records import INDEX, Columns, record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

X: Final = 0
Y: Final = 1
V: Final = 2
PHI: Final = 3
OMEGA: Final = 4
A: Final = 5
STATE: Final = 6
"""Length of the motion state, and the index of each of its entries."""

NO_FRAME: Final = -1
"""`Density.stamp_ns` before the first frame."""


class _Rows:
    """What Bernoullis and Poissons share: columns of equal length that are filtered together."""

    __slots__ = ()

    def columns(self) -> Iterator[tuple[str, NDArray[np.generic]]]:
        """Yield the name and the array of each column."""
        for field in fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            yield field.name, getattr(self, field.name)

    def take(self, rows: NDArray[np.generic]) -> Self:
        """Return the rows that an index array or a mask selects."""
        return type(self)(**{name: column[rows] for name, column in self.columns()})


@record
class Bernoullis(_Rows):
    """The detected potential objects.

    Attributes:
        mean: (N, 6) posterior mean m of the motion state.
        covariance: (N, 6, 6) posterior covariance P.
        existence: (N,) existence probability r.
        label: (N,) int64 class c, index into the classes of the parameters.
        auxiliary: (N, 4) auxiliary state x_A.
        id: (N,) int64 track id t, unique in the session, ascending.
        born_ns: (N,) int64 stamp of the first detection.
        seen_ns: (N,) int64 stamp of the last detection; x_cnt and x_len are its and born_ns's distance to now.
        score: (N,) confidence score x_s.
        evidence: (N,) mean log odds of the latest detections (`optipmb.calibration`).
        heading_odds: (N,) log odds that the object faces along phi and not the other way (`optipmb.heading`).
        extracted: (N,) bool, whether the track was ever extracted (t in T).
        confirmed: (N,) bool, whether the track was confirmed when it was last extracted (`optipmb.extract`).
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    existence: NDArray[np.float64]
    label: NDArray[np.int64]
    auxiliary: NDArray[np.float64]
    id: NDArray[np.int64]
    born_ns: NDArray[np.int64]
    seen_ns: NDArray[np.int64]
    score: NDArray[np.float64]
    evidence: NDArray[np.float64]
    heading_odds: NDArray[np.float64]
    extracted: NDArray[np.bool_]
    confirmed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.existence)

    @classmethod
    def empty(cls) -> Bernoullis:
        """No objects."""
        return cls(
            mean=np.zeros((0, STATE)),
            covariance=np.zeros((0, STATE, STATE)),
            existence=np.zeros(0),
            label=np.zeros(0, np.int64),
            auxiliary=np.zeros((0, 4)),
            id=np.zeros(0, np.int64),
            born_ns=np.zeros(0, np.int64),
            seen_ns=np.zeros(0, np.int64),
            score=np.zeros(0),
            evidence=np.zeros(0),
            heading_odds=np.zeros(0),
            extracted=np.zeros(0, np.bool_),
            confirmed=np.zeros(0, np.bool_),
        )


def _arrays(rows: type[_Rows], name: str) -> Any:
    names = [field.name for field in fields(rows)]  # type: ignore[arg-type]  # every subclass is a dataclass
    return namedtuple(name, names, module=__name__)  # noqa: PYI024 - the fields are those of rows


@record
class Misses(_Rows):
    """From when the misses of each detected object count, where sensors have fields of view; a row for each.

    Attributes:
        missed_from_ns: (N,) int64 stamp of the last detection, later by the time in which no sensor looked at it.
        looked_ns: (N,) int64 stamp of the last frame with the object in view.
    """

    missed_from_ns: NDArray[np.int64]
    looked_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.looked_ns)

    @classmethod
    def empty(cls) -> Misses:
        """Those of no objects."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64))


@record
class Poissons(_Rows):
    """The Gaussian components of the Poisson intensity of undetected objects (eq. PPP Posterior).

    Attributes:
        mean: (N, 6) m^u.
        covariance: (N, 6, 6) P^u.
        weight: (N,) mu^u, expected number of objects.
        label: (N,) int64 class.
        auxiliary: (N, 4) box of the detection that made the component.
        born_ns: (N,) int64 stamp of that detection, later by the time in which no sensor looked at the component.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    weight: NDArray[np.float64]
    label: NDArray[np.int64]
    auxiliary: NDArray[np.float64]
    born_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.weight)

    @classmethod
    def empty(cls) -> Poissons:
        """No components."""
        return cls.unfilled(np.zeros(0))

    @classmethod
    def unfilled(cls, weight: NDArray[np.float64]) -> Poissons:
        """Components of these weights; what the other columns hold does not matter yet."""
        count = weight.shape[0]
        return cls(
            np.empty((count, STATE)),  # mean
            np.empty((count, STATE, STATE)),  # covariance
            weight,
            np.empty(count, INDEX),  # label
            np.empty((count, 4)),  # auxiliary
            np.empty(count, INDEX),  # born_ns
        )


BernoulliArrays: Final[Any] = _arrays(Bernoullis, "BernoulliArrays")
PoissonArrays: Final[Any] = _arrays(Poissons, "PoissonArrays")
"""The columns of the records by the same names, as kernels know them: they take no dataclass."""

columns_of_objects: Final[Callable[[Bernoullis], Columns]] = attrgetter(*BernoulliArrays._fields)
columns_of_components: Final[Callable[[Poissons], Columns]] = attrgetter(*PoissonArrays._fields)
"""Return the columns as kernels take them."""


@record
class Density:
    """The whole state of a session between two frames.

    Attributes:
        stamp_ns: stamp of the last frame, `NO_FRAME` before the first.
        next_id: the id of the next new track; ids are never reused.
        bernoulli: detected potential objects.
        poisson: undetected potential objects.
        labels: names of the classes that the labels point into, those of the parameters.
        misses: of the detected objects; None while no frame has had a field of view: every frame looks at all of them.
        class_probability: (N, C) posterior of each detected object over the classes (`optipmb.class_posterior`); None
            where the profile has no groups.
    """

    stamp_ns: int
    next_id: int
    bernoulli: Bernoullis
    poisson: Poissons
    labels: tuple[str, ...]
    misses: Misses | None = None
    class_probability: NDArray[np.float64] | None = None

    @property
    def missed_from_ns(self) -> NDArray[np.int64]:
        """Stamps (N,) from which the misses of the objects count; x_cnt is their distance to now."""
        return self.bernoulli.seen_ns if self.misses is None else self.misses.missed_from_ns

    @classmethod
    def empty(cls, labels: tuple[str, ...], next_id: int = 1) -> Density:
        """Return the density before the first frame; `next_id` lets a restarted session go on with fresh ids."""
        return cls(NO_FRAME, next_id, Bernoullis.empty(), Poissons.empty(), labels)


@kernel
def whole_periods(since_ns: int, now_ns: int, period: float) -> int:
    """Count the nominal periods (s) from a stamp to now, to the nearest: step counters for any frame rate."""
    return math.floor((now_ns - since_ns) * 1e-9 / period + 0.5)


@kernel
def copy_state(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    n: int,
    mean_out: NDArray[np.float64],
    covariance_out: NDArray[np.float64],
    k: int,
) -> None:
    """Write the mean and the covariance of row `n` to row `k`: entry by entry, which is four times as fast as rows."""
    for s in range(STATE):
        mean_out[k, s] = mean[n, s]
        for t in range(STATE):
            covariance_out[k, s, t] = covariance[n, s, t]
