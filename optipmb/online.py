"""A tracker that keeps its density: boxes in, tracks out, one frame after the other.

    tracker = optipmb.OnlineTracker("kitti")
    for t, boxes in detections:
        tracks = tracker.update(boxes, t=t)
        print(tracks.id, tracks.name, tracks.center)

It is a thin object over the pure `Tracker.step`, for those who want no densities.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from html import escape
from io import StringIO
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final
from warnings import warn

import numpy as np

from optipmb.detectors import forms_of, from_detector, on_host
from optipmb.learning.doubts import EXPECTED as SIZES
from optipmb.learning.doubts import SizeCheck
from optipmb.learning.velocity_check import EXPECTED, VelocityCheck
from optipmb.model.attributes import shown_of
from optipmb.model.class_names import class_indices
from optipmb.model.errors import FrameError
from optipmb.model.frame import Pose, make_frame
from optipmb.tracker import Tracker

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd
    import pyarrow as pa
    import supervision as sv
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray

    from optipmb.cameras.ground_camera import GroundCamera
    from optipmb.filter.paths import PredictedPaths
    from optipmb.joining.decision import Rejoin
    from optipmb.model.density import Density
    from optipmb.model.frame import FieldOfView, Frame, PointCloud
    from optipmb.model.parameters import Parameters
    from optipmb.model.rows import Array, Index
    from optipmb.model.tracks import Tracks
    from optipmb.tracker import Modules, StepResult


FLAT: Final = (("center", ("x", "y", "z")), ("size", ("l", "w", "h")), ("velocity", ("vx", "vy")))
"""Arrays of a frame, and the columns that may stand for them."""
PIXELS: Final = (("box", ("x1", "y1", "x2", "y2")), ("foot", ("u", "v")))
"""The same of boxes in the image of a camera, px."""
ALIASES: Final = MappingProxyType({
    "length": "l", "width": "w", "height": "h", "heading": "yaw", "confidence": "score",
    "class": "label", "name": "label", "category": "label", "type": "label",
})  # fmt: skip
"""Other names of columns."""
WITHOUT: Final = MappingProxyType({"z": 0.0, "h": 1.5, "score": 1.0, "label": "object"})
"""Values of the columns that may be missing, as in the tables of `optipmb track`."""
BOXES: Final = ("center", "score", "label")
OTHERS: Final = ("size", "yaw", "velocity", "position_covariance", "embedding", "attributes")
KNOWN: Final = (*BOXES, *OTHERS, *(part for _, parts in FLAT for part in parts), *ALIASES)
OF_PIXELS: Final = ("box", "foot", "score", "label", "embedding", "attributes")
KNOWN_PIXELS: Final = (*OF_PIXELS, *(part for _, parts in PIXELS for part in parts), *ALIASES)
SHOWN_ROWS: Final = 10
"""Tracks that the representation of `OnlineTracks` lists."""
CLASS_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C6D1F")
HTML_COLUMNS: Final = ("id", "class", "x", "y", "z", "yaw", "vx", "vy", "existence", "age", "time_since_detection")
"""Columns of the table that notebooks show."""
NEAR_M: Final = 0.1
"""Least distance from a camera at which a box is projected."""
DOUBTED: Final = 20
"""Frames in succession with odd times after which a warning follows."""
DOUBTED_LONG: Final = 2
"""The same of times in which every object is lost."""
STEPS_NS: Final = 10**6, 10**10
"""Times between frames that are not odd: no object is followed from one frame to the next over ten seconds."""


@dataclass(frozen=True)
class OnlineTracks:
    """The tracks of one frame in the world frame, one row per track, ascending ids.

    Attributes:
        stamp_ns: of the frame, nanoseconds.
        tracks: the columns as `optipmb.Tracks`, for `optipmb.predict_tracks`.
        name: (N,) class names as the detections gave them, else as the profile does.
        velocity: (N, 2) over ground, m/s; NaN while it is unknown: before the second detection, where the detector
            gives none.
        left_out: detections of classes that the profile lacks, and boxes that the camera does not place.
        paths: where the tracks will be at the `horizons` of the profile; None where it has none.
        class_probability: (N, C) probability of each class of the profile; None where it has no groups of classes.
        sensor_motion: (3,) velocity, m/s, and turn rate, rad/s, with which what stands passes the sensor, where the
            motion of the sensor is estimated; None elsewhere.
        measured: (N,) uint8, the known parts of each track: 1 the heading, 2 the size, 4 the height, added up.
        object: (N,) int64 id of the first track of the object, -1 while that is not decided; None without `rejoin`.
        object_probability: (N,) that all joins of the object are right, 1 without a join; None without `rejoin`.
        candidate: (N,) int64 earlier object that fitted best when the track was decided, -1: none did; None without
            `rejoin`.
        candidate_probability: (N,) that the track continues an earlier object, NaN where none fitted; below
            `Rejoin.min_probability` it was not joined; None without `rejoin`.
        attributes: by name the texts (N,) with most evidence, "" where unknown, and their shares of it (N,).

    The other attributes are the columns of `optipmb.Tracks`.
    """

    stamp_ns: int
    tracks: Tracks
    name: NDArray[np.str_]
    left_out: int
    id: Index
    label: Index
    center: Array
    size: Array
    yaw: Array
    heading_confidence: Array
    velocity: Array
    yaw_rate: Array
    acceleration: Array
    existence: Array
    score: Array
    covariance: Array
    age: Array
    time_since_detection: Array
    detection: Index
    confirmed: NDArray[np.bool_]
    measured: NDArray[np.uint8]
    paths: PredictedPaths | None = None
    class_probability: Array | None = None
    sensor_motion: Array | None = None
    object: Index | None = None
    object_probability: Array | None = None
    candidate: Index | None = None
    candidate_probability: Array | None = None
    attributes: Mapping[str, tuple[NDArray[np.str_], Array]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.tracks)

    def __repr__(self) -> str:
        shown = np.flatnonzero(self.confirmed)
        lines = [f"OnlineTracks: {self.summary}"]
        if len(shown):
            lines.append(f"{'id':>6} {'class':<12} {'x':>9} {'y':>9} {'vx':>7} {'vy':>7} {'existence':>9}")
        for i in shown[:SHOWN_ROWS]:
            (x, y, _), (vx, vy) = self.center[i], self.velocity[i]
            place = f"{self.id[i]:>6} {self.name[i]:<12} {x:>9.2f} {y:>9.2f} {vx:>7.2f} {vy:>7.2f}"
            lines.append(f"{place} {self.existence[i]:>9.3f}")
        return "\n".join([*lines, *([f"   ... {len(shown) - SHOWN_ROWS} more"] if len(shown) > SHOWN_ROWS else [])])

    def _repr_html_(self) -> str:
        """Return the confirmed tracks for a notebook: a drawing, where matplotlib is installed, and a table."""
        shown = np.flatnonzero(self.confirmed)
        columns = {name: values[shown].tolist() for name, values in self.columns().items() if name in HTML_COLUMNS}
        rows = ("".join(f"<td>{_cell(value)}</td>" for value in row) for row in zip(*columns.values(), strict=True))
        head = "".join(f"<th>{name}</th>" for name in columns)
        table = f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"
        return f"<p>{self.summary}</p>{self._drawing()}{table}"

    @property
    def summary(self) -> str:
        """Count of the confirmed tracks, and the time."""
        count = int(np.count_nonzero(self.confirmed))
        rest = f", {len(self) - count} not confirmed" if count < len(self) else ""
        return f"{count} tracks at {self.stamp_ns / 1e9:.3f} s{rest}"

    def _drawing(self) -> str:
        """Return `plot` as SVG, nothing without matplotlib."""
        try:
            from matplotlib.figure import Figure  # noqa: PLC0415 - an extra
        except ImportError:
            return ""
        figure, text = Figure(), StringIO()
        self.plot(figure.subplots())
        figure.savefig(text, format="svg")
        return text.getvalue()

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the tracks as flat columns (N,), named as the tables of the command `optipmb track`."""
        plain = ("score", "existence", "confirmed", "age", "time_since_detection", "detection")
        return {
            "stamp_ns": np.full(len(self), self.stamp_ns, dtype=np.int64),
            "id": self.id,
            "class": self.name,
            **{part: getattr(self, array)[:, i] for array, parts in FLAT[:2] for i, part in enumerate(parts)},
            "yaw": self.yaw,
            **{part: self.velocity[:, i] for i, part in enumerate(("vx", "vy"))},
            "yaw_rate": self.yaw_rate,
            "acceleration": self.acceleration,
            **{column: getattr(self, column) for column in plain},
            **({} if self.object is None else {"object": self.object}),
            **({} if self.object_probability is None else {"object_probability": self.object_probability}),
            **{f"attributes.{name}": texts for name, (texts, _) in self.attributes.items()},
        }

    def to_arrow(self) -> pa.Table:
        """Return the columns as a table of pyarrow, with null where unknown.

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
        """Return the columns as a data frame of pandas, with NaN where unknown.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas as pd  # noqa: PLC0415 - users bring it
        except ImportError as error:
            raise ImportError("to_dataframe needs pandas: pip install pandas") from error
        return pd.DataFrame(self.columns())

    def to_kitti(self, frame: int, pose: Pose | None = None) -> list[str]:
        """Return all tracks as lines of a KITTI result file, without image boxes (-1).

        Args:
            frame: number of the frame.
            pose: world from sensor; None when both frames are the same. The camera looks along the sensor's x axis.
        """
        center, yaw = self.center, self.yaw
        if pose is not None:
            center = (center - pose.translation) @ pose.rotation
            forward = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(self))]) @ pose.rotation
            yaw = np.arctan2(forward[:, 1], forward[:, 0])
        turn = np.remainder(0.5 * np.pi - yaw, 2.0 * np.pi) - np.pi
        place = np.column_stack([-center[:, 1], 0.5 * self.size[:, 2] - center[:, 2], center[:, 0]])
        alpha = np.remainder(turn - np.arctan2(place[:, 0], place[:, 2]) + np.pi, 2.0 * np.pi) - np.pi
        rows = np.column_stack([self.size[:, ::-1], place, turn, self.score])
        return [
            f"{frame} {identity} {name} -1 -1 {angle:.6f} -1 -1 -1 -1 " + " ".join(f"{value:.6f}" for value in row)
            for identity, name, angle, row in zip(self.id, self.name, alpha, rows.tolist(), strict=True)
        ]

    def to_nuscenes(self, sample_token: str) -> list[dict[str, Any]]:
        """Return all tracks as the boxes of one sample of a nuScenes tracking submission."""
        velocity = np.nan_to_num(self.velocity)  # the official reader refuses unknown velocities
        half = 0.5 * self.yaw
        return [
            {
                "sample_token": sample_token,
                "translation": self.center[i].tolist(),
                "size": self.size[i, [1, 0, 2]].tolist(),
                "rotation": [float(np.cos(half[i])), 0.0, 0.0, float(np.sin(half[i]))],
                "velocity": velocity[i].tolist(),
                "tracking_id": str(self.id[i]),
                "tracking_name": str(self.name[i]),
                "tracking_score": float(self.score[i]),
            }
            for i in range(len(self))
        ]

    def to_supervision(self, projection: ArrayLike) -> sv.Detections:
        """Return the confirmed tracks in front of a camera as image boxes of supervision.

        Args:
            projection: (3, 4) from world to pixels: intrinsics @ [R | t].

        Raises:
            ImportError: supervision is not installed.
        """
        try:
            import supervision as sv  # noqa: PLC0415 - users bring it
        except ImportError as error:
            raise ImportError("to_supervision needs supervision: pip install supervision") from error
        ground = self._outlines()
        height = np.multiply.outer(0.5 * self.size[:, 2], (-1.0, 1.0)) + self.center[:, 2:]
        corners = np.concatenate([np.insert(ground, 2, height[:, [side]], axis=2) for side in (0, 1)], axis=1)
        pixels = np.insert(corners, 3, 1.0, axis=2) @ np.asarray(projection, np.float64).T
        rows = np.flatnonzero(self.confirmed & (pixels[:, :, 2] > NEAR_M).all(axis=1))
        image = pixels[rows, :, :2] / pixels[rows, :, 2:]
        return sv.Detections(
            xyxy=np.hstack([image.min(axis=1), image.max(axis=1)]),
            confidence=self.existence[rows],
            class_id=self.label[rows],
            tracker_id=self.id[rows],
            data={"class_name": self.name[rows]},
        )

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the confirmed tracks from above, with ids and a colour for each class.

        Raises:
            ImportError: matplotlib, of the extra `plot`, is not installed.
        """
        if axes is None:
            try:
                from matplotlib import pyplot as plt  # noqa: PLC0415 - an extra
            except ImportError as error:
                raise ImportError("plot needs matplotlib: pip install matplotlib") from error
            axes = plt.gca()
        outlines, named = self._outlines(), set()
        for i in np.flatnonzero(self.confirmed):
            colour, name = CLASS_COLOURS[self.label[i] % len(CLASS_COLOURS)], str(self.name[i])
            axes.fill(*outlines[i].T, fc=f"{colour}55", ec=colour, label=None if name in named else name)
            (x, y, _), (vx, vy) = self.center[i], np.nan_to_num(self.velocity[i])
            axes.plot([x, x + vx], [y, y + vy], color=colour)
            axes.annotate(str(self.id[i]), (x, y), xytext=(5, 5), textcoords="offset points", color=colour)
            named.add(name)
        axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{self.stamp_ns / 1e9:.3f} s")
        if named:
            axes.legend()
        return axes

    def _outlines(self) -> Array:
        """Return the corners (N, 4, 2) of the boxes from above."""
        forward = np.column_stack([np.cos(self.yaw), np.sin(self.yaw)]) * 0.5 * self.size[:, :1]
        left = np.column_stack([-np.sin(self.yaw), np.cos(self.yaw)]) * 0.5 * self.size[:, 1:2]
        corners = (forward + left, left - forward, -forward - left, forward - left)
        return np.stack(corners, axis=1) + self.center[:, None, :2]


class OnlineTracker:
    """Tracks one stream of frames.

    Args:
        profile: parameters, or the name or file of a profile. The default, `generic`, suits road users of any detector;
            `generic_parameters` makes parameters for other classes and rates.
        modules: which modules of the paper are on.
        unknown_classes: `refuse` raises for a detection of a class that the profile lacks, `leave out` counts it in
            `OnlineTracks.left_out`. Names that mean the same are one: `car`, `Car` and `vehicle.car`.
        rejoin: how tracks of the same object are joined over gaps; None: they are not.

    Attributes:
        parameters: the profile.
        density: posterior of the last frame, for those who want to keep or restore it.

    Raises:
        ParameterError: no such profile.
    """

    def __init__(
        self,
        profile: Parameters | str = "generic",
        *,
        modules: Modules | None = None,
        unknown_classes: str = "refuse",
        rejoin: Rejoin | None = None,
    ) -> None:
        if unknown_classes not in {"refuse", "leave out"}:
            raise FrameError("unknown_classes", "'refuse' or 'leave out'", repr(unknown_classes))
        self._tracker = Tracker(profile, modules, rejoin=rejoin)
        self._rejoin = rejoin
        self.parameters = self._tracker.parameters
        self._names = np.asarray(self.parameters.labels, dtype=np.object_)
        self._leave_out = unknown_classes == "leave out"
        self.density: Density = self._tracker.initial()
        self._latest = ""  # summary of the newest tracks
        self._odd_steps = 0
        self._sizes = SizeCheck()
        self._velocities = VelocityCheck()

    def __repr__(self) -> str:
        return f"OnlineTracker: profile {self.parameters.name}, {self._latest or 'no frame yet'}"

    def reset(self) -> None:
        """Forget all tracks; no id is used again."""
        self.density = self._tracker.initial(self.density.next_id)
        self._latest = ""

    def update(
        self,
        boxes: Mapping[str, ArrayLike] | Any = None,
        *,
        t: float | datetime | np.datetime64 | None = None,
        stamp_ns: int | None = None,
        pose: Pose | None = None,
        cloud: PointCloud | None = None,
        field_of_view: FieldOfView | None = None,
        camera: GroundCamera | None = None,
        embedding_model: str | None = None,
        **arrays: ArrayLike,
    ) -> OnlineTracks:
        """Take the detections of the next frame and return the tracks.

        Args:
            boxes: a result of a detection framework (`from_detector`), or columns by name: a dictionary, a list of one
                for each box, a structured array, or a data frame of pandas, polars or pyarrow. `center` (M, 3) or `x`,
                `y`, `z`; `size` (M, 3) or `l`, `w`, `h` or `length`, `width`, `height`; `yaw` or `heading` (M,) rad;
                `score` or `confidence` (M,) in (0, 1]; `class`, `label`, `name`, `category` or `type` (M,): class
                names, one name for all, or their places in the profile; `velocity` (M, 2) or `vx`, `vy`, m/s, NaN where
                unknown; `position_covariance` (M, 3, 3), m^2, and `embedding` (M, E), appearance, likewise;
                `attributes` (M,), texts by name, each alone or with a score, as `{"plate": ("AB 12", 0.8)}`. Sizes,
                headings and `z` may be NaN or absent, unknown; but with a size a missing `z` is 0 and `h` 1.5 m.
                Without `score` it is 1. None: nothing was detected.
            t: time of the frame: seconds, or a date (of pandas too; UTC where it has no zone); or
            stamp_ns: nanoseconds.
            pose: world from sensor, or None when the boxes are in the world frame; with a camera on a vehicle, of it.
            cloud: the scan of the same stamp.
            field_of_view: where the sensor detects objects; outside it they are neither detected nor missed. With a
                camera the default is the field of view of its image.
            camera: of pixel boxes: `box` (M, 4) or `x1`, `y1`, `x2`, `y2`, or the points `foot` (M, 2) or `u`, `v` on
                which objects stand, with classes and scores, `embedding` and `attributes`.
            embedding_model: model and version of `embedding`, the same as in `Rejoin`; required with it.
            arrays: the same columns as arguments.

        Raises:
            FrameError: a column is missing or unknown, or a shape, value or class is not allowed, or the stamp goes
                back; names it. The density stays as it was.

        Warns:
            UserWarning: the times are not in seconds, the sizes in another unit or the widths before the lengths, or
                the velocities in contradiction to the boxes, by all appearance; once each.
        """
        if not isinstance(pose, Pose | None):
            raise FrameError("pose", "an optipmb.Pose of a translation and a quaternion", type(pose).__name__)
        if (t is None) == (stamp_ns is None):
            raise FrameError("t", "t (s) or stamp_ns (ns)", "both" if t is not None else "neither")
        if stamp_ns is None:
            stamp_ns = _stamp(t)
            if not max(self.density.stamp_ns, 0) <= stamp_ns < 2**63:
                raise FrameError("t", f"a time from {max(self.density.stamp_ns, 0) / 1e9:g} s on, in seconds", str(t))
        columns, row, outside = self._given(boxes, arrays, camera, pose)
        if camera is not None:
            field_of_view = field_of_view or camera.view_from(pose)
        compared = None if self._rejoin is None else self._rejoin.embedding_model
        if "embedding" in columns and embedding_model != compared:
            expected = "the model of Rejoin(embedding_model=…)" if compared is None else repr(compared)
            raise FrameError("embedding_model", expected, repr(embedding_model))
        names, label, left_out = self._classes(columns.pop("label"))
        frame, missing = make_frame(
            self.parameters,
            stamp_ns=stamp_ns,
            labels=names,
            label=label,
            pose=pose,
            cloud=cloud,
            field_of_view=field_of_view,
            embedding_model=embedding_model,
            **columns,
        )
        if row is not None:
            texts = frame.readings and frame.readings._replace(row=row[frame.readings.row])
            frame = replace(frame, source=row[frame.source], readings=texts)
        self._doubt(frame)
        result = self._tracker.step(self.density, frame)
        self.density = result.density
        online = self._shown(frame, result, max(left_out, missing) + outside)
        self._latest = online.summary
        return online

    def _shown(self, frame: Frame, result: StepResult, left_out: int) -> OnlineTracks:
        """Return the tracks of a step; a velocity is NaN until a track was detected twice, or its detector gave one."""
        tracks = result.tracks
        once = (tracks.age == tracks.time_since_detection) & (tracks.velocity == 0.0).all(axis=1)
        known = dict(tracks.columns()) | {"velocity": np.where(once[:, None], np.nan, tracks.velocity)}
        return OnlineTracks(
            stamp_ns=frame.stamp_ns,
            tracks=tracks,
            name=self._names[tracks.label].astype(np.str_),
            left_out=left_out,
            **known,
            paths=result.paths,
            class_probability=result.class_probability,
            sensor_motion=result.density.sensor_motion,
            measured=np.full(len(tracks), 7, np.uint8) if result.measured is None else result.measured,
            object=None if result.joined is None else result.joined.object,
            object_probability=None if result.joined is None else result.joined.probability,
            candidate=None if result.joined is None else result.joined.candidate,
            candidate_probability=None if result.joined is None else result.joined.candidate_probability,
            attributes=self._texts(result),
        )

    def _texts(self, result: StepResult) -> Mapping[str, tuple[NDArray[np.str_], Array]]:
        """Return the attributes of the tracks."""
        if result.density.attributes is None:
            return {}
        found = shown_of(result.density.attributes, result.tracks.id)
        return {name: (np.array(texts, np.str_), share) for name, (texts, share) in found.items()}

    def _given(
        self, boxes: Any, arrays: dict[str, Any], camera: GroundCamera | None, pose: Pose | None
    ) -> tuple[dict[str, Any], Index | None, int]:
        """Return the columns of detections; of pixel boxes also their rows, and how many boxes have no place."""
        if forms_of(boxes):
            arrays = {**from_detector(boxes, camera=camera), **arrays}
            boxes = None
            arrays.pop("camera", None)
        if camera is None:
            return _columns(boxes, arrays), None, 0
        pixels = _pixels(boxes, arrays)
        of_boxes = {name: pixels.pop(name) for name in ("embedding", "attributes") if pixels.get(name) is not None}
        columns = self._on_ground(camera, pose, pixels)
        count = len(pixels["box"] if "box" in pixels else pixels["foot"])
        row, outside = columns.pop("row"), sum(columns.pop("left_out").values())
        for name, values in of_boxes.items():
            if len(values) != count:
                raise FrameError(name, f"{count} values, one for each box", str(len(values)))
            columns[name] = np.asarray(values)[row] if name == "embedding" else [values[one] for one in row.tolist()]
        return columns, row, outside

    def _doubt(self, frame: Frame) -> None:
        """Warn of a frame whose numbers have another meaning than they should, by all appearance."""
        step_ns = frame.stamp_ns - self.density.stamp_ns
        is_odd = self.density.stamp_ns >= 0 and not STEPS_NS[0] <= step_ns <= STEPS_NS[1]
        self._odd_steps = self._odd_steps + 1 if is_odd else 0
        if self._odd_steps == (DOUBTED_LONG if step_ns > STEPS_NS[1] else DOUBTED):
            seconds = f"{self._odd_steps} frames in succession, the last {step_ns / 1e9:g} s after the one before"
            warn(f"t: expected seconds (stamp_ns: nanoseconds), received {seconds}", stacklevel=3)
        if self._sizes.add(frame):
            warn(f"size: expected {SIZES}, received {self._sizes.contradiction}", stacklevel=3)
        if self._velocities.add(frame, estimated=self.density.sensor_motion is not None):
            warn(f"velocity: expected {EXPECTED}, received {self._velocities.contradiction}", stacklevel=3)

    def _on_ground(self, camera: GroundCamera, pose: Pose | None, columns: dict[str, Any]) -> dict[str, Any]:
        """Return the detections of pixel boxes, in the frame of the camera's position."""
        given = columns.pop("label")
        if np.asarray(given).dtype.kind in "iuf" and np.size(given):
            expected = (
                "names of classes, as detectors count theirs in other orders (names=['person', …] of the detector)"
            )
            raise FrameError("label", expected, f"numbers: {np.asarray(given).tolist()!s:.40}")
        names, label, _ = self._classes(given)
        if not ((label >= 0) & (label < len(names))).all():
            raise FrameError("label", f"integers in [0, {len(names)})", str(label.tolist())[:80])
        return camera.detections(label=np.asarray(names, np.object_)[label], pose=pose, **columns)

    def _classes(self, values: ArrayLike) -> tuple[tuple[str, ...], NDArray[np.int64], int]:
        """Return the names of the classes of a frame, which of them each detection is of, and how many are unknown."""
        known = self.parameters.labels
        given = np.asarray(values)
        if given.dtype.kind == "f":  # as networks give places
            if (wrong := np.flatnonzero(given != np.round(given))).size:
                raise FrameError(
                    f"label[{wrong[0]}]", "a class, or its place in the profile", str(given.flat[wrong[0]])
                )
            given = given.astype(np.int64)
        if given.dtype.kind in "iu" or not given.size:
            return known, given.astype(np.int64), 0
        found, label = np.unique(given.astype(np.str_), return_inverse=True)
        names = tuple(found.tolist())
        places = class_indices(names, known)
        rows = np.flatnonzero(places[label] < 0)
        if len(rows) and not self._leave_out:
            expected = f"one of {', '.join(known)} (unknown_classes='leave out' takes any)"
            if names == (WITHOUT["label"],):
                expected = f"a column class, as {known[0]}: without one boxes are of class {names[0]}, which"
                expected += f" optipmb.generic_parameters(['{names[0]}'], 0.1) tracks, the profile does not"
            raise FrameError(f"label[{rows[0]}]", expected, repr(str(given[rows[0]])))
        for name, place in zip(names, places.tolist(), strict=True):
            if place >= 0 and self._names[place] == known[place]:
                self._names[place] = name
        return names, label.astype(np.int64), len(rows)


def _cell(value: object) -> str:
    return escape(f"{value:.2f}" if isinstance(value, float) else str(value))


def _stamp(t: Any) -> int:
    """Return the nanoseconds of a time in seconds, or of a date."""
    if isinstance(t, datetime | np.datetime64) and str(t) == "NaT":
        raise FrameError("t", "seconds or a date", "NaT")
    if isinstance(t, datetime):  # exact, with the nanoseconds of pandas
        since = t - datetime(1970, 1, 1, tzinfo=None if t.tzinfo is None else UTC)
        return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000 + getattr(t, "nanosecond", 0)
    if isinstance(t, np.datetime64):
        return int(t.astype("datetime64[ns]").astype(np.int64))
    try:
        seconds = float(t)
    except (TypeError, ValueError):
        raise FrameError("t", "seconds or a date", repr(t)) from None
    if not np.isfinite(seconds):
        raise FrameError("t", "finite seconds", repr(t))
    return round(seconds * 1e9)


def _columns(boxes: Any, arrays: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return the columns as `make_frame` takes them."""
    given = _renamed(boxes, arrays, KNOWN, FLAT)
    if not given:
        return {"center": [], "score": [], "label": []}
    columns: dict[str, Any] = {}
    for name, parts in FLAT:
        if name in given:
            columns[name] = given[name]
        elif any(part in given for part in parts):
            columns[name] = _stacked(given, parts)
    columns |= {
        name: given[name]
        for name in ("yaw", "score", "position_covariance", "embedding", "attributes", "label")
        if name in given
    }
    if "center" not in columns:
        raise FrameError("center", "the columns x and y, or center", f"the columns {', '.join(given)}")
    for name in ("score", "label"):
        columns.setdefault(name, [WITHOUT[name]] * len(columns["center"]))
    if "size" not in columns and "center" not in given and "z" not in given:
        columns["center"][:, 2] = np.nan
    if isinstance(columns["label"], str):
        columns["label"] = [columns["label"]] * len(columns["center"])
    columns = {name: _nested(values) for name, values in columns.items()}
    if isinstance(columns["label"], list):
        columns["label"] = [_class_name(one) for one in columns["label"]]
    return columns


def _renamed(
    boxes: Any, arrays: Mapping[str, ArrayLike], known: Sequence[str], flat: Sequence[tuple[str, tuple[str, ...]]]
) -> dict[str, Any]:
    """Return the columns of boxes and arguments by their first names, each meaning once."""
    given = {name: on_host(values) for name, values in {**_named(boxes), **arrays}.items() if values is not None}
    if unknown := [name for name in given if name not in known]:
        pixels = " (pixel boxes need camera=)" if unknown[0] in KNOWN_PIXELS else ""
        if {"boxes", "bbox", "bboxes", "xyxy", "instances", "pred_boxes"} & set(unknown):
            pixels = " (boxes of an image: update({'box', 'class', 'score'}, camera=…))"
        raise FrameError(unknown[0], f"columns among {', '.join(known)}{pixels}", f"the columns {', '.join(given)}")
    whole = {part: name for name, parts in flat for part in parts}
    renamed = [ALIASES.get(name, name) for name in given]
    meanings = [whole[name] if whole.get(name) in given else name for name in renamed]
    if twice := [name for name, meaning in zip(given, meanings, strict=True) if meanings.count(meaning) > 1]:
        raise FrameError(twice[-1], "one column for each meaning", f"the columns {', '.join(twice)}")
    return dict(zip(renamed, given.values(), strict=True))


def _pixels(boxes: Any, arrays: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return the columns as `GroundCamera.detections` takes them."""
    given = _renamed(boxes, arrays, KNOWN_PIXELS, PIXELS)
    if not given:
        return {"box": np.empty((0, 4)), "label": []}
    for name, parts in PIXELS:
        if any(part in given for part in parts):
            given[name] = _stacked(given, parts)
    return {name: _nested(values) for name, values in given.items() if name in OF_PIXELS}


def _class_name(value: Any) -> Any:
    """Return the class that a member of an enumeration names, by its value where that is a text."""
    if not isinstance(value, Enum):
        return value
    return value.value if isinstance(value.value, str) else value.name


def _nested(values: Any) -> Any:
    """Return a column of objects, as data frames hold lists and members of an enumeration, as a list."""
    if isinstance(values, list):
        return values
    array = np.asarray(values)
    return [_nested(one) if isinstance(one, np.ndarray) else one for one in array] if array.dtype == object else array


def _named(boxes: Any) -> dict[str, Any]:
    """Return the columns of boxes in any of the forms that `update` takes."""
    if boxes is None or (isinstance(boxes, list) and not boxes):
        return {}
    if isinstance(boxes, list):
        names = boxes[0].keys() if isinstance(boxes[0], dict) else None
        if names is None or not all(isinstance(one, dict) and one.keys() == names for one in boxes):
            raise FrameError("boxes", "a dictionary with the same keys for each box", f"{boxes!r:.80}")
        return {str(name): [one[name] for one in boxes] for name in names}
    if isinstance(boxes, np.ndarray):
        if boxes.dtype.names is None:
            raise FrameError("boxes", "a structured array, or columns by name", f"{boxes.shape} {boxes.dtype}")
        return {name: boxes[name] for name in boxes.dtype.names}
    columns = getattr(boxes, "column_names", getattr(boxes, "columns", None))  # pyarrow; pandas and polars
    if columns is None and not hasattr(boxes, "keys"):
        expected = "columns by name, a list of boxes, or a result that from_detector takes; of boxes of an image "
        expected += "update({'box', 'class', 'score'}, camera=…)"
        raise FrameError("boxes", expected, type(boxes).__name__)
    return {str(name): boxes[name] for name in (boxes if columns is None else columns)}


def _stacked(given: Mapping[str, Any], parts: Sequence[str]) -> Array:
    """Return one array of the columns of its parts."""
    first = next(part for part in parts if part in given)
    try:
        count = len(given[first])
    except TypeError:
        raise FrameError(first, "numbers, one for each box", repr(given[first])) from None
    columns = []
    for part in parts:
        if part not in given and part not in WITHOUT:
            needed = " and ".join(one for one in parts if one not in WITHOUT)
            raise FrameError(part, f"the columns {needed}", f"the columns {', '.join(given)}")
        values = given.get(part, [WITHOUT.get(part)] * count)
        try:
            column = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            raise FrameError(part, "numbers", f"{type(values).__name__} of {values!r:.60}") from None
        if column.shape != (count,):
            raise FrameError(part, f"({count},) numbers, one for each box", f"{column.shape}")
        columns.append(column)
    return np.column_stack(columns)
