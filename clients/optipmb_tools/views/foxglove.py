"""Messages in the types that Foxglove draws by itself: for recordings, and live over a WebSocket.

World frame, metres. Below the key of a message stand

- of tracks: `/scene` (`foxglove.SceneUpdate`: boxes, velocity arrows, ids) and `/figures` (JSON, for plots);
- of detections: `/scene` (grey boxes) and `/pose` (`foxglove.FrameTransform`: where the sensor is);
- of points: `/cloud` (`foxglove.PointCloud`);
- of problems: `/log` (`foxglove.Log`).

A track is the entity of its id; it stays until an update deletes it. Each update holds every track of its frame, so a
viewer may start at any of them.
"""

import json
import math
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple, Self

import foxglove
import numpy as np
from foxglove import Channel, Context, Schema
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    FrameTransform,
    KeyValuePair,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    TextPrimitive,
    Timestamp,
    Vector3,
)
from optipmb_client.errors import UsageError
from optipmb_schemas import Detections, Message, Points, Problem, Tracks

from optipmb_tools.geometry import rotation_of, shown_boxes, to_world
from optipmb_tools.views.colours import identities_of, rgb_of

FRAME: Final = "world"
ARROW_S: Final = 1.0  # an arrow is as long as the way of one second
SLOW: Final = 0.3  # m/s below which there is no arrow
TEXT_M: Final = 0.8
SURE: Final = 0.5
GREY: Final = Color(r=0.5, g=0.5, b=0.5, a=0.35)

_NUMBER: Final = {"type": "number"}
_FIGURES: Final = Schema(
    name="optipmb.Figures",
    encoding="jsonschema",
    data=json.dumps(
        {
            "type": "object",
            "properties": dict.fromkeys(("tracks", "surer_tracks", "ignored", "queue_ms", "step_ms"), _NUMBER),
        },
        sort_keys=True,
    ).encode(),
)


class Shown(NamedTuple):
    """A message for Foxglove: end of its topic's name, schema, encoding and bytes."""

    end: str
    schema: Schema
    encoding: str
    payload: bytes


class FoxgloveMessages:
    """Converts messages; remembers which tracks of each stream are shown, to delete ended ones."""

    def __init__(self) -> None:
        self._shown: dict[str, set[int]] = {}

    def of(self, message: Message) -> Iterator[Shown]:
        """Yield the messages that show one; none for other types."""
        if isinstance(message, Tracks):
            shown = set(identities_of(message))
            gone = sorted(self._shown.get(message.stream, set()) - shown)
            self._shown[message.stream] = shown
            yield _made("/scene", _scene(message, gone))
            yield Shown("/figures", _FIGURES, "json", _figures(message))
        elif isinstance(message, Detections):
            yield _made("/scene", _boxes(message))
            if message.pose is not None:
                yield _made("/pose", _transform(message))
        elif isinstance(message, Points):
            yield _made("/cloud", _cloud(message))
        elif isinstance(message, Problem):
            yield _made("/log", _log(message))


def _made(end: str, message: SceneUpdate | FrameTransform | PointCloud | Log) -> Shown:
    return Shown(end, message.get_schema(), "protobuf", message.encode())


def _scene(tracks: Tracks, gone: Iterable[int]) -> SceneUpdate:
    stamp = _stamp(tracks.stamp_ns)
    matching = SceneEntityDeletionType.MatchingId
    deletions = [SceneEntityDeletion(timestamp=stamp, type=matching, id=str(identity)) for identity in gone]
    entities = []
    for row, identity in enumerate(identities_of(tracks)):
        red, green, blue = (value / 255.0 for value in rgb_of(identity))
        solid = Color(r=red, g=green, b=blue, a=1.0)
        center, size = tracks.center[row].tolist(), tracks.size[row].tolist()
        existence = float(tracks.existence[row])
        speed = math.hypot(*tracks.velocity[row].tolist())
        metadata = [
            KeyValuePair(key=key, value=value)
            for key, value in (
                ("class", tracks.labels[int(tracks.label[row])]),
                ("existence", f"{existence:.3f}"),
                ("score", f"{tracks.score[row]:.3f}"),
                ("speed", f"{speed:.2f} m/s"),
                ("age", f"{tracks.age[row]:.1f} s"),
            )
        ]
        cube = CubePrimitive(
            pose=_pose(center, float(tracks.yaw[row])),
            size=_vector(size),
            color=Color(r=red, g=green, b=blue, a=0.2 + 0.6 * existence),
        )
        course = math.atan2(float(tracks.velocity[row, 1]), float(tracks.velocity[row, 0]))
        arrow = ArrowPrimitive(
            pose=_pose(center, course),
            shaft_length=ARROW_S * speed,
            shaft_diameter=0.15,
            head_length=0.5,
            head_diameter=0.4,
            color=solid,
        )
        above = [center[0], center[1], center[2] + 0.5 * size[2] + TEXT_M]
        text = TextPrimitive(pose=_pose(above, 0.0), billboard=True, font_size=TEXT_M, color=solid, text=str(identity))
        entities.append(
            SceneEntity(
                timestamp=stamp,
                frame_id=FRAME,
                id=str(identity),
                metadata=metadata,
                cubes=[cube],
                arrows=[arrow] if speed > SLOW else [],
                texts=[text],
            )
        )
    return SceneUpdate(deletions=deletions, entities=entities)


def _figures(tracks: Tracks) -> bytes:
    figures: dict[str, float] = {
        "tracks": len(tracks.id),
        "surer_tracks": int((tracks.score >= SURE).sum()),
        "ignored": tracks.ignored,
    }
    if tracks.delivery is not None:
        figures |= {"queue_ms": tracks.delivery.queue_ms, "step_ms": tracks.delivery.step_ms}
    return json.dumps(figures, sort_keys=True).encode()


def _boxes(detections: Detections) -> SceneUpdate:
    """Return one entity with all boxes: each update replaces the previous one."""
    size, yaw = shown_boxes(detections)
    center = np.nan_to_num(detections.center)
    if detections.frame == "sensor" and (pose := detections.pose) is not None:
        center, yaw = to_world(rotation_of(pose.quaternion), pose.translation, center, yaw)
    cubes = [
        CubePrimitive(pose=_pose(place, turn), size=_vector(sides), color=GREY)
        for place, turn, sides in zip(center.tolist(), yaw.tolist(), size.tolist(), strict=True)
    ]
    stamp = _stamp(detections.stamp_ns)
    return SceneUpdate(entities=[SceneEntity(timestamp=stamp, frame_id=FRAME, id="detections", cubes=cubes)])


def _transform(detections: Detections) -> FrameTransform:
    assert detections.pose is not None  # noqa: S101  asked for where there is one
    w, x, y, z = detections.pose.quaternion.tolist()
    return FrameTransform(
        timestamp=_stamp(detections.stamp_ns),
        parent_frame_id=FRAME,
        child_frame_id=detections.stream,
        translation=_vector(detections.pose.translation.tolist()),
        rotation=Quaternion(w=w, x=x, y=y, z=z),
    )


def _cloud(points: Points) -> PointCloud:
    pose = _pose([0.0, 0.0, 0.0], 0.0)
    if points.frame == "sensor" and points.pose is not None:
        w, x, y, z = points.pose.quaternion.tolist()
        pose = Pose(position=_vector(points.pose.translation.tolist()), orientation=Quaternion(w=w, x=x, y=y, z=z))
    number = PackedElementFieldNumericType.Float32
    return PointCloud(
        timestamp=_stamp(points.stamp_ns),
        frame_id=FRAME,
        pose=pose,
        point_stride=12,
        fields=[PackedElementField(name=name, offset=4 * column, type=number) for column, name in enumerate("xyz")],
        data=np.ascontiguousarray(points.xyz, dtype="<f4").tobytes(),
    )


def _log(problem: Problem) -> Log:
    level = LogLevel.Warning
    return Log(timestamp=_stamp(problem.stamp_ns or 0), level=level, message=problem.message, name=problem.code)


def _stamp(stamp_ns: int) -> Timestamp:
    return Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9)


def _pose(position: list[float], yaw: float) -> Pose:
    turn = Quaternion(x=0.0, y=0.0, z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))
    return Pose(position=_vector(position), orientation=turn)


def _vector(values: list[float]) -> Vector3:
    x, y, z = values
    return Vector3(x=x, y=y, z=z)


_TOPICS: dict[type[Message], str] = {Tracks: "tracks", Detections: "detections", Points: "points", Problem: "problems"}


class FoxgloveServer:
    """A server that shows messages of any streams; a viewer that is too slow loses the oldest.

    Args:
        host: address to listen on.
        port: 0: any that is free.

    Raises:
        UsageError: the address cannot be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        self._context = Context()
        self._made = FoxgloveMessages()
        self._channels: dict[str, Channel] = {}
        try:
            self._server = foxglove.start_server(name="optipmb", host=host, port=port, context=self._context)
        except RuntimeError as error:
            raise UsageError(f"--foxglove-port {port}: cannot listen on {host}: {error}") from error
        self.address = f"ws://{host}:{self._server.port}"

    def show(self, message: Message) -> None:
        """Show a message at its stamp; of another type than streams have, nothing."""
        stream, stamp_ns = getattr(message, "stream", ""), getattr(message, "stamp_ns", None)
        for one in self._made.of(message):
            topic = f"/{stream}/{_TOPICS[type(message)]}{one.end}"
            if topic not in self._channels:
                self._channels[topic] = Channel(
                    topic, schema=one.schema, message_encoding=one.encoding, context=self._context
                )
            self._channels[topic].log(one.payload, log_time=stamp_ns)

    def close(self) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
