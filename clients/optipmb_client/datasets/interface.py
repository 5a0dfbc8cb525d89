"""What every dataset offers, whatever its files look like.

Conventions: metres, seconds, radians, z up. Detections and clouds are in their sensor's frame, truth is in the world
frame. Centres are geometric centres, sizes are length, width, height, stamps are nanoseconds.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import FieldOfView

from optipmb_client.geometry import Bools, Floats, Ints, Pose
from optipmb_client.results.rows import BoxTable, ResultWriter

Points = NDArray[np.float32]


class Cloud:
    """The points of one scan, read when they are first asked for.

    `xyz` is given as an array (P, 3), or as a function that returns one. `translation` (3,) and `quaternion` (4,) are
    the pose world from the frame of the points.
    """

    def __init__(self, xyz: Points | Callable[[], Points], translation: Floats, quaternion: Floats) -> None:
        self._xyz = xyz
        self.translation = translation
        self.quaternion = quaternion

    @property
    def xyz(self) -> Points:
        """(P, 3) float32 points in the frame of the scanner."""
        if callable(self._xyz):
            self._xyz = self._xyz()
        return self._xyz

    @property
    def pose(self) -> Pose:
        """World from scanner."""
        return Pose(self.translation, self.quaternion)


@dataclass(frozen=True)
class DetectionFrame:
    """What the detector and the sensors gave at one time; boxes in the sensor frame."""

    index: int
    stamp_ns: int
    pose: Pose  # world from sensor; the identity where the detector gives boxes in the world frame
    labels: tuple[str, ...]  # class names, the same for all frames of a sequence
    label: Ints  # (M,) index into `labels`
    center: Floats  # (M, 3)
    size: Floats  # (M, 3)
    yaw: Floats  # (M,)
    score: Floats  # (M,) in (0, 1]
    velocity: Floats | None = None
    """(M, 2) over ground along the axes of the sensor; None where the detector gives none."""
    cloud: Cloud | None = None
    field_of_view: FieldOfView | None = None
    """Where the sensor detects objects, in the axes of `pose`; None: everywhere."""
    position_covariance: Floats | None = None
    """(M, 3, 3) along the axes of the sensor, NaN where unknown; None where the detector gives none."""

    def __len__(self) -> int:
        return len(self.label)

    def take(self, rows: Ints | Bools) -> "DetectionFrame":
        """Return the frame with the chosen detections."""
        columns = {name: values for name in DETECTION_COLUMNS if (values := getattr(self, name)) is not None}
        return replace(self, **{name: values[rows] for name, values in columns.items()})


DETECTION_COLUMNS = ("label", "center", "size", "yaw", "score", "velocity", "position_covariance")
"""Columns of a `DetectionFrame` with a row for each detection; the last two may be None."""


@dataclass(frozen=True)
class Regions:
    """Parts of the image in which nothing is annotated (KITTI's DontCare)."""

    frame: Ints  # (D,)
    box2d: Floats  # (D, 4) x1 y1 x2 y2 in pixels


@dataclass(frozen=True)
class Truth(BoxTable):
    """The annotated objects of one sequence, ordered by frame; boxes in the world frame."""

    velocity: Floats  # (R, 2) world frame; NaN where unknown
    occlusion: Ints  # (R,) KITTI's levels: 0 visible, 1 partly, 2 largely occluded, 3 unknown
    truncation: Ints  # (R,) KITTI's levels: 0 none, 1 partly, 2 largely outside the image
    covered: Floats  # (R,) fraction of the visible surface hidden by others, in [0, 1]; NaN where unknown
    points: Ints  # (R,) LiDAR returns on the object; -1 where unknown
    box2d: Floats  # (R, 4) x1 y1 x2 y2 in pixels; NaN where there is no image
    ignored: Bools  # (R,) neither to be found nor wrong to find: hardly visible, or cut by the border of the image
    regions: Regions  # where detections count as neither right nor wrong
    labelled: Bools | None = None  # (F,) frames that are compared; None: all
    notes: tuple[str, ...] = ()  # assumptions about it, a line each


class DataSequence(Protocol):
    """One recording: its frames in order, and the truth if there is any."""

    @property
    def name(self) -> str:
        """As the dataset calls it."""

    @property
    def labels(self) -> tuple[str, ...]:
        """The classes of its detections; without any, the benchmark's."""

    @property
    def poses(self) -> Sequence[Pose]:
        """World from sensor, one per frame."""

    @property
    def has_clouds(self) -> bool:
        """Whether any frame has a point cloud."""

    def __len__(self) -> int: ...

    def frames(self) -> Iterator[DetectionFrame]:
        """Yield every frame in order, also those without detections."""

    def truth(self) -> Truth | None:
        """Return the annotations; None where the dataset has none."""


class Dataset(Protocol):
    """A collection of sequences."""

    @property
    def name(self) -> str:
        """As given to `open_dataset`."""

    @property
    def profile(self) -> str:
        """The parameter profile that fits it."""

    def sequences(self, names: Sequence[str]) -> Sequence[DataSequence]:
        """Return the sequences of these names, `all`, or the names of splits, each once and in order."""

    def writer(self, out: Path, sequence: DataSequence) -> ResultWriter:
        """Return a writer of the dataset's own result format into the folder `out`."""
