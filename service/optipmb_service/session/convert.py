"""Between the messages of the wire and the values of the tracker.

Conventions: a message says itself whether its arrays are in the `world` or in the `sensor` frame; the tracker's frame
is always the world (right-handed, z up, metres, radians), and so are the tracks that go out. Nothing is copied that can
be viewed.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Final

import numpy as np
import optipmb_schemas as schemas

import optipmb

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb_service.session.timeline import FrameId

IDENTITY = optipmb.Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0.0, 0.0, 0.0]))
"""The pose of arrays that are in the world frame already."""

_COLUMNS: Final = tuple(column.name for column in fields(optipmb.Tracks))


def pose_of(message: schemas.Detections | schemas.Points) -> optipmb.Pose | None:
    """Return world from sensor, or None for a message in the world frame.

    Raises:
        optipmb.FrameError: the pose is missing or no rigid motion.
    """
    if message.frame == "world":
        return None
    if message.pose is None:
        raise optipmb.FrameError("pose", "the pose of the sensor", "nothing")
    return optipmb.Pose(translation=message.pose.translation, quaternion=message.pose.quaternion)


def view_of(message: schemas.Detections) -> optipmb.FieldOfView | None:
    """Return the field of view of a frame in the axes of its sensor, None when the sensor sees everything.

    Raises:
        optipmb.FrameError: an interval is none.
    """
    if message.field_of_view is None:
        return None
    pose = message.pose
    place = None if pose is None else optipmb.Pose(translation=pose.translation, quaternion=pose.quaternion)
    return optipmb.FieldOfView.of(message.field_of_view, place)


def cloud_of(message: schemas.Points) -> optipmb.PointCloud:
    """Return the cloud as the tracker reads it.

    Raises:
        optipmb.FrameError: wrong shape or pose.
    """
    return optipmb.PointCloud(xyz=message.xyz, pose=pose_of(message) or IDENTITY)


def frame_of(parameters: optipmb.Parameters, message: schemas.Detections) -> tuple[optipmb.Frame, int]:
    """Return the frame without its cloud, and how many objects were left out because the profile lacks their class.

    Raises:
        optipmb.FrameError: wrong shapes or values; `path` names the field and the element.
    """
    return optipmb.make_frame(
        parameters,
        stamp_ns=message.stamp_ns,
        labels=message.labels,
        label=message.label,
        center=message.center,
        size=message.size,
        yaw=message.yaw,
        score=message.score,
        velocity=message.velocity,
        pose=pose_of(message),
        field_of_view=view_of(message),
        position_covariance=message.position_covariance,
    )


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
    poisson = density.poisson
    return schemas.Density(
        stream=stream,
        session=session,
        stamp_ns=density.stamp_ns if density.stamp_ns >= 0 else None,
        labels=tuple(parameters.classes),
        label=poisson.label,
        weight=poisson.weight,
        mean=poisson.mean,
        covariance=poisson.covariance,
        z=poisson.auxiliary[:, 3],
    )


def tracks_of(  # noqa: PLR0913 - all keywords, each a field of the message
    tracks: optipmb.Tracks,
    paths: optipmb.PredictedPaths | None,
    class_probability: NDArray[np.float64] | None = None,
    *,
    stream: str,
    frame_id: FrameId,
    session: str,
    revision: int,
    parameters: optipmb.Parameters,
    cloud_used: bool,
    gap: int,
    ignored: int,
) -> schemas.Tracks:
    """Return the message for the tracks of a frame, with paths and classes if there are any, without its delivery part.

    What the tracker made of checked detections needs one look, not the checks of a message from elsewhere; where that
    look finds something odd, those checks say what it is.

    Raises:
        schemas.MessageError: the tracks hold numbers that no message may.
    """
    make = schemas.Tracks.trusted if optipmb.sound(tracks) else schemas.Tracks
    for name in _COLUMNS:
        getattr(tracks, name).setflags(write=False)  # they are the message's now, which so needs no views of them
    class_fields = {} if class_probability is None else schemas.class_fields(class_probability)
    path_fields = {} if paths is None else schemas.path_fields(paths.horizons, paths.mean, paths.covariance)
    return make(
        stream=stream,
        sensor=frame_id.sensor or None,
        epoch=frame_id.epoch,
        seq=frame_id.seq,
        stamp_ns=frame_id.stamp_ns,
        session=session,
        revision=revision,
        profile=parameters.name,
        cloud_used=cloud_used,
        gap=gap,
        ignored=ignored,
        labels=parameters.labels,
        id=tracks.id,
        label=tracks.label,
        center=tracks.center,
        size=tracks.size,
        yaw=tracks.yaw,
        heading_confidence=tracks.heading_confidence,
        velocity=tracks.velocity,
        yaw_rate=tracks.yaw_rate,
        acceleration=tracks.acceleration,
        existence=tracks.existence,
        score=tracks.score,
        covariance=tracks.covariance,
        age=tracks.age,
        time_since_detection=tracks.time_since_detection,
        detection=tracks.detection,
        confirmed=tracks.confirmed.astype(np.int64),
        **class_fields,
        **path_fields,
        delivery=None,
    )
