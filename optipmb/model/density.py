"""The PMB density (eq. PMB) as arrays: a Poisson intensity of undetected objects, a multi-Bernoulli of detected ones.

One row per component, structure of arrays, so that kernels run over contiguous memory and a density can be kept,
compared, hashed and stored as it is. It is never written after it is made.

Motion state x_M = [x, y, v, phi, omega, a]: position on the ground plane (m), speed along the heading (m/s, negative
when reversing), heading (rad, in (-pi, pi]), turn rate (rad/s), acceleration (m/s^2).
Auxiliary state x_A = [length, width, height, z]: box size and height of the box's centre, m; NaN where no detection
gave it. `optipmb.filter.unknown_heading` describes states without a heading.

It is stored as named arrays (`bernoulli.mean`, `poisson.weight`) or as bytes, and checked when it is read back.
"""

from __future__ import annotations

import math
from dataclasses import replace
from math import prod
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.attributes import Attributes
from optipmb.model.errors import DensityError
from optipmb.model.lost_objects import (
    EMBEDDING,
    Appearance,
    Beginnings,
    Ends,
    Lost,
    Places,
    Rejoining,
    Returns,
    Statistics,
    Tracklets,
)
from optipmb.model.rows import FLOAT, INDEX, Column, Rows, arrays_of, record, shown, views_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from optipmb.model.rows import Array, Index


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


class Moment(NamedTuple):
    """The time of a frame.

    Attributes:
        stamp_ns: its stamp.
        before_ns: stamp of the frame before, `NO_FRAME` before the first.
        dt: s since then; the nominal period at the first.
        period: nominal period, s.
    """

    stamp_ns: int
    before_ns: int
    dt: float
    period: float


FROM_LAST_DETECTION: Final = np.zeros(0, np.int64)
"""In place of stamps from which misses count, where every frame looks at all objects."""


class Bernoullis(Rows):
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
        evidence: (N,) mean log odds of the latest detections (`optipmb.filter.calibration`).
        heading_odds: (N,) log odds that the object faces along phi and not the other way
        (`optipmb.filter.lightweight`). hits: (N,) number of frames that detected it.
        looks: (N,) number of frames that had it in view, since the first detection; parts of it count in part.
        extracted: (N,) bool, whether the track was ever extracted (t in T).
        confirmed: (N,) bool, whether the track was confirmed when it was last extracted (`optipmb.filter.extract`).
    """

    part = "bernoulli"
    __slots__ = ()

    mean = Column(np.float64, STATE)
    covariance = Column(np.float64, STATE, STATE)
    existence = Column(np.float64)
    label = Column(np.int64)
    auxiliary = Column(np.float64, 4)
    id = Column(np.int64)
    born_ns = Column(np.int64)
    seen_ns = Column(np.int64)
    score = Column(np.float64)
    evidence = Column(np.float64)
    heading_odds = Column(np.float64)
    hits = Column(np.float64)
    looks = Column(np.float64)
    extracted = Column(np.bool_)
    confirmed = Column(np.bool_)


class Misses(Rows):
    """From when the misses of each detected object count, where sensors have fields of view; a row for each.

    Attributes:
        missed_from_ns: (N,) int64 stamp of the last detection, later by the time in which no sensor looked at it.
        looked_ns: (N,) int64 stamp of the last frame with the object in view.
    """

    part = "misses"
    __slots__ = ()

    missed_from_ns = Column(np.int64)
    looked_ns = Column(np.int64)


class Poissons(Rows):
    """The Gaussian components of the Poisson intensity of undetected objects (eq. PPP Posterior).

    Attributes:
        mean: (N, 6) m^u.
        covariance: (N, 6, 6) P^u.
        weight: (N,) mu^u, expected number of objects.
        label: (N,) int64 class.
        auxiliary: (N, 4) box of the detection that made the component.
        born_ns: (N,) int64 stamp of that detection, later by the time in which no sensor looked at the component.
    """

    part = "poisson"
    __slots__ = ()

    mean = Column(np.float64, STATE)
    covariance = Column(np.float64, STATE, STATE)
    weight = Column(np.float64)
    label = Column(np.int64)
    auxiliary = Column(np.float64, 4)
    born_ns = Column(np.int64)


# Kernels take no records but their arrays, and named tuples of the columns inside them.
OBJECT: Final = Bernoullis.width
COMPONENT: Final = Poissons.width
BernoulliArrays: Final = arrays_of(Bernoullis, "BernoulliArrays", __name__)
PoissonArrays: Final = arrays_of(Poissons, "PoissonArrays", __name__)
objects_in: Final = views_of(Bernoullis, BernoulliArrays, "objects_in", __file__)
components_in: Final = views_of(Poissons, PoissonArrays, "components_in", __file__)


@kernel
def misses_counted_from(objects: Bernoullis, missed_from_ns: Index) -> Index:
    """Return the stamps (N,) from which the misses of objects count; x_cnt is their distance to now.

    Args:
        objects: the columns of the objects.
        missed_from_ns: `Density.missed_from_ns`.
    """
    return missed_from_ns if missed_from_ns.shape[0] > 0 else objects.seen_ns


BINS: Final = 26
COUNTS: Final = 6
SLOTS: Final = 3
SLOT: Final = BINS + 2
SCATTER: Final = 3
AXES: Final = 2
"""Shapes of `SelfCalibration`; a slot has looks and ticks of 0.1 ms behind the bins."""
NO_BIN: Final = -1
OF_SLOTS: Final = np.dtype(np.uint16)
"""Type of the counts of slots."""


ENOUGH: Final = 3.0
"""Evidence for a motion of the sensor from which it is used, and"""
LEAST_MOVED_S: Final = 0.25
"""the time over which it has to be found before, s."""
PROVEN: Final = ENOUGH + 2.0
"""Evidence, with a unit for each second of motion, from which a sensor is known to be on a vehicle."""


@record
class SelfCalibration:
    """Counts of the detections of a stream by score, and how they scatter about tracks.

    Attributes:
        classes: (C, `COUNTS`, `BINS`) of the classes.
        objects: (N, `SLOTS`, `SLOT`) uint16 of each detected object: detections by bin, looks and ticks of its slots,
            the oldest first.
        scatter: (C, `SCATTER`) of the classes: pairs of a sure track and its detection, and the sums of the squared
            scatter of those detections along and across the heading, m^2.
        innovations: (N, 2) last innovation of each detected object along and across its heading, m; zero where it was
            missed.
        lagged: (C, 2) of the classes: sums of the products of innovations and those before along and across, negated
            and without the gain, m^2.
        components: (J,) int64 bin of the detection of each Poisson component, `NO_BIN` where it is not known.
    """

    classes: Array
    objects: NDArray[np.uint16]
    components: Index
    scatter: Array
    innovations: Array
    lagged: Array

    @classmethod
    def of(cls, density: Density) -> SelfCalibration:
        """Return the counts of a density; without any, those before the first frame."""
        if density.self_calibration is not None:
            return density.self_calibration
        return cls(
            np.zeros((len(density.labels), COUNTS, BINS)),
            np.zeros((len(density.bernoulli), SLOTS, SLOT), np.uint16),
            np.full(len(density.poisson), NO_BIN, np.int64),
            np.zeros((len(density.labels), SCATTER)),
            np.zeros((len(density.bernoulli), AXES)),
            np.zeros((len(density.labels), AXES)),
        )


@record
class Density:
    """The whole state of a session between two frames.

    Attributes:
        stamp_ns: stamp of the last frame, `NO_FRAME` before the first.
        next_id: the id of the next new track; ids are never reused.
        bernoulli: detected potential objects.
        poisson: undetected potential objects.
        labels: names of the classes of the parameters, which the labels point into.
        misses: of the detected objects; None while no frame has had a field of view: every frame looks at all of them.
        class_probability: (N, C) posterior of each detected object over the classes (`optipmb.filter.class_posterior`);
            None where the profile has no groups.
        self_calibration: counts of scores; None where the profile does not calibrate them itself.
        sensor: (5,) velocity, m/s, and turn rate, rad/s, with which what stands passes a sensor without poses, the
            evidence that it moves so, and the time over which that was found, s (`optipmb.learning.sensor_motion`);
            None where it is not known to be on a vehicle or frames have poses.
        rejoining: lost objects and what else joining needs; None where tracks are not joined.
        attributes: texts of the objects, also of lost ones; None where no detection has brought any.
    """

    stamp_ns: int
    next_id: int
    bernoulli: Bernoullis
    poisson: Poissons
    labels: tuple[str, ...]
    misses: Misses | None = None
    class_probability: Array | None = None
    self_calibration: SelfCalibration | None = None
    sensor: Array | None = None
    rejoining: Rejoining | None = None
    attributes: Attributes | None = None

    @property
    def sensor_motion(self) -> Array | None:
        """Velocity, m/s, and turn rate, rad/s, (3,) of `sensor`; None where the evidence is not enough to use them."""
        sensor = self.sensor
        if sensor is None or sensor[3] < ENOUGH or sensor[4] < LEAST_MOVED_S:
            return None
        return sensor[:3]

    @property
    def on_vehicle(self) -> bool:
        """Tell whether the sensor moved for so long, without poses, that it is known to be on a vehicle."""
        return self.sensor is not None and bool(self.sensor[3] >= PROVEN)

    @property
    def missed_from_ns(self) -> Index:
        """Stamps (N,) from which the misses of the objects count; (0,) where that is their last detection."""
        return FROM_LAST_DETECTION if self.misses is None else self.misses.missed_from_ns

    @classmethod
    def empty(cls, labels: tuple[str, ...], next_id: int = 1) -> Density:
        """Return the density before the first frame; `next_id` lets a restarted session go on with fresh ids."""
        return cls(NO_FRAME, next_id, Bernoullis.empty(), Poissons.empty(), labels)


@kernel
def whole_periods(since_ns: int, now_ns: int, period: float) -> int:
    """Count the nominal periods (s) from a stamp to now, to the nearest: step counters for any frame rate."""
    return math.floor((now_ns - since_ns) * 1e-9 / period + 0.5)


@kernel
def copy_state(mean: Array, covariance: Array, n: int, mean_out: Array, covariance_out: Array, k: int) -> None:
    """Write the mean and the covariance of row `n` to row `k`: entry by entry, which is four times as fast as rows."""
    for s in range(STATE):
        mean_out[k, s] = mean[n, s]
        for t in range(STATE):
            covariance_out[k, s, t] = covariance[n, s, t]


CLASSES: Final = "classes.probability"
"""Name of `Density.class_probability` among the columns."""

COUNTED: Final = "calibration"
"""Part of the names of `Density.self_calibration` among the columns."""

SENSOR: Final = "sensor"
"""Name of `Density.sensor` among the columns."""

MOST_COUNTED: Final = 1e9
"""Bound of stored counts of scores and of the sensor's motion, far above all that the tracker makes."""

JOINING: Final = (Tracklets, Places, Lost, Beginnings, Returns, Ends, Statistics)
"""Records of `Density.rejoining`, in the order of its fields."""

APPEARANCE: Final = "rejoin.appearance"
"""Part of the names of `Rejoining.appearance` among the columns."""

ROUNDING: Final = 1e-6
"""By how much the sum of probabilities may differ from 1."""

_Rows = TypeVar("_Rows", bound=Rows)


@kernel
def labels_within(object_words: Array, component_words: Array, classes: int) -> bool:
    """Tell whether the labels of the arrays of `Bernoullis` and `Poissons` are below a number of classes."""
    good = True
    for c in objects_in(object_words).label:
        good &= 0 <= c < classes
    for c in components_in(component_words).label:
        good &= 0 <= c < classes
    return bool(good)


def fits(density: Density, classes: int) -> bool:
    """Tell whether the parts of a density have the shapes that they need; labels are not looked at."""
    misses, count, own = density.misses, len(density.bernoulli), density.self_calibration
    if misses is not None and len(misses) != count:
        return False
    arrays: list[tuple[object, tuple[int, ...], np.dtype[Any]]]
    arrays = [(density.class_probability, (count, classes), FLOAT), (density.sensor, (5,), FLOAT)]
    if own is not None:
        shapes = _shapes(classes, count, len(density.poisson))
        arrays += [(getattr(own, name), *shape_and_kind) for name, shape_and_kind in shapes.items()]
    for array, shape, kind in arrays:
        if array is not None and not (isinstance(array, np.ndarray) and array.shape == shape and array.dtype == kind):
            return False
    return True


def check_fitting(density: Density, labels: tuple[str, ...]) -> None:
    """Refuse a density whose parts do not fit together, for which kernels would read beyond its arrays.

    `density_of` and the tracker make fitting ones; one that a caller assembled or wrote to may not fit.

    Raises:
        DensityError: names the column, the expected content and the content found.
    """
    if fits(density, len(labels)) and labels_within(density.bernoulli.words, density.poisson.words, len(labels)):
        return
    columns = columns_of(density)
    density_of(density.stamp_ns, density.next_id, columns, labels)  # names the column
    lengths = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
    raise DensityError("density", "columns of equal length", lengths)


def columns_of(density: Density) -> dict[str, NDArray[Any]]:
    """Return the arrays of a density by name, always in the same order."""
    columns = {f"{rows.part}.{name}": column for rows in _records(density) for name, column in rows.columns()}
    return columns | _others(density)


def _records(density: Density) -> list[Rows]:
    own = density.rejoining
    joining: tuple[Rows, ...] = ()
    if own is not None:
        joining = own.live, own.places, own.lost, own.beginnings, own.returns, own.ends, own.classes
    records = density.bernoulli, density.poisson, density.misses, *joining, density.attributes
    return [rows for rows in records if rows is not None]


def _others(density: Density) -> dict[str, NDArray[Any]]:
    """Return the arrays that are in no record, by name."""
    own = density.self_calibration
    counts = {} if own is None else {f"{COUNTED}.{name}": getattr(own, name) for name in _shapes(0, 0, 0)}
    look = None if density.rejoining is None else density.rejoining.appearance
    looks = {} if look is None else {f"{APPEARANCE}.{name}": getattr(look, name) for name in look.shapes(0, 0, 0, 0)}
    others = {CLASSES: density.class_probability, **counts, SENSOR: density.sensor, **looks}
    return {name: array for name, array in others.items() if array is not None}


def _shapes(classes: int, objects: int, components: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Return shape and type of the arrays of `SelfCalibration`."""
    return {
        "classes": ((classes, COUNTS, BINS), FLOAT),
        "objects": ((objects, SLOTS, SLOT), OF_SLOTS),
        "components": ((components,), INDEX),
        "scatter": ((classes, SCATTER), FLOAT),
        "innovations": ((objects, AXES), FLOAT),
        "lagged": ((classes, AXES), FLOAT),
    }


def bytes_of(density: Density) -> dict[str, bytes]:
    """Return the arrays of a density as bytes, one string for each part; `columns_in` reads them.

    A number takes 8 bytes, one of the slots of `SelfCalibration` 2, the least significant first. The columns of a part
    lie one behind the other in the order of `columns_of`, and a flag is the integer 0 or 1. Equal densities give equal
    bytes.
    """
    parts = {rows.part: rows.words for rows in _records(density)}
    parts |= {
        "classes" if name == CLASSES else name: array.view(np.float64) for name, array in _others(density).items()
    }
    return {part: words.astype("<f8", copy=False).tobytes() for part, words in parts.items()}


def columns_in(parts: Mapping[str, bytes], classes: int) -> dict[str, NDArray[Any]]:
    """Return the named arrays that bytes hold: inverse of `bytes_of`, with the names of `columns_of`.

    Args:
        parts: `bernoulli` and `poisson`; `misses`, `classes`, `sensor` and `calibration.…` where the density has them.
        classes: of the parameters that the density belongs to.

    Raises:
        DensityError: a part is missing, is not whole rows, or has a flag that is neither 0 nor 1.
    """
    columns: dict[str, NDArray[Any]] = {}
    kinds: tuple[type[Rows], ...] = (Bernoullis, Poissons, Misses, *JOINING, Attributes)
    for kind in kinds:
        if kind in {Bernoullis, Poissons} or kind.part in parts:
            rows = kind.of(_words(parts, kind.part, kind.width))
            columns |= {f"{kind.part}.{name}": column for name, column in rows.columns()}
            for name, one in kind.described.items():
                flags = rows.words.view(np.int64)[one.begin * len(rows) : one.end * len(rows)]
                if one.number == np.bool_ and not ((flags == 0) | (flags == 1)).all():
                    raise DensityError(f"{kind.part}.{name}", "flags, 0 or 1", "another number")
    if "classes" in parts:
        columns[CLASSES] = _words(parts, "classes", classes).reshape(-1, classes)
    if SENSOR in parts:
        columns[SENSOR] = _words(parts, SENSOR, 5)
    if f"{COUNTED}.classes" in parts:
        for name, (shape, number) in _shapes(0, 0, 0).items():
            width = prod(shape[1:]) * number.itemsize // 8
            words = _words(parts, f"{COUNTED}.{name}", width)
            columns[f"{COUNTED}.{name}"] = words.view(number).reshape(-1, *shape[1:])
    if f"{APPEARANCE}.model" in parts:
        numbers = int(_words(parts, f"{APPEARANCE}.model", 2).view(np.int64)[1:].sum())
        if not EMBEDDING[0] <= numbers <= EMBEDDING[1]:
            raise DensityError(f"{APPEARANCE}.model", f"{EMBEDDING[0]} to {EMBEDDING[1]} numbers", str(numbers))
        for name, (shape, kind) in Appearance.shapes(numbers, 0, 0, 0).items():
            words = _words(parts, f"{APPEARANCE}.{name}", prod(shape[1:]) * np.dtype(kind).itemsize // 8)
            columns[f"{APPEARANCE}.{name}"] = words.view(kind).reshape(-1, *shape[1:])
    return columns


def _words(parts: Mapping[str, bytes], part: str, width: int) -> Array:
    """Return the numbers of a part, of which each row has `width`."""
    data = parts.get(part)
    if not isinstance(data, bytes) or len(data) % (8 * width):
        received = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
        raise DensityError(part, f"bytes, {8 * width} for each row", received)
    return np.frombuffer(data, "<f8").astype(np.float64, copy=False)


def density_of(stamp_ns: int, next_id: int, columns: Mapping[str, Any], labels: tuple[str, ...]) -> Density:
    """Return the density of named arrays.

    Args:
        stamp_ns: stamp of its last frame.
        next_id: id of the next new track.
        columns: what `columns_of` or `columns_in` gave.
        labels: names of the classes of the parameters that it belongs to.

    Raises:
        DensityError: a column is missing, has another shape or type, or holds values that no density has.
    """
    if not NO_FRAME <= stamp_ns < 2**63:
        raise DensityError("stamp_ns", "a stamp", str(stamp_ns))
    bernoulli = _rows(Bernoullis, columns)
    poisson = _rows(Poissons, columns)
    for part, rows in (("bernoulli", bernoulli), ("poisson", poisson)):
        label = rows.label
        if label.size and not (label.min() >= 0 and label.max() < len(labels)):
            raise DensityError(f"{part}.label", f"indices below {len(labels)}", f"{label.min()} to {label.max()}")
        if label.size and not 0 <= rows.born_ns.min() <= rows.born_ns.max() <= stamp_ns:
            stamps = f"{rows.born_ns.min()} to {rows.born_ns.max()}"
            raise DensityError(f"{part}.born_ns", f"stamps from 0 to {stamp_ns}", stamps)
    wrong = (bernoulli.seen_ns < bernoulli.born_ns) | (bernoulli.seen_ns > stamp_ns)
    if wrong.any():
        row = int(wrong.argmax())
        stamps = f"from born_ns, {bernoulli.born_ns[row]}, to {stamp_ns}"
        raise DensityError(f"bernoulli.seen_ns[{row}]", f"a stamp {stamps}", str(bernoulli.seen_ns[row]))
    for path, column, high in (
        ("bernoulli.existence", bernoulli.existence, 1.0),
        ("bernoulli.score", bernoulli.score, 1.0),
        ("poisson.weight", poisson.weight, np.inf),
    ):
        if column.size and not 0.0 <= column.min() <= column.max() <= high:
            raise DensityError(path, f"numbers from 0 to {high:g}", f"{column.min():g} to {column.max():g}")
    ids = bernoulli.id
    if ids.size and not (np.diff(ids) > 0).all():
        row = int((np.diff(ids) <= 0).argmax()) + 1
        raise DensityError(f"bernoulli.id[{row}]", f"an id above the one before it, {ids[row - 1]}", str(ids[row]))
    if not 0 <= int(ids.max(initial=0)) < next_id < 2**63:
        raise DensityError("next_id", f"an id above {ids.max(initial=0)}", str(next_id))
    misses = _rows(Misses, columns) if "misses.looked_ns" in columns else None
    if misses is not None:
        for name, since in (("missed_from_ns", misses.missed_from_ns), ("looked_ns", misses.looked_ns)):
            if since.shape != bernoulli.seen_ns.shape:
                raise DensityError(f"misses.{name}", f"{len(bernoulli)} rows", shown(since))
            wrong = (since < bernoulli.seen_ns) | (since > stamp_ns)
            if wrong.any():
                row = int(wrong.argmax())
                text = f"a stamp from seen_ns, {bernoulli.seen_ns[row]}, to {stamp_ns}"
                raise DensityError(f"misses.{name}[{row}]", text, str(since[row]))
    pi = _class_probability(columns[CLASSES], len(bernoulli), len(labels)) if CLASSES in columns else None
    own = None
    if f"{COUNTED}.classes" in columns:
        own = _self_calibration(columns, _shapes(len(labels), len(bernoulli), len(poisson)))
    motion = columns.get(SENSOR)
    if motion is not None:
        if not (shown(motion) == "(5,) float64" and (np.abs(motion) <= MOST_COUNTED).all()):
            raise DensityError(SENSOR, f"(5,) finite numbers up to {MOST_COUNTED:g}", shown(motion))
        motion = np.array(motion, np.float64)
    joining = _rejoining(columns, stamp_ns, next_id, len(labels)) if f"{Tracklets.part}.id" in columns else None
    texts = _attributes(columns, next_id) if f"{Attributes.part}.id" in columns else None
    return Density(stamp_ns, next_id, bernoulli, poisson, tuple(labels), misses, pi, own, motion, joining, texts)


def _attributes(columns: Mapping[str, Any], next_id: int) -> Attributes:
    """Return the attributes of objects, in the order of their ids."""
    rows = _rows(Attributes, columns)
    for name, column, low, high in (
        ("id", np.diff(rows.id, prepend=0), 0, next_id),
        ("id", rows.id, 1, next_id - 1),
        ("evidence", rows.evidence, 0.0, MOST_COUNTED),
    ):
        if column.size and not low <= column.min() <= column.max() <= high:
            raise DensityError(f"{rows.part}.{name}", f"from {low} to {high}", f"{column.min()} to {column.max()}")
    return rows


def _rejoining(columns: Mapping[str, Any], stamp_ns: int, next_id: int, classes: int) -> Rejoining:
    """Return the state of the joining of tracks, whose rows fit together."""
    live, places, lost, begun, returns, ends, known = (_rows(kind, columns) for kind in JOINING)
    found = Rejoining(live, places, lost, begun, returns, ends, known)  # type: ignore[arg-type]  # in this order
    for rows in (found.live, found.lost):
        for name, column, low, high in (
            ("id", np.diff(rows.id, prepend=0), 1, next_id),
            ("id", rows.id, 1, next_id - 1),
            ("label", rows.label, 0, classes - 1),
            ("object", rows.object - rows.id, -next_id, 0),
            ("object", rows.object, -1 if rows is found.live else 0, next_id - 1),
            ("candidate", rows.candidate, -1, next_id - 1),
            ("first_ns", rows.first_ns, 0, stamp_ns),
            ("last_ns", rows.last_ns - rows.first_ns, 0, stamp_ns),
            ("last_ns", rows.last_ns, 0, stamp_ns),
            ("detections", rows.detections, 0, MOST_COUNTED),
            ("probability", rows.probability, 0.0, 1.0),
        ):
            if column.size and not low <= column.min() <= column.max() <= high:
                raise DensityError(f"{rows.part}.{name}", f"from {low} to {high}", f"{column.min()} to {column.max()}")
    for path, length, expected in (
        (Places.part, len(found.places), len(found.live)),
        (Statistics.part, len(found.classes), classes),
    ):
        if length != expected:
            raise DensityError(path, f"{expected} rows", str(length))
    for path, column, most in (
        (f"{Places.part}.count", found.places.count, MOST_COUNTED),
        (f"{Beginnings.part}.kind", found.beginnings.kind, classes - 1),
        (f"{Beginnings.part}.stamp_ns", found.beginnings.stamp_ns, stamp_ns),
        (f"{Returns.part}.kind", found.returns.kind, classes - 1),
        (f"{Returns.part}.stamp_ns", found.returns.stamp_ns, stamp_ns),
        (f"{Returns.part}.weight", found.returns.weight, 1),
        (f"{Ends.part}.kind", found.ends.kind, classes - 1),
        (f"{Ends.part}.stamp_ns", found.ends.stamp_ns, stamp_ns),
        (f"{Ends.part}.returned", found.ends.returned, 1),
    ):
        if column.size and not 0 <= column.min() <= column.max() <= most:
            raise DensityError(path, f"from 0 to {most}", f"{column.min()} to {column.max()}")
    if f"{APPEARANCE}.model" not in columns:
        return found
    return replace(found, appearance=_appearance(columns, stamp_ns, len(live), len(lost), classes))


def _appearance(columns: Mapping[str, Any], stamp_ns: int, live: int, lost: int, classes: int) -> Appearance:
    """Return the vectors and the counts of their distances."""
    model: Any = columns[f"{APPEARANCE}.model"]
    numbers = int(model[1]) if shown(model) == "(2,) int64" else 0
    arrays: dict[str, Any] = {}
    for name, (shape, kind) in Appearance.shapes(numbers, live, lost, classes).items():
        path, column = f"{APPEARANCE}.{name}", columns.get(f"{APPEARANCE}.{name}")
        if not isinstance(column, np.ndarray) or column.dtype != kind or column.shape != shape:
            raise DensityError(path, f"{shape} {kind.__name__}", shown(column))
        low = {"counts": 0, "stamp_ns": -1}.get(name, -MOST_COUNTED)
        high = stamp_ns if name == "stamp_ns" else MOST_COUNTED
        if name != "model" and column.size and not low <= column.min() <= column.max() <= high:
            raise DensityError(path, f"numbers from {low:g} to {high:g}", f"{column.min():g} to {column.max():g}")
        arrays[name] = np.array(column, order="C")
    return Appearance(**arrays)


def _self_calibration(
    columns: Mapping[str, Any], shapes: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]
) -> SelfCalibration:
    """Return the counts of scores, none of which is negative or above `MOST_COUNTED`, and the innovations within it."""
    found = {}
    for name, (shape, kind) in shapes.items():
        column, path = columns.get(f"{COUNTED}.{name}"), f"{COUNTED}.{name}"
        if not isinstance(column, np.ndarray) or column.dtype != kind or column.shape != shape:
            raise DensityError(path, f"{shape} {kind.name}", shown(column))
        low: float
        low, high = (NO_BIN, BINS - 1) if kind == INDEX else (0.0, MOST_COUNTED)
        if name in {"innovations", "lagged"}:
            low = -MOST_COUNTED
        if column.size and not low <= column.min() <= column.max() <= high:
            raise DensityError(path, f"numbers from {low} to {high:g}", f"{column.min():g} to {column.max():g}")
        found[name] = np.array(column, order="C")
    return SelfCalibration(**found)


def _class_probability(column: Any, count: int, classes: int) -> Array:
    """Return the posteriors over the classes, each of which sums to 1."""
    if not isinstance(column, np.ndarray) or column.dtype != np.float64 or column.shape != (count, classes):
        raise DensityError(CLASSES, f"({count}, {classes}) float64", shown(column))
    wrong = ~((column >= 0.0).all(axis=1) & (np.abs(column.sum(axis=1) - 1.0) <= ROUNDING))
    if wrong.any():
        row = int(wrong.argmax())
        raise DensityError(f"{CLASSES}[{row}]", "probabilities that sum to 1", str(column[row].tolist())[:200])
    return np.array(column, order="C")


def _rows(kind: type[_Rows], columns: Mapping[str, Any]) -> _Rows:
    found: dict[str, Any] = {name: columns.get(f"{kind.part}.{name}") for name in kind.described}
    rows = kind(**found)
    for name, column in rows.columns():
        if column.dtype.kind == "f" and not np.isfinite(column).all():
            good = np.isfinite(column) | (np.isnan(column) if name == "auxiliary" or kind in JOINING else False)
            if good.all():
                continue
            row = np.argwhere(~good)[0]
            raise DensityError(f"{kind.part}.{name}[{row[0]}]", "finite numbers", str(column[tuple(row)]))
    return rows
