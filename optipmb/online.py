"""A tracker that keeps its density: boxes in, tracks out, one frame after the other.

    tracker = optipmb.OnlineTracker("kitti")
    for t, boxes in detections:
        tracks = tracker.update(boxes, t=t)
        print(tracks.id, tracks.name, tracks.center)

It is a thin object over the pure `Tracker.step`, for those who want no densities.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb.class_names import class_indices
from optipmb.errors import FrameError
from optipmb.frame import make_frame
from optipmb.parameters import Parameters, load_profile
from optipmb.tracker import Tracker

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    import pyarrow as pa
    from numpy.typing import ArrayLike, NDArray

    from optipmb.density import Density
    from optipmb.extract import Tracks
    from optipmb.field_of_view import FieldOfView
    from optipmb.frame import PointCloud, Pose
    from optipmb.paths import PredictedPaths
    from optipmb.rows import Array
    from optipmb.tracker import Modules


FLAT: Final = (("center", ("x", "y", "z")), ("size", ("l", "w", "h")), ("velocity", ("vx", "vy")))
"""Arrays of a frame, and the columns that may stand for them."""
CLASSES: Final = ("class", "label", "name")
BOXES: Final = ("center", "size", "yaw", "score", "label")


@dataclass(frozen=True)
class OnlineTracks:
    """The tracks of one frame in the world frame, one row per track, ascending ids.

    Attributes:
        stamp_ns: of the frame, nanoseconds.
        tracks: everything that the tracker gives.
        name: (N,) class names.
        velocity: (N, 2) over ground, m/s; NaN while it is unknown: before the second detection, where the detector
            gives none.
        left_out: detections of classes that the profile lacks.
        paths: where the tracks will be at the `horizons` of the profile; None where it has none.
        class_probability: (N, C) probability of each class of the profile; None where it has no groups of classes.
        sensor_motion: (3,) velocity, m/s, and turn rate, rad/s, with which what stands passes the sensor, where the
            motion of the sensor is estimated; None elsewhere.
    """

    stamp_ns: int
    tracks: Tracks
    name: NDArray[np.str_]
    velocity: Array
    left_out: int
    paths: PredictedPaths | None = None
    class_probability: Array | None = None
    sensor_motion: Array | None = None

    def __len__(self) -> int:
        return len(self.tracks)

    def __getattr__(self, name: str) -> Any:
        """Give every other column of `optipmb.Tracks`: id, center, size, yaw, existence, covariance and so on."""
        if name.startswith("_") or name == "tracks":
            raise AttributeError(name)
        return getattr(self.tracks, name)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the tracks as flat columns (N,), named as the tables of the command `optipmb track`."""
        tracks = self.tracks
        return {
            "stamp_ns": np.full(len(self), self.stamp_ns, dtype=np.int64),
            "id": tracks.id,
            "class": self.name,
            **{part: tracks.center[:, i] for i, part in enumerate("xyz")},
            **{part: tracks.size[:, i] for i, part in enumerate("lwh")},
            "yaw": tracks.yaw,
            **{part: self.velocity[:, i] for i, part in enumerate(("vx", "vy"))},
            "yaw_rate": tracks.yaw_rate,
            "acceleration": tracks.acceleration,
            "score": tracks.score,
            "existence": tracks.existence,
            "age": tracks.age,
            "time_since_detection": tracks.time_since_detection,
            "detection": tracks.detection,
        }

    def to_arrow(self) -> pa.Table:
        """Return the columns as a table of pyarrow; what is unknown is null.

        Raises:
            ImportError: pyarrow is not installed.
        """
        try:
            import pyarrow as pa  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise ImportError("to_arrow needs pyarrow: pip install pyarrow") from error
        return pa.table(
            {name: pa.array(values, from_pandas=values.dtype.kind == "f") for name, values in self.columns().items()}
        )

    def to_dataframe(self) -> pd.DataFrame:
        """Return the columns as a data frame of pandas; what is unknown is NaN.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas as pd  # noqa: PLC0415 - users bring it
        except ImportError as error:
            raise ImportError("to_dataframe needs pandas: pip install pandas") from error
        return pd.DataFrame(self.columns())


class OnlineTracker:
    """Tracks one stream of frames.

    Args:
        profile: parameters, or the name or file of a profile. `generic_parameters` makes some for a detector that
            nobody tuned.
        modules: which modules of the paper are on.
        unknown_classes: `refuse` raises for a detection of a class that the profile lacks, `leave out` counts it in
            `OnlineTracks.left_out`. Names that mean the same are one: `car`, `Car` and `vehicle.car`.

    Attributes:
        parameters: the profile.
        density: posterior of the last frame, for those who want to keep or restore it.

    Raises:
        ParameterError: no such profile.
    """

    def __init__(
        self, profile: Parameters | str, *, modules: Modules | None = None, unknown_classes: str = "refuse"
    ) -> None:
        if unknown_classes not in {"refuse", "leave out"}:
            raise FrameError("unknown_classes", "'refuse' or 'leave out'", repr(unknown_classes))
        self.parameters = profile if isinstance(profile, Parameters) else load_profile(profile)
        self._tracker = Tracker(self.parameters, modules)
        self._leave_out = unknown_classes == "leave out"
        self.density: Density = self._tracker.initial()

    def reset(self) -> None:
        """Forget all tracks; no id is used again."""
        self.density = self._tracker.initial(self.density.next_id)

    def update(
        self,
        boxes: Mapping[str, ArrayLike] | Any = None,
        *,
        t: float | None = None,
        stamp_ns: int | None = None,
        pose: Pose | None = None,
        cloud: PointCloud | None = None,
        field_of_view: FieldOfView | None = None,
        **arrays: ArrayLike,
    ) -> OnlineTracks:
        """Take the detections of the next frame and return the tracks.

        Args:
            boxes: columns by name: a dictionary, or a data frame of pandas, polars or pyarrow. `center` (M, 3) or `x`,
                `y`, `z`; `size` (M, 3) length, width, height, or `l`, `w`, `h`; `yaw` (M,) rad; `score` (M,) in (0, 1];
                `class`, `label` or `name` (M,): class names, or their places in the profile; `velocity` (M, 2) or
                `vx`, `vy`, m/s, NaN where unknown; `position_covariance` (M, 3, 3), m^2, likewise. None: nothing was
                detected.
            t: time of the frame, s; or
            stamp_ns: nanoseconds.
            pose: world from sensor, or None when the boxes are in the world frame.
            cloud: the scan of the same stamp.
            field_of_view: where the sensor detects objects; outside it they are neither detected nor missed.
            arrays: the same columns as arguments.

        Raises:
            FrameError: a column is missing, or a shape, value or class is not allowed, or the stamp goes back; names
                it. The density stays as it was.
        """
        if (t is None) == (stamp_ns is None):
            raise FrameError("t", "t (s) or stamp_ns (ns)", "both" if t is not None else "neither")
        if t is not None:
            if not np.isfinite(t):
                raise FrameError("t", "finite seconds", repr(t))
            stamp_ns = round(t * 1e9)
        columns = _columns(boxes, arrays)
        names, label, left_out = self._classes(columns.pop("label"))
        frame, missing = make_frame(
            self.parameters,
            stamp_ns=stamp_ns or 0,
            labels=names,
            label=label,
            pose=pose,
            cloud=cloud,
            field_of_view=field_of_view,
            **columns,
        )
        result = self._tracker.step(self.density, frame)
        self.density = result.density
        tracks = result.tracks
        once = (tracks.age == tracks.time_since_detection) & (tracks.velocity == 0.0).all(axis=1)
        return OnlineTracks(
            stamp_ns=frame.stamp_ns,
            tracks=tracks,
            name=np.asarray(self.parameters.labels, dtype=np.str_)[tracks.label],
            velocity=np.where(once[:, None], np.nan, tracks.velocity),
            left_out=max(left_out, missing),
            paths=result.paths,
            class_probability=result.class_probability,
            sensor_motion=result.density.sensor_motion,
        )

    def _classes(self, values: ArrayLike) -> tuple[tuple[str, ...], NDArray[np.int64], int]:
        """Return the names of the classes of a frame, which of them each detection is of, and how many are unknown."""
        known = self.parameters.labels
        given = np.asarray(values)
        if given.dtype.kind in "iu" or not given.size:
            return known, given.astype(np.int64), 0
        found, label = np.unique(given.astype(np.str_), return_inverse=True)
        names = tuple(found.tolist())
        rows = np.flatnonzero(class_indices(names, known)[label] < 0)
        if len(rows) and not self._leave_out:
            expected = f"one of {', '.join(known)} (unknown_classes='leave out' takes any)"
            raise FrameError(f"label[{rows[0]}]", expected, repr(str(given[rows[0]])))
        return names, label.astype(np.int64), len(rows)


def _columns(boxes: Any, arrays: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return the columns as `make_frame` takes them."""
    given: dict[str, Any] = dict(arrays)
    if boxes is not None:
        names = getattr(boxes, "column_names", getattr(boxes, "columns", None))  # pyarrow; pandas and polars
        given |= {str(name): boxes[name] for name in (boxes if names is None else names)}
    if not given:
        return {"center": [], "size": [], "yaw": [], "score": [], "label": []}
    columns: dict[str, Any] = {}
    for name, parts in FLAT:
        if name in given:
            columns[name] = given[name]
        elif all(part in given for part in parts):
            columns[name] = np.column_stack([np.asarray(given[part], dtype=np.float64) for part in parts])
    columns |= {name: given[name] for name in ("yaw", "score", "position_covariance") if name in given}
    label = next((given[name] for name in CLASSES if name in given), None)
    columns |= {} if label is None else {"label": label}
    missing = [name for name in BOXES if name not in columns]
    if missing:
        raise FrameError(missing[0], f"a column for each of {', '.join(BOXES)}", f"the columns {', '.join(given)}")
    return {name: values if isinstance(values, list) else np.asarray(values) for name, values in columns.items()}
