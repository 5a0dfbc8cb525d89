"""Scenarios of the recordings: what arrives at a stream, step by step, the same in every run; and digests of outputs.

A step is a message that arrives, a group of steps that arrive before any is processed, a wait in seconds, or a command.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from fusing import FRONT, FUSED, REAR, SIDE, drive
from optipmb_schemas import (
    Delivery,
    Detections,
    FieldOfView,
    Message,
    Points,
    Pose,
    Problem,
    ResetRequest,
    SessionParameters,
    SessionState,
    Tracks,
    encode,
)
from router import Sensor
from sessions import Merged

FILE: Final = Path(__file__).with_name("recordings.json")
"""The outputs as they were recorded, by scenario and tracker."""
PROFILE: Final = Path(__file__).with_name("recordings.toml")

Command = Literal["keep", "kill", "leave", "take", "caches"]
"""keep: write a checkpoint. kill: go on from the newest one. leave, take: another process goes on; what arrives between
belongs to the stream. caches: all that the publishers' caches hold has arrived."""
Step: TypeAlias = "Detections | Points | Raw | ResetRequest | SessionParameters | Command | float | tuple[Step, ...]"


@dataclass(frozen=True)
class Raw:
    """Bytes that arrive as detections."""

    payload: bytes


SENSOR = Sensor()
NEXT = Sensor(epoch=b"n" * 16)
"""The publisher of the same stream after a restart."""
QUATERNION = np.array([0.8, 0.0, 0.0, 0.6])


def frames(seqs: Iterable[int], sensor: Sensor = SENSOR, **changes: Any) -> list[Step]:
    """Return frames in the order in which they arrive."""
    return [sensor.detections(seq, **changes) for seq in seqs]


def shifted(sensor: Sensor, seconds: float) -> Sensor:
    """Return a sensor whose clock was set."""
    return replace(sensor, start_s=sensor.start_s + seconds)


def in_order() -> list[Step]:
    """Every optional field once, and frames without objects and of classes that the profile lacks."""
    covariance = np.stack([np.diag([0.5, 0.2, 1.0]), np.full((3, 3), np.nan), np.eye(3)])
    velocity = np.array([[5.0, 0.0], [np.nan, np.nan], [4.0, 1.0]])
    view = FieldOfView(azimuth=[-1.0, 1.0], elevation=[-0.5, 0.5], range=[0, 60])
    pose = Pose(translation=np.array([1.0, 2.0, 3.0]), quaternion=QUATERNION)
    special: dict[int, dict[str, Any]] = {
        3: {"velocity": velocity, "position_covariance": covariance},
        4: {"objects": 0, "has_points": False},
        5: {"labels": ("tram", "car"), "label": np.array([0, 1, 1])},
        6: {"score": np.array([0.0, 0.1, 0.9])},
        7: {"velocity": None, "field_of_view": view},
        8: {"frame": "sensor", "pose": pose},
    }
    return [SENSOR.detections(seq, **special.get(seq, {})) for seq in range(14)]


def late() -> list[Step]:
    """Frames inside and outside the window, twice, and one from before the first; some arrive together."""
    return [
        *frames((1, 0, 3, 2, 4, 7, 5, 5, 6, 8)),
        tuple(frames((12, 10, 9, 11))),
        *frames(seq for seq in range(13, 30) if seq not in {15, 22}),
        *frames((22, 15, 2, 31, 30)),
        *frames((32,), stamp_ns=SENSOR.stamp_ns(31)),
        *frames((35, 36, 33, 34)),
    ]


def gaps() -> list[Step]:
    """Frames that are missing, some of which arrive later."""
    return frames((3, 4, 5, 8, 9, 7, 20, 21, 19, 22, 60, 61, 62))


def epochs() -> list[Step]:
    """Publishers that are restarted with stamps that go on and that jump, and two that send at once."""
    after, far = shifted(NEXT, 0.6), shifted(Sensor(epoch=b"z" * 16), 3600.0)
    return [
        *frames(range(5)),
        *frames((0, 1), after),
        *frames((5, 4, 6)),
        *frames(range(2, 12), after),
        *frames(range(20, 90, 6)),
        *frames((90, 91)),
        *frames((12, 13, 14), after),
        *frames(range(4), far),
        *frames((15,), after),
    ]


def jumps() -> list[Step]:
    """A single odd stamp, then clocks that are set ahead, back by hours and back a little."""
    hour, back, little = shifted(SENSOR, 3600.0), shifted(SENSOR, -3600.0), shifted(SENSOR, -3604.0)
    return [
        *frames(range(4)),
        *frames((4,), hour),
        *frames((5, 6)),
        *frames(range(7, 13), hour),
        *frames(range(13, 19), back),
        *frames(range(19, 25), little),
        *frames((18, 12), back),
    ]


def poses() -> list[Step]:
    """A sensor that moves, and localisations that it cannot have reached."""

    def at(x: float) -> dict[str, Any]:
        return {"frame": "sensor", "pose": Pose(translation=np.array([x, 0.0, 0.0]), quaternion=QUATERNION)}

    far = [5000.0 if seq in {4, 5, 10, 11, 12, 13, 14, 15, 16} else float(seq) for seq in range(17)]
    return [SENSOR.detections(seq, **at(x)) for seq, x in enumerate(far)]


def clouds() -> list[Step]:
    """Clouds before, with and after their frames, too late, twice, never, and of frames that announce nothing."""

    def frame(seq: int, *, has_points: bool | None = True) -> Step:
        return SENSOR.detections(seq, has_points=has_points)

    cloud = SENSOR.points
    return [
        *(cloud(0), frame(0), frame(1), cloud(1)),
        *(frame(2), frame(3), cloud(3), 0.3),
        *(cloud(2), cloud(2), frame(4), frame(6), cloud(6), cloud(4), frame(5), cloud(5)),
        (frame(7), frame(8), cloud(8), cloud(7)),
        *(frame(9, has_points=None), cloud(9), frame(10, has_points=False), cloud(10)),
        *(frame(11), frame(12, has_points=False), 0.05, 0.3),
        *(cloud(13, count=0), frame(13), cloud(14, frame="world", pose=None), frame(14), 1.0),
    ]


def fused() -> list[Step]:
    """Three sensors that share a session: shifted in time, late, restarted, silent, with clouds."""
    messages: list[Step] = list(drive(20))
    again = shifted(replace(REAR, epoch=b"R" * 16), 1.6)
    messages[6], messages[9] = messages[9], messages[6]
    return [
        *messages,
        *frames(range(3), SIDE),
        *frames((19,), FRONT),
        *frames(range(22, 26), FRONT),
        *frames(range(8), again),
        SIDE.detections(20, has_points=True),
        SIDE.points(20, count=50),
        FRONT.detections(26, has_points=True),
        REAR.detections(21),
        0.5,
        "keep",
        *frames(range(27, 30), FRONT),
        "kill",
        *frames(range(30, 32), FRONT),
        *frames((8, 9), again),
        3.0,
        *frames(range(32, 34), FRONT),
        *frames((34,), shifted(FRONT, 3600.0)),
    ]


def restore() -> list[Step]:
    """Crashes between checkpoints: frames are missing, arrive again, late, and from caches."""
    return [
        *frames(range(6)),
        "keep",
        *frames(range(6, 9)),
        "kill",
        *frames((10, 11)),
        *frames(range(5, 10)),
        "caches",
        *frames((13, 12)),
        "keep",
        "kill",
        *frames((16, 17, 15)),
        3.0,
        *frames((14, 18)),
        "keep",
        SENSOR.points(20),
        SENSOR.detections(19, has_points=True),
        "kill",
        *frames(range(19, 24)),
        "caches",
    ]


def takeover() -> list[Step]:
    """Another process goes on, with frames that arrive between, held for clouds and late."""
    held = SENSOR.detections(12, has_points=True)
    return [
        *frames(range(6)),
        "leave",
        *frames((7, 6, 8)),
        "take",
        "caches",
        *frames((9, 11, 10)),
        held,
        "leave",
        SENSOR.points(12),
        *frames((13, 14)),
        "take",
        "caches",
        *frames((15, 16, 13)),
    ]


def reset() -> list[Step]:
    """Resets before, between and after frames, and the end of the session."""
    return [
        ResetRequest(),
        *frames(range(4)),
        ResetRequest(),
        *frames((4, 3, 6, 5)),
        SENSOR.detections(7, has_points=True),
        ResetRequest(),
        *frames((8, 7, 9)),
        ResetRequest(close=True),
        *frames((10, 11)),
    ]


def parameters() -> list[Step]:
    """Paths, the wait for clouds and profiles that are set, refused, and set with a restart."""
    return [
        SessionParameters(),
        SessionParameters(horizons=np.array([0.5, 1.0])),
        *frames(range(4)),
        SessionParameters(cloud_wait_s=0.5),
        *frames((4,), has_points=True),
        0.3,
        SessionParameters(horizons=np.array([2.0])),
        *frames((6, 5)),
        SessionParameters(profile="other"),
        SessionParameters(profile="unknown"),
        *frames((7,)),
        SessionParameters(profile="other", restart=True),
        *frames((9, 8, 10)),
        "keep",
        "kill",
        *frames((11,)),
        "caches",
    ]


def quarantine() -> list[Step]:
    """Steps that raise, before and after a restart, and what ends the quarantine."""
    after = shifted(NEXT, 1.5)
    return [
        *frames(range(4)),
        SENSOR.detections(4, objects=7),
        *frames((5, 6)),
        "keep",
        "kill",
        *frames((7,)),
        "caches",
        ResetRequest(),
        *frames((8, 9)),
        *frames((11, 12)),
        SENSOR.detections(10, objects=7),
        *frames((13,)),
        *frames(range(4), after),
    ]


def refused() -> list[Step]:
    """Payloads that are no valid detections, and more frames at once than may wait."""
    payload = encode(SENSOR.detections(1))
    return [
        Raw(payload[:50]),
        *frames((0,)),
        Raw(b""),
        Raw(payload.replace(b"stamp_ns", b"stamp_ms")),
        Raw(payload.replace(SENSOR.stream.encode(), b"site/node/other")),
        Raw(encode(SENSOR.points(1))),
        SENSOR.detections(1, frame="sensor", pose=Pose(translation=np.zeros(3), quaternion=QUATERNION)),
        SENSOR.detections(1, center=np.zeros((3, 3))),
        tuple(frames(range(2, 90))),
        *frames((2, 3, 90)),
    ]


SCENARIOS = {
    one.__name__: one
    for one in (
        in_order,
        late,
        gaps,
        epochs,
        jumps,
        poses,
        clouds,
        fused,
        restore,
        takeover,
        reset,
        parameters,
        quarantine,
        refused,
    )
}
STREAM = {"fused": FUSED}
"""Names of sessions that are not those of the sensor."""


@dataclass
class Recorded:
    """Outputs by their kind: how many, and the digest of their bytes. `final` are the tracks that hold in the end."""

    counts: Counter[str] = field(default_factory=Counter)
    digests: dict[str, Any] = field(default_factory=lambda: defaultdict(hashlib.sha256))
    final: Merged = field(default_factory=Merged)
    sessions: dict[str | None, str] = field(default_factory=lambda: {None: ""})

    def add(self, kind: str, content: bytes) -> None:
        """Add an output."""
        self.counts[kind] += 1
        self.digests[kind].update(len(content).to_bytes(8, "big") + content)

    def message(self, message: Message) -> None:
        """Add a message, without what depends on clocks, on the form of checkpoints and on all fields of profiles."""
        if isinstance(message, Tracks | SessionState | SessionParameters):
            message = message.model_copy(update={"session": self.session(message.session)})
        if isinstance(message, Tracks):
            run = message.delivery.run if message.delivery else 0
            self.final.add(message, run)
            message = message.model_copy(update={"delivery": delivery(run)})
        elif isinstance(message, SessionState):
            message = message.model_copy(update={"digest": ""})
        elif isinstance(message, SessionParameters):
            message = message.model_copy(update={"values": None})
        kind = f"problem {message.code}" if isinstance(message, Problem) else type(message).__name__
        self.add(kind, encode(message))

    def session(self, name: str | None) -> str:
        """Return the number of a session in place of its id, which is a hash of the whole profile."""
        return self.sessions.setdefault(name, f"{len(self.sessions):032x}")

    def summary(self) -> dict[str, str]:
        """Return the values that are compared."""
        for _, content in sorted(self.final.plain().items()):
            self.add("final", content)
        return {kind: f"{self.counts[kind]} {self.digests[kind].hexdigest()[:32]}" for kind in sorted(self.counts)}


def delivery(run: int) -> Delivery:
    """Return the delivery of tracks of a run, without times."""
    return Delivery(instance="test", received_ns=0, published_ns=0, queue_ms=0, decode_ms=0, step_ms=0, run=run)
