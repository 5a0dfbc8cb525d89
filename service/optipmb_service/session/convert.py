"""Between the messages of the wire and the values of the tracker.

Conventions: a message says itself whether its arrays are in the `world` or in the `sensor` frame; the tracker's frame
is always the world (right-handed, z up, metres, radians), and so are the tracks that go out. Nothing is copied that can
be viewed.
"""

from __future__ import annotations

from functools import lru_cache
from math import isfinite
from operator import attrgetter
from struct import unpack
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optipmb_schemas as schemas

import optipmb
from optipmb.model.attributes import Readings, shown_of, words_of
from optipmb.model.frame import Embedding, frame_of_checked
from optipmb.model.rows import read_only
from optipmb.model.table import ClassTable
from optipmb_service.session.outputs import TrackedFrame

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_service.session.timeline import FrameId

    Motions = Sequence[optipmb.Relocation]

IDENTITY = optipmb.Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))
"""The pose of arrays that are in the world frame already."""

_intervals: Final = attrgetter("azimuth", "elevation", "range")
_boxes: Final = attrgetter("label", "center", "size", "yaw", "score", "velocity")


def pose_of(message: schemas.Detections | schemas.Points, ahead: Motions = ()) -> optipmb.Pose | None:
    """Return the pose of what a message holds after motions of the world, or None for the world itself.

    Raises:
        optipmb.FrameError: the pose is missing or no rigid motion.
    """
    if message.frame == "world":
        return _moved(IDENTITY, ahead) if ahead else None
    if message.pose is None:
        raise optipmb.FrameError("pose", "the pose of the sensor", "nothing")
    return _moved(_pose(message.pose.translation.tobytes(), message.pose.quaternion.tobytes()), ahead)


def _moved(pose: optipmb.Pose, ahead: Motions) -> optipmb.Pose:
    for motion in ahead:
        pose = motion.pose(pose)
    return pose


@lru_cache(1024)
def _pose(translation: bytes, quaternion: bytes) -> optipmb.Pose:
    """Return a pose, of which many sensors have the same in every message."""
    return optipmb.Pose(np.frombuffer(translation), np.frombuffer(quaternion))


def view_of(message: schemas.Detections, ahead: Motions = ()) -> optipmb.FieldOfView | None:
    """Return the field of view of a frame in the axes of its sensor, None when the sensor sees everything.

    Args:
        message: the message of the frame.
        ahead: motions of the world since.

    Raises:
        optipmb.FrameError: an interval is none.
    """
    if message.field_of_view is None:
        return None
    view, pose = _view(*(interval.tobytes() for interval in _intervals(message.field_of_view))), message.pose
    if pose is None:
        return view
    return view.at(_moved(_pose(pose.translation.tobytes(), pose.quaternion.tobytes()), ahead))


@lru_cache(1024)
def _view(*intervals: bytes) -> optipmb.FieldOfView:
    """Return a field of view without its pose; a sensor has the same in every message."""
    azimuth, elevation, distance = (unpack("2d", interval) for interval in intervals)
    return optipmb.FieldOfView(azimuth, elevation, distance)


def cloud_of(message: schemas.Points, ahead: Motions = ()) -> optipmb.PointCloud:
    """Return the cloud as the tracker reads it, after motions of the world.

    Raises:
        optipmb.FrameError: wrong shape or pose.
    """
    return optipmb.PointCloud(xyz=message.xyz, pose=pose_of(message, ahead) or IDENTITY)


def frame_of(
    parameters: optipmb.Parameters, message: schemas.Detections, ahead: Motions = ()
) -> tuple[optipmb.Frame, int]:
    """Return the frame without its cloud, and how many objects were left out because the profile lacks their class.

    Motions of the world since the message bring the frame to the newest one.

    The message was checked when it was made, within bounds that no frame has narrower: arrays are shared, not looked at
    once more.

    Raises:
        optipmb.FrameError: a pose or covariance is none, or an object is too far in the world frame; `path` names it.
    """
    columns, pose, spread = _boxes(message), pose_of(message, ahead), message.position_covariance
    view, looks = view_of(message, ahead), None
    if message.embedding is not None and message.embedding_model is not None:
        looks = Embedding(message.embedding_model, message.embedding)
    texts, given = message.attributes or (), None
    if texts:
        row, score = np.array([one.row for one in texts], np.int64), np.array([one.score for one in texts], np.float64)
        given = Readings(row, words_of([one.name for one in texts]), words_of([one.text for one in texts]), score)
    rest = pose, None, view, spread, looks, given
    return frame_of_checked(parameters, message.stamp_ns, message.labels, columns, *rest)


def unknown_labels(parameters: optipmb.Parameters, message: schemas.Detections) -> dict[str, int]:
    """Return the classes that the profile lacks, with the number of objects of each in the message."""
    missing = (optipmb.class_indices(message.labels, parameters.labels) < 0).nonzero()[0]
    if not len(missing):
        return {}
    counts = np.bincount(message.label, minlength=len(message.labels))
    unknown: dict[str, int] = {}
    for index in missing.tolist():
        if counts[index]:
            name = message.labels[index]
            unknown[name] = unknown.get(name, 0) + int(counts[index])
    return unknown


def density_of(
    density: optipmb.Density, *, stream: str, session: str, parameters: optipmb.Parameters
) -> schemas.Density:
    """Return the message for the Poisson components of a density."""
    poisson, live = density.poisson, None if density.rejoining is None else density.rejoining.live
    decided: dict[str, Any] = {}
    if live is not None:
        rows = live.object >= 0
        chance = live.candidate_probability[rows].astype(np.float32)
        decided = {"track": live.id[rows], "candidate": live.candidate[rows], "candidate_probability": chance}
    return schemas.Density(
        stream=stream,
        session=session,
        stamp_ns=density.stamp_ns if density.stamp_ns >= 0 else None,
        labels=tuple(parameters.classes),
        label=poisson.label,
        weight=poisson.weight,
        mean=poisson.mean,
        covariance=poisson.covariance,
        z=ClassTable.of(parameters).known_boxes(poisson.label, poisson.auxiliary)[:, 3],
        **decided,
    )


def attributes_of(density: optipmb.Density, identity: Sequence[int]) -> tuple[schemas.Attribute, ...]:
    """Return the attributes of tracks, by their ids."""
    if density.attributes is None or not len(identity):
        return ()
    found = shown_of(density.attributes, np.array(identity, np.int64))
    return schemas.attributes_by_name(found, len(identity))


def tracks_of(result: optipmb.StepResult, stream: str, frame_id: FrameId, **fields: Any) -> TrackedFrame:
    """Return the tracks of a frame, with paths and classes if there are any.

    What the tracker made of checked detections needs one look, not the checks of a message from elsewhere; where that
    look finds something odd, those checks name the error.

    Args:
        result: of the step.
        stream: of the tracks.
        frame_id: of the frame.
        fields: the fields of the message from `session` to `labels`, in its order.

    Raises:
        schemas.MessageError: the tracks hold numbers that no message may.
    """
    tracks = result.tracks
    header: dict[str, Any] = {
        "stream": stream,
        "epoch": frame_id.epoch,
        "seq": frame_id.seq,
        "stamp_ns": frame_id.stamp_ns,
        **({"sensor": frame_id.sensor} if frame_id.sensor else {}),
        **fields,
    }
    others: dict[str, Any] = {}
    sound, pi = optipmb.sound(tracks), result.class_probability
    if result.measured is not None:
        others["measured"] = read_only(result.measured.astype(np.int64))
    if pi is not None:
        others["class_probability"], sound = read_only(pi.astype(np.float32)), sound and isfinite(pi.sum())
    if (joined := result.joined) is not None:  # ids of tracks and products of probabilities
        probability = joined.probability.astype(np.float32)
        others |= {"object": read_only(joined.object), "object_probability": read_only(probability)}
    if known := attributes_of(result.density, tracks.id.tolist()):
        others["attributes"] = known
    if (paths := result.paths) is not None:
        others |= schemas.path_fields(paths.horizons, paths.mean, paths.covariance)
    if not sound:
        columns: dict[str, Any] = dict(tracks.columns()) | {"confirmed": tracks.confirmed.astype(np.int64)}
        schemas.Tracks(**header, **columns, **others)
    return TrackedFrame(tracks, header, others)
