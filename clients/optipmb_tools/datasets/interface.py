"""Sequences, frames and annotations of data sets of any format.

Conventions: metres, seconds, radians, z up. Detections and clouds are in their sensor's frame, truth is in the world
frame. Centres are geometric centres, sizes are length, width, height, stamps are nanoseconds.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from optipmb_client.errors import UsageError
from optipmb_schemas import FieldOfView, Tracks

from optipmb_tools.files import DatasetError
from optipmb_tools.geometry import Bools, Floats, Ints, Pose
from optipmb_tools.results import BoxTable

if TYPE_CHECKING:
    from optipmb import Georeference as Georeference  # noqa: PLC0414  for others too

Points = NDArray[np.float32]
_T = TypeVar("_T")

ANNOTATIONS = "annotations to compare with; of a table: --truth FILE"
IDENTITY = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


class Cloud:
    """Points of one scan, read on first access.

    `xyz` is an array (P, 3) or a function that returns one. `translation` (3,) and `quaternion` (4,) are the pose world
    from scanner.
    """

    def __init__(self, xyz: Points | Callable[[], Points], translation: Floats, quaternion: Floats) -> None:
        self._xyz = xyz
        self.pose = Pose(translation, quaternion)

    @property
    def xyz(self) -> Points:
        """(P, 3) float32 points in the frame of the scanner."""
        if callable(self._xyz):
            self._xyz = self._xyz()
        return self._xyz


@dataclass(frozen=True)
class DetectionFrame:
    """Detections and cloud of one stamp; boxes in the sensor frame."""

    index: int
    stamp_ns: int
    pose: Pose  # world from sensor; the identity where the detector gives boxes in the world frame
    labels: tuple[str, ...]  # class names
    label: Ints  # (M,) index into `labels`
    center: Floats  # (M, 3)
    size: Floats  # (M, 3)
    yaw: Floats  # (M,)
    score: Floats  # (M,) in (0, 1]
    velocity: Floats | None = None  # (M, 2) over ground along the axes of the sensor
    cloud: Cloud | None = None
    field_of_view: FieldOfView | None = None  # in the axes of `pose`; None: everywhere
    position_covariance: Floats | None = None  # (M, 3, 3) along the axes of the sensor, NaN where unknown
    sensor: str = ""  # its name, in a sequence of several
    attributes: NDArray[np.object_] | None = None  # (M,) texts by name

    def __len__(self) -> int:
        return len(self.label)

    @property
    def columns(self) -> dict[str, Any]:
        """Columns with a row for each detection; velocity, position_covariance and attributes may be None."""
        return {name: getattr(self, name) for name in (*DETECTION_COLUMNS, "attributes")}

    def take(self, rows: Ints | Bools) -> "DetectionFrame":
        return replace(self, **{name: values[rows] for name, values in self.columns.items() if values is not None})


DETECTION_COLUMNS = ("label", "center", "size", "yaw", "score", "velocity", "position_covariance")


@dataclass(frozen=True)
class Reports:
    """Reports of objects one by one, as of vessels: a frame is a look at the place of its box."""

    distance: float  # m around a box in which its object reported before
    period: float  # s between the reports of an object
    speed: float  # m/s, of the fastest ones


@dataclass(frozen=True)
class Regions:
    """Parts of the image in which nothing is annotated (KITTI's DontCare)."""

    frame: Ints  # (D,)
    box2d: Floats  # (D, 4) x1 y1 x2 y2 in pixels


@dataclass(frozen=True)
class Truth(BoxTable):
    """Annotated objects of one sequence, ordered by frame; boxes in the world frame."""

    velocity: Floats  # (R, 2) world frame; NaN where unknown
    occlusion: Ints  # (R,) KITTI's levels: 0 visible, 1 partly, 2 largely occluded, 3 unknown
    truncation: Ints  # (R,) KITTI's levels: 0 none, 1 partly, 2 largely outside the image
    covered: Floats  # (R,) fraction of the visible surface hidden by others, in [0, 1]; NaN where unknown
    points: Ints  # (R,) LiDAR returns on the object; -1 where unknown
    box2d: Floats  # (R, 4) x1 y1 x2 y2 in pixels; NaN where there is no image
    ignored: Bools  # (R,) neither to be found nor wrong to find: hardly visible, or cut by the border of the image
    regions: Regions  # where detections count as neither right nor wrong
    labelled: Bools | None = None  # (F,) frames that are compared; None: all
    notes: tuple[str, ...] = ()  # assumptions, a line each

    @classmethod
    def of(cls, labels: tuple[str, ...], frame: Ints, **known: Any) -> "Truth":
        """Return annotations from the columns that are known; the others get the values for unknown."""
        count = len(frame)
        unknown: dict[str, Any] = {
            "velocity": np.full((count, 2), np.nan),
            "occlusion": np.zeros(count, dtype=np.int64),
            "truncation": np.zeros(count, dtype=np.int64),
            "covered": np.full(count, np.nan),
            "points": np.full(count, -1, dtype=np.int64),
            "box2d": np.full((count, 4), np.nan),
            "ignored": np.zeros(count, dtype=np.bool_),
            "regions": Regions(np.empty(0, dtype=np.int64), np.empty((0, 4))),
        }
        return cls(labels=labels, frame=frame, **unknown | known)


class Assumption(str):
    """A note that says how data are read, as they usually are; commands shorten several of them to one line."""

    __slots__ = ()


class Area(NamedTuple):
    """A part of the ground, for pictures."""

    kind: str  # pavement, road, block, building, crosswalk or line
    outline: Floats  # (N, 2) in the world frame


class DataSequence(ABC):
    """One recording, or one sensor of it.

    Subclasses store the attributes below, or compute them on first use.
    """

    name: str
    notes: Sequence[str] = ()  # assumptions and doubts, a line each

    # Sensors of one recording can share a density (`optipmb_tools.datasets.fused`).
    recording: str = ""  # common to those sensors, and their name as one sequence
    sensor: str = ""  # by which frames with equal stamps are ordered; empty: unknown
    sensor_column: str = "sensor"
    recording_columns: Mapping[str, str] = {}
    sensors: "Sequence[DataSequence]" = ()  # its parts, if it has several

    # A table of its tracks has the columns of the table of detections, if it came from one.
    key_columns: Mapping[str, str] = {}
    time_column: str = ""  # empty: the columns are `sequence` and `stamp_ns` instead
    numbers: NDArray[Any] | None = None  # (F,) numbers of the frames as the table has them
    areas: Sequence[Area] = ()  # later ones lie above earlier ones
    reports: Reports | None = None  # where objects report one by one
    apart: Sequence[str] = ()  # classes whose boxes are things of their own, however close

    @property
    def attributes(self) -> list[str]:
        """Names of the texts of its detections."""
        return sorted({name for one in self.sensors for name in one.attributes})

    if TYPE_CHECKING:

        @property
        def labels(self) -> tuple[str, ...]:
            """Classes of its detections; without any, the benchmark's."""

        @property
        def poses(self) -> Sequence[Pose]:
            """World from sensor, one per frame."""

        @property
        def has_clouds(self) -> bool:
            """Whether any frame has a point cloud."""

        @property
        def times(self) -> NDArray[Any] | None:
            """(F,) as the table of detections has them."""

        @property
        def frame_columns(self) -> Mapping[str, NDArray[np.str_]]:
            """Further columns (F,) of a table of tracks."""

    else:
        has_clouds, times, frame_columns = False, None, {}

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order, also those without detections."""

    @property
    def stamps(self) -> Ints:
        """(F,) nanoseconds; `frames` may count from another origin."""
        return np.array([frame.stamp_ns for frame in self.frames()], dtype=np.int64)

    def truth(self) -> Truth | None:
        """Return the annotations; None where the data set has none."""
        return None

    def rows(self, frame: int) -> Ints | None:
        """Return the row (M,) of each detection of a frame in the table that it came from; None without a table."""
        del frame
        return None


@dataclass(frozen=True)
class DatasetArguments:
    """Arguments of `open_dataset`: enough to open the same data set in another process."""

    name: str
    root: Path | None = None
    detections: str | None = None
    options: tuple[tuple[str, float | str], ...] = ()

    def open(self) -> "Dataset":
        """Open the data set; raises as `open_dataset` does."""
        from optipmb_tools.datasets import open_dataset  # noqa: PLC0415  it imports this module

        return open_dataset(self.name, self.root, self.detections, **dict(self.options))


class Dataset(ABC):
    """A collection of sequences."""

    name: str  # as given to `open_dataset`
    arguments = DatasetArguments("")  # by which another process opens it; set by `open_dataset`
    georeference: "Georeference | None" = None  # place of its world frame; set by `open_dataset`
    time_origin_ns = 0  # time in UTC of the stamp 0, in files that hold times in UTC; set by `open_dataset`
    digits = "unit"  # of numbers in tables of its tracks as text; set by `open_dataset`

    if TYPE_CHECKING:

        @property
        def profile(self) -> str:
            """Parameter profile that fits it."""

        @property
        def notes(self) -> Sequence[str]:
            """Assumptions, a line each."""

    else:
        notes = ()

    @abstractmethod
    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the sequences of these names, `all`, or the names of splits, each once and in order."""

    @abstractmethod
    def write(self, out: Path, sequence: DataSequence, tracks: Mapping[int, Tracks]) -> Path:
        """Write the tracks (world frame) of a sequence, by frame index, in the data set's own format; return the file.

        The file below `out` appears complete, or not at all.
        """

    def join(self, out: Path, sequences: Sequence[DataSequence]) -> None:  # noqa: B027  most have no such file
        """Write the file of a benchmark that holds all sequences, from their files."""


def profile_named(text: str, known: Mapping[str, str]) -> str:
    """Return the profile of the first detector whose name is words of a text, in any case; `auto` of none."""
    words = re.findall(r"[a-z]+|\d+", text.lower())
    runs = {*words, *map("".join, pairwise(words))}
    return next((profile for detector, profile in known.items() if detector in runs), "auto")


def chosen(names: Iterable[str], known: Mapping[str, _T], what: str, spelt: Callable[[str], str] = str) -> list[_T]:
    """Return the values of some names, or of `all`, each once.

    Raises:
        DatasetError: A name is not known; `what` names its kind.
    """
    wanted: dict[str, None] = {}
    for name in names:
        for one in known if name == "all" else (spelt(name),):
            if one not in known:
                raise DatasetError("--sequences", what, repr(name))
            wanted[one] = None
    return [known[one] for one in wanted]


def class_like(name: str, names: Sequence[str]) -> str | None:
    """Return the one of `names` that means the same class, as profiles match them; None for none or several.

    `Car`, `car` and `vehicle.car` are one class. An equal name comes first, then one that differs in case only.
    """
    if name in names:
        return name
    from optipmb.model.class_names import like  # noqa: PLC0415  loads the tracker, which equal names do not need

    return like(name, tuple(names))


def georeference_of(origin: float | str) -> "Georeference":
    """Return the place of the world frame on the globe that `--origin` names.

    Raises:
        DatasetError: It names none.
    """
    from optipmb import Georeference, ParameterError  # noqa: PLC0415  loads the tracker, which few data sets need

    try:
        return Georeference.parse(str(origin))
    except ParameterError as error:
        raise DatasetError(f"--{error.path}", error.expected, error.received) from error


def time_origin_of(text: float | str) -> int:
    """Return the time in UTC, nanoseconds since 1970, that `--option time_origin` names.

    Raises:
        DatasetError: It names none, or has no zone.
    """
    try:
        time = datetime.fromisoformat(str(text))
        zone = time.utcoffset()
    except ValueError:
        zone = None
    if zone is None:
        raise DatasetError("--option time_origin", "a time as 2026-01-31T08:00:00Z, with its zone", repr(text))
    return round(time.timestamp() * 1e6) * 1000


def digits_of(text: float | str) -> str:
    """Return the digits of numbers in text that `--digits` names.

    Raises:
        DatasetError: It names none.
    """
    if text not in {"unit", "full"}:
        raise DatasetError("--digits", "unit or full", repr(text))
    return str(text)


def selected_frames(sequence: DataSequence, classes: Sequence[str]) -> Iterator[DetectionFrame]:
    """Yield the frames of a sequence with the detections of some classes; with all of them when none is named.

    Raises:
        UsageError: The sequence has no detections of one of the classes.
    """
    wanted = {name: class_like(name, sequence.labels) for name in classes}
    if unknown := [name for name, known in wanted.items() if known is None]:
        known = ", ".join(sequence.labels)
        raise UsageError(f"sequence {sequence.name} has no detections of class {unknown[0]!r} (it has: {known})")
    for frame in sequence.frames():
        chosen = [i for i, name in enumerate(frame.labels) if name in wanted.values()]
        yield frame.take(np.isin(frame.label, chosen)) if classes else frame


class Preloaded(DataSequence):
    """A sequence with all frames and clouds in memory, so that reading or generating them takes no time later."""

    def __init__(self, sequence: DataSequence) -> None:
        self.name = sequence.name
        self.labels: tuple[str, ...] = sequence.labels
        self.has_clouds: bool = sequence.has_clouds
        self.poses: Sequence[Pose] = sequence.poses
        self.areas = sequence.areas
        self._frames = list(sequence.frames())
        self._truth = sequence.truth()

    def __len__(self) -> int:
        return len(self._frames)

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order."""
        return iter(self._frames)

    def truth(self) -> Truth | None:
        return self._truth
