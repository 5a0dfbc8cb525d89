"""Sequences in memory, ready to be tracked any number of times: detections of some classes, and their truth.

Conventions: frames are in the world frame, made once by `optipmb.make_frame`; so are the tracks. The truth is in
the sensor frame of each row's frame, where KITTI compares, and in the world frame.
"""

from dataclasses import dataclass, replace

import numpy as np

from optipmb import Frame, Modules, Parameters, Tracker, Tracks
from optipmb_tools.camera import Camera
from optipmb_tools.datasets import DataSequence, DatasetError, Truth
from optipmb_tools.datasets.interface import ANNOTATIONS
from optipmb_tools.evaluation import Rules
from optipmb_tools.geometry import Floats, Ints, stack_poses, to_sensor
from optipmb_tools.results import FullTable, full_table
from optipmb_tools.results.kitti import LEAST_SHOWN
from optipmb_tools.run.tracking import tracker_frame

_DETECTION_COLUMNS = ("center", "size", "yaw", "velocity", "score", "source", "position_covariance")


@dataclass(frozen=True)
class Clip:
    """One sequence with its detections of some classes."""

    name: str
    labels: tuple[str, ...]  # the classes, as the parameters that will be used have them
    frames: tuple[Frame, ...]  # (F,) world frame
    rotation: Floats  # (F, 3, 3) world from sensor
    translation: Floats  # (F, 3)
    camera: Camera | None  # in whose image the benchmark counts; None where it does not
    truth: Truth  # of these classes and those alike, in the sensor frame of each row's frame
    world: Truth  # the same in the world frame

    @property
    def stamps(self) -> Ints:
        """(F,) nanoseconds."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)


def load(sequence: DataSequence, parameters: Parameters, rules: Rules) -> Clip:
    """Read one sequence into memory: detections of the classes of the parameters, clouds, and the truth.

    Raises:
        DatasetError: it has no truth, or one of some frames only, by which clutter cannot be counted.
        UsageError: it has values that the tracker refuses.
    """
    frames = list(sequence.frames())  # first: a generated scene takes its truth from the scans that its frames needed
    truth = sequence.truth()
    if truth is None:
        raise DatasetError(f"sequence {sequence.name}", ANNOTATIONS, "none")
    if truth.labelled is not None:
        received = (
            f"labels in {int(truth.labelled.sum())} of {len(frames)}: interpolate them, or take detections of these"
        )
        raise DatasetError(f"sequence {sequence.name}", "a truth of every frame to tune by", received)
    alike = {name for label in parameters.labels for name in (label, *rules.neighbours.get(label, ()))}
    kept = truth.take(np.isin(truth.names, sorted(alike)))
    rotation, translation = stack_poses(sequence.poses)
    return Clip(
        name=sequence.name,
        labels=parameters.labels,
        frames=tuple(tracker_frame(parameters, sequence.name, frame) for frame in frames),
        rotation=rotation,
        translation=translation,
        camera=getattr(sequence, "camera", None),
        truth=kept.to_sensor(sequence.poses),
        world=kept,
    )


def of_class(clip: Clip, name: str, rules: Rules) -> Clip:
    """Return a clip with the detections and the truth of one class only, for parameters with this class only."""
    index = clip.labels.index(name)
    frames = []
    for frame in clip.frames:
        chosen = np.flatnonzero(frame.label == index)
        columns = {key: column[chosen] for key in _DETECTION_COLUMNS if (column := getattr(frame, key)) is not None}
        frames.append(replace(frame, label=np.zeros(len(chosen), dtype=np.int64), labels=(name,), **columns))
    rows = np.isin(clip.truth.names, (name, *rules.neighbours.get(name, ())))
    return replace(clip, labels=(name,), frames=tuple(frames), truth=clip.truth.take(rows), world=clip.world.take(rows))


def track_clip(
    clip: Clip, parameters: Parameters, modules: Modules | None = None, *, every_frame: bool = False
) -> FullTable:
    """Return the tracks of a clip in the world frame, with image boxes where there is a camera.

    With `every_frame` it also steps through frames in which nothing can happen; the tracks are the same.
    """
    tracker = Tracker(parameters, modules)
    least = min(one.score_filter for one in parameters.classes.values())
    density, found = tracker.initial(), dict[int, Tracks]()
    for index, frame in enumerate(clip.frames):
        # Nothing there and nothing new: the step would give the same density with another stamp, which nothing reads.
        empty = not len(density.bernoulli) and not len(density.poisson)
        if empty and not every_frame and not (frame.score >= least).any():
            continue
        result = tracker.step(density, frame)
        density = result.density
        found[index] = result.tracks
    table = full_table(parameters.labels, found)
    if clip.camera is None or not len(table):
        return table
    place = clip.rotation[table.frame], clip.translation[table.frame]
    center, yaw = to_sensor(*place, table.center, table.yaw)
    return replace(table, box2d=clip.camera.boxes(center, table.size, yaw, LEAST_SHOWN)[0])  # as in result files
