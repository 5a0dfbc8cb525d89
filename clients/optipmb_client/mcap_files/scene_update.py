"""Tracks as `foxglove.SceneUpdate`, which Foxglove draws in 3D: boxes, velocity arrows, ids.

World frame, metres. A track is the entity of its id; it stays until an update deletes it. Each update holds every track
of its frame, so a viewer may start at any of them.
"""

import math
from collections.abc import Iterable

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.schema import build_file_descriptor_set
from optipmb_schemas import Tracks

from optipmb_client.colours import rgb_of

__all__ = ["SCHEMA_NAME", "scene_schema", "scene_update"]

SCHEMA_NAME: str = SceneUpdate.DESCRIPTOR.full_name
FRAME = "world"
ARROW_S = 1.0  # an arrow is as long as the way of one second
SLOW = 0.3  # m/s below which there is no arrow
TEXT_M = 0.8


def scene_schema() -> bytes:
    """Return the protobuf description of the messages, as MCAP wants it."""
    described: bytes = build_file_descriptor_set(SceneUpdate).SerializeToString()
    return described


def scene_update(tracks: Tracks, gone: Iterable[int] = ()) -> bytes:
    """Return the tracks of one frame as a serialised SceneUpdate, which takes away the tracks `gone`."""
    stamp = Timestamp(seconds=tracks.stamp_ns // 10**9, nanos=tracks.stamp_ns % 10**9)
    update = SceneUpdate()
    for identity in gone:
        update.deletions.add(timestamp=stamp, type=SceneEntityDeletion.MATCHING_ID, id=str(identity))
    for row, identity in enumerate(tracks.id.tolist()):
        red, green, blue = (value / 255.0 for value in rgb_of(identity))
        center, size = tracks.center[row].tolist(), tracks.size[row].tolist()
        existence = float(tracks.existence[row])
        speed = math.hypot(*tracks.velocity[row].tolist())
        entity = update.entities.add(timestamp=stamp, frame_id=FRAME, id=str(identity))
        for key, value in (
            ("class", tracks.labels[int(tracks.label[row])]),
            ("existence", f"{existence:.3f}"),
            ("score", f"{tracks.score[row]:.3f}"),
            ("speed", f"{speed:.2f} m/s"),
            ("age", f"{tracks.age[row]:.1f} s"),
        ):
            entity.metadata.add(key=key, value=value)
        entity.cubes.add(
            pose=_pose(center, float(tracks.yaw[row])),
            size=_vector(size),
            color=Color(r=red, g=green, b=blue, a=0.2 + 0.6 * existence),
        )
        if speed > SLOW:
            course = math.atan2(float(tracks.velocity[row, 1]), float(tracks.velocity[row, 0]))
            entity.arrows.add(
                pose=_pose(center, course),
                shaft_length=ARROW_S * speed,
                shaft_diameter=0.15,
                head_length=0.5,
                head_diameter=0.4,
                color=Color(r=red, g=green, b=blue, a=1.0),
            )
        above = [center[0], center[1], center[2] + 0.5 * size[2] + TEXT_M]
        entity.texts.add(
            pose=_pose(above, 0.0),
            billboard=True,
            font_size=TEXT_M,
            color=Color(r=red, g=green, b=blue, a=1.0),
            text=str(identity),
        )
    return update.SerializeToString(deterministic=True)


def _pose(position: list[float], yaw: float) -> Pose:
    return Pose(position=_vector(position), orientation=Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw)))


def _vector(values: list[float]) -> Vector3:
    x, y, z = values
    return Vector3(x=x, y=y, z=z)
