"""Conversion of messages between ROS 2 and the service, and the state of the bridge as `DiagnosticArray`.

Detections and clouds need the pose of their frame. They wait for it, at most `tf_wait_s` and at most `WAITING` of them
per stream, and go out in the order in which they came. Refused and lost messages are counted, and reported as problems
of the stream.
"""

from __future__ import annotations

import collections
import math
import secrets
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import optipmb_schemas as schemas
from optipmb_schemas.ros2 import arrays, tracks
from optipmb_schemas.ros2.cpm import CPM, cpm_fields
from optipmb_schemas.ros2.transforms import TransformError, Transforms

from optipmb_service.edges.cpm import Station, station_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from optipmb_service.edges.ros2.node import Ros2Node
    from optipmb_service.settings import Ros2Stream, Settings

Kind = Literal["detections", "points"]

DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = range(4)
WAITING: Final[dict[Kind, int]] = {"detections": 64, "points": 16}
"""Messages of a stream that wait for their pose."""
KEPT: Final = 4096
"""Stamps of each moving frame: 40 s at 100 Hz."""
FRAMES: Final = 2000
ASK_S: Final = 5.0
"""Time between two requests for the predicted paths of a stream."""
RESTART_S: Final = 5.0
"""Longest wait for a session that is to restart."""
CLOUDS_S: Final = 2.0
"""Without a cloud for so long none is waited for."""
OBJECTS: Final = 20
"""Objects of a CPM, so that its encoding fits into one packet on the air."""
CLOCK_BACK_NS: Final = 5 * 10**9
"""Stamps of detections that go back by more: the clock was set back, as of a simulation that restarts."""


@dataclass
class _Pending:
    kind: Kind
    message: Any
    stamp_ns: int
    deadline_s: float
    arrived_s: float


@dataclass
class _Stream:
    name: str
    topics: Ros2Stream
    epoch: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    world: str = ""
    """Frame of the tracks; empty before the first pose."""
    restart_s: float = -math.inf
    """Until when messages wait for the session to restart in another world; clock of the bridge."""
    ended: str = ""
    """Id of the session in the world before, whose tracks may still come."""
    waiting: dict[Kind, collections.deque[_Pending]] = field(
        default_factory=lambda: {"detections": collections.deque(), "points": collections.deque()}
    )
    arrived: collections.OrderedDict[int, float] = field(default_factory=collections.OrderedDict)
    cloud_s: float = -math.inf
    """When the newest cloud came; clock of the bridge."""
    newest_ns: int = -1
    """Stamp of the newest detections."""
    ask_s: float = -math.inf
    """When predicted paths may be asked for again; clock of the bridge."""
    session: str = ""
    """Id of the session of these tracks."""
    shown_ns: int = -1
    """Stamp of the newest tracks that went to ROS."""
    newest_s: float | None = None
    """When the newest detections came; clock of the bridge."""
    latency_ms: float = 0.0
    """Of the newest tracks, from the arrival of the detections."""
    sent: collections.Counter[Kind] = field(default_factory=collections.Counter)
    refused: int = 0
    tracks: int = 0
    problems: int = 0
    diagnosed: int = 0
    """Problems at the last diagnosis."""
    problem: str = ""
    """The newest of the bridge."""
    service_problem: str = ""
    """The newest of the service."""
    station: Station | None = None
    """Sender of its CPM."""
    left_out: collections.Counter[str] = field(default_factory=collections.Counter)
    """Objects without a place in the CPM, by reason."""


class Ros2Bridge:
    """The streams of the settings, and the transforms that they share. Not for several threads."""

    def __init__(self, settings: Settings, node: Ros2Node) -> None:
        self._settings = settings.ros2
        self._instance = settings.instance
        self._stale_s = settings.stale_s
        self._node = node
        self._transforms = Transforms(kept=KEPT, frames=FRAMES)
        self._streams = {name: _Stream(name, topics) for name, topics in settings.ros2.streams.items()}
        for name, one in self._streams.items():
            one.station = station_of(settings, name, OBJECTS) if one.topics.cpm else None

    def take_transforms(self, message: Any, *, static: bool) -> None:
        """Apply a `TFMessage`; messages that waited for it go out.

        Raises:
            MessageError: one of them is no transform, the first such one; the others are taken.
        """
        wrong: list[schemas.MessageError] = []
        for row, one in enumerate(message.transforms):
            place, turn = one.transform.translation, one.transform.rotation
            try:
                self._add(f"transforms[{row}]", one.header, one.child_frame_id, place, turn, static=static)
            except schemas.MessageError as error:
                wrong.append(error)
        self.go_on()
        if wrong:
            raise wrong[0]

    def take_odometry(self, message: Any) -> None:
        """Apply an `Odometry` as the transform of its child frame.

        Raises:
            MessageError: it is no pose.
        """
        pose = message.pose.pose
        self._add("pose", message.header, message.child_frame_id, pose.position, pose.orientation, static=False)
        self.go_on()

    def take(self, stream: str, kind: Kind, message: Any) -> None:
        """Accept detections or a cloud of a stream; it goes out as soon as its pose is known."""
        one, now = self._streams[stream], time.monotonic()
        if kind == "detections":
            one.newest_s = now
        else:
            one.cloud_s = now
        try:
            stamp_ns = _stamp(message.header)
        except schemas.MessageError as error:
            self._refuse(one, error)
            return
        if kind == "detections":
            if stamp_ns < one.newest_ns - CLOCK_BACK_NS:
                self._transforms.drop_after(stamp_ns + CLOCK_BACK_NS)
                one.shown_ns = -1
                self._tell(
                    one, "clock_back", f"the clock went back by {(one.newest_ns - stamp_ns) / 1e9:.1f} s", stamp_ns
                )
                one.newest_ns = stamp_ns
            one.newest_ns = max(one.newest_ns, stamp_ns)
        queue = one.waiting[kind]
        queue.append(_Pending(kind, message, stamp_ns, now + self._settings.tf_wait_s, now))
        if len(queue) > WAITING[kind]:
            shed = queue.popleft()
            self._tell(one, "shed", f"more than {WAITING[kind]} {kind} wait for their pose", shed.stamp_ns)
        self.go_on()

    def refuse(self, stream: str, error: schemas.MessageError) -> None:
        """Count and report a message that cannot be read."""
        self._refuse(self._streams[stream], error)

    def go_on(self) -> None:
        """Send messages whose poses are known, drop messages that waited for too long; to be called regularly."""
        now = time.monotonic()
        for stream in self._streams.values():
            for queue in stream.waiting.values():
                while queue and now >= stream.restart_s and self._sent(stream, queue[0], now):
                    queue.popleft()

    def take_tracks(self, message: schemas.Tracks) -> None:
        """Publish the tracks of a stream to ROS, but for frames before the newest one.

        Raises:
            MessageError: ROS has no place for a value of theirs.
        """
        stream = self._streams[message.stream]
        if time.monotonic() < stream.restart_s or message.session == stream.ended:
            return
        if message.session != stream.session and not message.revision:
            stream.session, stream.shown_ns = message.session, -1  # its clock may have stepped back
        if message.stamp_ns < stream.shown_ns or message.epoch != stream.epoch:
            return  # a repetition after a restart, or a late correction: ROS expects stamps that ascend
        arrived = stream.arrived.get(message.stamp_ns)
        if arrived is not None:
            stream.latency_ms = 1e3 * (time.monotonic() - arrived)
        stream.tracks += 1
        if not tracks.has_paths(message):
            self._ask_paths(stream, message)
        made = tracks.messages(self._node.types, message, message.stamp_ns, stream.world, stream.name)
        for end, one in made:
            self._node.publish(stream.topics.tracks_topic + end, one)
        stream.shown_ns = message.stamp_ns
        if stream.station is not None and not stream.station.predicted:
            self._perceive(stream, stream.station, message)

    def take_predicted(self, message: schemas.Tracks) -> None:
        """Publish the CPM of predicted tracks.

        Raises:
            MessageError: ROS has no place for a value of theirs.
        """
        stream = self._streams[message.stream]
        if stream.station is not None and message.epoch == stream.epoch and message.session != stream.ended:
            self._perceive(stream, stream.station, message)

    def _perceive(self, stream: _Stream, station: Station, message: schemas.Tracks) -> None:
        for one in station.messages(message, stream.left_out):
            made = self._node.types.new(CPM, **cpm_fields(one["message"], station.perceived))
            self._node.publish(f"{stream.topics.tracks_topic}/cpm", made)

    def take_problem(self, problem: schemas.Problem) -> None:
        """Note a problem that the service reports of a stream."""
        if problem.instance != self._instance and (stream := self._streams.get(problem.stream)) is not None:
            stream.problems += 1
            stream.service_problem = f"{problem.instance}: {problem.message}"

    def diagnose(self, mismatches: tuple[str, ...]) -> None:
        """Publish the state of all streams, and the endpoints of others that do not fit."""
        statuses = []
        for name, one in self._streams.items():
            level, text = OK, "tracking"
            if one.newest_s is None or time.monotonic() - one.newest_s > self._stale_s:
                level, text = STALE, "no detections"
            elif one.problems > one.diagnosed:
                level, text = WARN, "; ".join(filter(None, (one.problem, one.service_problem)))
            elif not one.tracks:
                level, text = WARN, "no tracks come back: is optipmb-service running, with the same prefix?"
            one.diagnosed = one.problems
            values = {
                "detections": one.sent["detections"],
                "points": one.sent["points"],
                "refused": one.refused,
                "tracks": one.tracks,
                "latency_ms": f"{one.latency_ms:.1f}",
                "problems": one.problems,
                "cpm_left_out": one.left_out.total(),
                "last_problem": one.problem,
                "last_service_problem": one.service_problem,
            }
            statuses.append(self._status(level, name, text, values))
        values = {f"mismatch_{number}": line for number, line in enumerate(mismatches)}
        level, text = (ERROR, mismatches[0]) if mismatches else (OK, "all endpoints fit")
        statuses.append(self._status(level, "topics", text, values))
        header = tracks.header_of(time.time_ns(), "")
        message = self._node.types.new(DIAGNOSTICS, header=header, status=statuses)
        self._node.publish(self._settings.diagnostics, message)

    def _status(self, level: int, name: str, text: str, values: Mapping[str, object]) -> dict[str, Any]:
        pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
        about = {"level": level, "name": f"optipmb: {name}", "message": text}
        return about | {"hardware_id": self._instance, "values": pairs}

    def _ask_paths(self, stream: _Stream, message: schemas.Tracks) -> None:
        """Have the session predict paths at the horizons of ROS, in addition to its own."""
        now, present = time.monotonic(), () if message.horizons is None else message.horizons.tolist()
        horizons = sorted({*tracks.HORIZONS, *present})
        if now < stream.ask_s or len(horizons) > schemas.DEFAULT.max_horizons:
            return
        if self._node.listened(f"{stream.topics.tracks_topic}/predicted"):
            stream.ask_s = now + ASK_S
            self._node.set_parameters(stream.name, schemas.SessionParameters(horizons=np.array(horizons)))

    def _sent(self, stream: _Stream, waiting: _Pending, now: float) -> bool:
        """Send or drop a message; False while it has to wait."""
        frame = arrays.frame_of(waiting.message.header)
        try:
            pose = self._pose(stream, frame, waiting.stamp_ns)
        except TransformError as error:
            if error.later and now < waiting.deadline_s:
                return False
            waited = f" (waited {now - waiting.arrived_s:.1f} s)" if error.later else ""
            self._tell(
                stream, "no_pose", f"{waiting.kind} in frame {frame!r} left out: {error}{waited}", waiting.stamp_ns
            )
            return True
        except schemas.MessageError as error:
            self._refuse(stream, error)
            return True
        try:
            self._node.send(stream.name, self._message(stream, waiting, pose))
        except schemas.MessageError as error:
            self._refuse(stream, error, waiting.stamp_ns)
            return True
        stream.sent[waiting.kind] += 1
        if waiting.kind == "detections":
            stream.arrived[waiting.stamp_ns] = waiting.arrived_s
            if len(stream.arrived) > WAITING["detections"]:
                stream.arrived.popitem(last=False)
        return True

    def _message(self, stream: _Stream, waiting: _Pending, pose: schemas.Pose) -> schemas.Detections | schemas.Points:
        header: Any = {
            "stream": stream.name,
            "epoch": stream.epoch,
            "seq": stream.sent[waiting.kind],
            "stamp_ns": waiting.stamp_ns,
            "frame": "sensor",
            "pose": pose,
        }
        if waiting.kind == "points":
            return schemas.Points(**header, xyz=arrays.points_of(waiting.message))
        boxes = arrays.boxes_of(waiting.message, stream.topics.classes, covariance=stream.topics.covariance)
        return schemas.Detections(**header, **vars(boxes), has_points=self._has_points(stream))

    def _has_points(self, stream: _Stream) -> bool | None:
        """Whether the service shall wait for a cloud: while clouds come, and before it is known whether they do."""
        if not stream.topics.points:
            return False
        expected = not stream.sent["detections"] or time.monotonic() - stream.cloud_s < CLOUDS_S
        return True if expected else None

    def _pose(self, stream: _Stream, frame: str, stamp_ns: int) -> schemas.Pose:
        """Return world from frame; the world is the root of tf at the first frame, until that gets a parent."""
        world = self._settings.fixed_frame
        if not world:
            if stream.world or self._transforms.has_parent(frame):
                world = self._transforms.root(stream.world or frame)
            elif stream.topics.fixed:
                world = frame
            else:
                raise TransformError(f"frame {frame!r}: expected a transform to it in tf", later=True)
        translation, quaternion = self._transforms.lookup(world, frame, stamp_ns)
        before, stream.world = stream.world, world
        if before not in {"", world}:
            self._restart(stream, before, stamp_ns)
            raise TransformError(f"frame {frame!r}: expected a session in {world!r}", later=True)
        return schemas.Pose(translation=translation, quaternion=quaternion)

    def _restart(self, stream: _Stream, before: str, stamp_ns: int) -> None:
        """Restart the session in another world, while messages wait."""
        text = f"the root of tf is now {stream.world!r}, where tracks begin anew; it was {before!r}"
        self._tell(stream, "world_changed", f"{text}. Set `fixed_frame` to wait for a frame", stamp_ns, refused=0)
        stream.restart_s, stream.ended = time.monotonic() + RESTART_S, stream.session

        def restarted() -> None:  # on another thread: what waits goes out at the next `go_on`
            stream.restart_s = -math.inf

        self._node.set_parameters(stream.name, schemas.SessionParameters(restart=True), restarted)

    def _add(self, path: str, header: Any, child: Any, place: Any, turn: Any, *, static: bool) -> None:
        try:
            self._transforms.add(
                str(header.frame_id),
                str(child),
                arrays.stamp_of(header),
                np.array([place.x, place.y, place.z]),
                np.array([turn.w, turn.x, turn.y, turn.z]),
                static=static,
            )
        except schemas.MessageError as error:
            raise error.under(path) from None

    def _refuse(self, stream: _Stream, error: schemas.MessageError, stamp_ns: int | None = None) -> None:
        problem = schemas.Problem.of(error, stream=stream.name, instance=self._instance)
        self._report(stream, problem.model_copy(update={"stamp_ns": stamp_ns}))

    def _tell(self, stream: _Stream, code: str, text: str, stamp_ns: int, *, refused: int = 1) -> None:
        about: dict[str, Any] = {"stream": stream.name, "instance": self._instance, "code": code, "stamp_ns": stamp_ns}
        self._report(stream, schemas.Problem(**about, message=text[:500]), refused)

    def _report(self, stream: _Stream, problem: schemas.Problem, refused: int = 1) -> None:
        stream.refused += refused
        stream.problems += 1
        stream.problem = problem.message
        self._node.report(problem)


def _stamp(header: Any) -> int:
    stamp_ns = arrays.stamp_of(header)
    if stamp_ns == 0:
        expected = "a stamp above 0 (does the publisher use a simulated clock that has not started?)"
        raise schemas.MessageError("invalid_value", "header.stamp", expected, "0")
    return stamp_ns
