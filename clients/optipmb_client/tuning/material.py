"""What tuning works on: the detections of one class, ready to be tracked any number of times, and the truth.

Conventions: frames are in the world frame, made once by `optipmb.make_frame`; truth is in the sensor frame of each
frame, where the benchmarks compare. One `Track` of a trial needs nothing but these and a set of parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optipmb import Frame, Modules, OptipmbError, Parameters, PointCloud, Pose, Tracker, make_frame
from optipmb_client.camera import Camera
from optipmb_client.datasets import DataSequence, DatasetError, DetectionFrame, Truth
from optipmb_client.errors import UsageError
from optipmb_client.evaluation import Rules
from optipmb_client.geometry import Floats, Ints, stack_poses, to_sensor
from optipmb_client.results import ResultTable
from optipmb_client.results.rows import empty_table

__all__ = ["Clip", "load", "prepare_frames", "track_clip"]


@dataclass(frozen=True)
class Clip:
    """One sequence with its detections of some classes."""

    name: str
    labels: tuple[str, ...]
    """The classes, as the parameters that will be used have them."""
    frames: tuple[Frame, ...]
    """(F,) world frame."""
    rotation: Floats
    """(F, 3, 3) world from sensor."""
    translation: Floats
    """(F, 3)"""
    camera: Camera | None
    """In whose image the benchmark counts; None where it does not."""
    truth: Truth
    """Of these classes and those alike, in the sensor frame of each row's frame."""
    period_s: float
    """Median time between frames."""


def load(sequence: DataSequence, parameters: Parameters, rules: Rules) -> Clip:
    """Read one sequence into memory: detections of the classes of the parameters, clouds, and the truth.

    Raises:
        DatasetError: it has no truth.
        UsageError: it has values that the tracker refuses.

    """
    truth = sequence.truth()
    if truth is None:
        raise DatasetError(f"sequence {sequence.name}", "annotations to compare with", "none")
    given = list(sequence.frames())
    alike = {name for label in parameters.labels for name in (label, *rules.neighbours.get(label, ()))}
    rotation, translation = stack_poses(sequence.poses)
    stamps = np.array([frame.stamp_ns for frame in given], dtype=np.int64)
    return Clip(
        name=sequence.name,
        labels=parameters.labels,
        frames=prepare_frames(sequence.name, given, parameters),
        rotation=rotation,
        translation=translation,
        camera=getattr(sequence, "camera", None),
        truth=truth.to_sensor(sequence.poses).take(np.isin(truth.names, sorted(alike))),
        period_s=float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else parameters.nominal_period,
    )


def prepare_frames(name: str, given: Sequence[DetectionFrame], parameters: Parameters) -> tuple[Frame, ...]:
    """Return the frames of a sequence for the tracker.

    Raises:
        UsageError: a frame has values that the tracker refuses.

    """
    frames = []
    for frame in given:
        cloud = frame.cloud
        try:
            made, _ = make_frame(
                parameters,
                stamp_ns=frame.stamp_ns,
                labels=frame.labels,
                label=frame.label,
                center=frame.center,
                size=frame.size,
                yaw=frame.yaw,
                score=frame.score,
                velocity=frame.velocity,
                pose=Pose(frame.pose.translation, frame.pose.quaternion),
                cloud=None if cloud is None else PointCloud(cloud.xyz, Pose(cloud.translation, cloud.quaternion)),
            )
        except OptipmbError as error:
            raise UsageError(f"sequence {name}, frame {frame.index}: {error}") from error
        frames.append(made)
    return tuple(frames)


def track_clip(clip: Clip, parameters: Parameters, modules: Modules | None = None) -> ResultTable:
    """Return the tracks of a clip in the sensor frame of each frame, with image boxes where there is a camera."""
    tracker = Tracker(parameters, modules)
    density = tracker.initial()
    found = []
    for frame in clip.frames:
        result = tracker.step(density, frame)
        density = result.density
        found.append(result.tracks)
    count = np.array([len(tracks.id) for tracks in found], dtype=np.int64)
    if not count.sum():
        return empty_table(parameters.labels)
    when: Ints = np.repeat(np.arange(len(found)), count)
    center, yaw = to_sensor(
        clip.rotation[when],
        clip.translation[when],
        np.concatenate([tracks.center for tracks in found]),
        np.concatenate([tracks.yaw for tracks in found]),
    )
    size = np.concatenate([tracks.size for tracks in found])
    image = clip.camera.boxes(center, size, yaw)[0] if clip.camera else np.full((len(when), 4), np.nan)
    return ResultTable(
        labels=parameters.labels,
        frame=when,
        id=np.concatenate([tracks.id for tracks in found]),
        label=np.concatenate([tracks.label for tracks in found]),
        center=center,
        size=size,
        yaw=yaw,
        score=np.concatenate([tracks.score for tracks in found]),
        box2d=image,
    )
