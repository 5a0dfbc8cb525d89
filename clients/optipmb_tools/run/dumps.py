"""Dumps that a service saves when tracking a stream fails, tracked again in this process.

Like `offline` this imports the tracker, and nothing of the service.
"""

import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from optipmb_client.errors import UsageError
from optipmb_schemas import Detections, Dump, DumpedFrame, MessageError, Points, Pose, Tracks, decode_dump

import optipmb
from optipmb_tools.datasets.interface import DETECTION_COLUMNS
from optipmb_tools.run.tracking import fields_of


@dataclass(frozen=True)
class Replayed:
    """Result of tracking the frames of a dump again."""

    stream: str
    frames: int
    saved: str  # type and text of the error that was saved
    error: str | None = None  # type and text of the error now
    seq: int | None = None  # number of the frame that raised it
    stamp_ns: int | None = None
    trace: str = ""

    @property
    def same(self) -> bool:
        """Whether the error came again."""
        return self.error == self.saved


def read(file: Path) -> Dump:
    """Read a dump.

    Raises:
        UsageError: the file holds none.
        OSError: it cannot be read.
    """
    try:
        return decode_dump(file.read_bytes())
    except MessageError as error:
        raise UsageError(f"--dump {file}: {error}") from error


def replay(dump: Dump, tracker: Callable[[optipmb.Parameters], Any] = optipmb.Tracker) -> Replayed:
    """Track the frames of a dump as the service did, until one raises.

    Raises:
        UsageError: the parameters or the density of the dump are none.
    """
    try:
        parameters = optipmb.parse_parameters(dump.parameters)
        others = {name: optipmb.parse_parameters(values) for name, values in dump.sensors.items()}
        labels = parameters.labels
        columns = optipmb.columns_in(dump.density, len(labels))
        density = optipmb.density_of(dump.stamp_ns, dump.next_id, columns, labels)
    except optipmb.OptipmbError as error:
        raise UsageError(f"dump of {dump.stream}: {error}") from error
    ordinary = parameters, tracker(parameters)
    sensors = {name: (one, tracker(one)) for name, one in others.items()}
    result = Replayed(dump.stream, len(dump.frames), dump.error)
    for frame in dump.frames:
        if frame.anew:
            density = optipmb.Density.empty(parameters.labels, density.next_id)
        try:
            density = _step(*sensors.get(frame.detections.stream, ordinary), density, frame)
        except Exception as error:  # noqa: BLE001  the result
            mark = frame.detections
            text = f"{type(error).__name__}: {error}"
            trace = "".join(traceback.format_exception(error))
            return replace(result, error=text, seq=mark.seq, stamp_ns=mark.stamp_ns, trace=trace)
    return result


def _step(
    parameters: optipmb.Parameters, steps: optipmb.Tracker, density: optipmb.Density, given: DumpedFrame
) -> optipmb.Density:
    """Step by one frame, and make its tracks a message: a value that no message may have is an error too."""
    message = given.detections
    frame, _ = optipmb.make_frame(
        parameters,
        stamp_ns=message.stamp_ns,
        labels=message.labels,
        **{name: getattr(message, name) for name in DETECTION_COLUMNS},
        pose=None if message.frame == "world" else _pose(message),
        field_of_view=optipmb.FieldOfView.of(
            message.field_of_view, None if message.pose is None else _place(message.pose)
        ),
        cloud=None if given.points is None else optipmb.PointCloud(given.points.xyz, _pose(given.points)),
    )
    found = steps.step(density, frame)
    Tracks(
        stream=message.stream,
        epoch=message.epoch,
        seq=message.seq,
        stamp_ns=message.stamp_ns,
        session="0" * 32,
        profile=parameters.name,
        cloud_used=given.points is not None,
        labels=tuple(parameters.classes),
        **fields_of(found.tracks, found.paths, class_probability=found.class_probability, measured=found.measured),
    )
    return found.density


def _pose(message: Detections | Points) -> optipmb.Pose:
    """Return the pose of the sensor; arrays in the world frame have the identity."""
    if message.frame == "world" or message.pose is None:
        return optipmb.Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))  # type: ignore[arg-type]  # it makes arrays of them
    return _place(message.pose)


def _place(pose: Pose) -> optipmb.Pose:
    return optipmb.Pose(pose.translation, pose.quaternion)
