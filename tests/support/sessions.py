"""What tests of sessions share: a cheap tracker, outputs merged as a user sees them, trackers that fail."""

import functools
import hashlib
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from optipmb_schemas import Detections, Events, Points, Problem, Tracks, encode
from optipmb_service.session.checkpoint import digest_of
from optipmb_service.session.outputs import Begun, Output, Quarantined, TrackedFrame, events_of
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from router import Sensor

import optipmb


def tracks(outputs: Iterable[Output]) -> list[Tracks]:
    return [output.tracks for output in outputs if isinstance(output, TrackedFrame)]


def problems(outputs: Iterable[Output]) -> list[Problem]:
    return [output for output in outputs if isinstance(output, Problem)]


def begun(outputs: Iterable[Output]) -> list[str]:
    return [output.reason for output in outputs if isinstance(output, Begun)]


def dumps(outputs: Iterable[Output]) -> list[Quarantined]:
    return [output for output in outputs if isinstance(output, Quarantined)]


def feed(one: Session, seqs: Iterable[int], sensor: Sensor, **changes: Any) -> list[Output]:
    return [output for seq in seqs for output in one.on_detections(sensor.detections(seq, **changes), 0)]


class Merged:
    """The tracks as a user has them in the end: the latest run and revision of each frame, repetitions dropped."""

    def __init__(self) -> None:
        self.newest: dict[tuple[bytes, int], tuple[int, Tracks]] = {}

    def take(self, outputs: Iterable[Output], run: int = 0) -> None:
        outputs = list(outputs)
        assert not dumps(outputs), dumps(outputs)[0].error
        for message in tracks(outputs):
            self.add(message, run)

    def add(self, message: Tracks, run: int) -> None:
        key = message.epoch + (message.sensor or "").encode(), message.seq
        old_run, old = self.newest.get(key, (-1, message))
        if (old_run, old.revision) == (run, message.revision):
            assert plain(old) == plain(message), f"another message of revision {message.revision} for {key}"
        if (run, message.revision) > (old_run, old.revision):
            self.newest[key] = run, message

    def plain(self) -> dict[tuple[bytes, int], bytes]:
        return {key: plain(message) for key, (_, message) in self.newest.items()}


def plain(message: Tracks) -> bytes:
    """The bytes of tracks that must equal the run in order."""
    return encode(message.model_copy(update={"delivery": None, "revision": 0}))


def undisturbed(
    messages: Sequence[Detections | Points], profile: str, policy: Policy | None = None
) -> tuple[list[bytes], str, list[bytes]]:
    """The tracks of every frame, the digest of the last state, and the events of a session that nothing happens to."""
    session = Session(messages[0].stream, optipmb.load_profile(profile), policy)
    outputs: list[Output] = []
    for one in messages:
        outputs += session.on_detections(one, 0) if isinstance(one, Detections) else session.on_points(one, 0)
    tracked = [one for one in outputs if isinstance(one, TrackedFrame)]
    events = [bare_events(events_of(one.header, one.events, None, one.known)) for one in tracked if one.events]
    return [plain(one) for one in tracks(outputs)], digest_of(session.snapshot()), events


def bare_events(message: Events) -> bytes:
    """The bytes of the events of a frame that must be the same in every run."""
    return encode(message.model_copy(update={"delivery": None, "revision": 0, "zones": None}))


class Failing:
    """A tracker that raises whenever a frame has a given number of detections."""

    def __init__(self, parameters: optipmb.Parameters, count: int = 7) -> None:
        self._tracker = optipmb.Tracker(parameters)
        self._count = count

    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        if len(frame.score) == self._count:
            raise ZeroDivisionError("seven")
        return self._tracker.step(density, frame)


class Gated:
    """Trackers of a service whose steps wait, from the `first` one on, until the gate is opened.

    Attributes:
        steps: the stream's tracker of each step so far.
        entered: set when a step waits.
        gate: lets steps through once it is set.
    """

    def __init__(self, first: int = 1) -> None:
        self.steps: list[object] = []
        self.entered, self.gate = threading.Event(), threading.Event()
        self._first = first

    def tracker(self, parameters: optipmb.Parameters) -> Any:
        inner, made = optipmb.Tracker(parameters), SimpleNamespace()

        def step(density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
            self.steps.append(made)
            if len(self.steps) >= self._first:
                self.entered.set()
                assert self.gate.wait(60)
            return inner.step(density, frame)

        made.step = step
        return made


@functools.cache
def nothing() -> optipmb.Diagnostics:
    parameters = optipmb.load_profile("nuscenes")
    tracker = optipmb.Tracker(parameters)
    columns: Any = dict.fromkeys(("labels", "label", "center", "size", "yaw", "score"), ())
    frame, _ = optipmb.make_frame(parameters, stamp_ns=0, **columns)
    return tracker.step(tracker.initial(), frame).diagnostics


@dataclass
class Chained:
    """A tracker that costs nothing and forgets nothing: one object whose numbers are a hash of all frames so far.

    Any frame too many, too few, or in another order gives another density for ever after.
    """

    parameters: optipmb.Parameters

    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        """Hash the density and the frame into the next density."""
        if density.stamp_ns != -1 and frame.stamp_ns < density.stamp_ns:
            raise optipmb.FrameError("stamp_ns", f"a stamp from {density.stamp_ns} on", str(frame.stamp_ns))
        digest = hashlib.blake2b(digest_size=48)
        digest.update(f"{density.stamp_ns} {density.next_id} {frame.stamp_ns}".encode())
        digest.update(density.bernoulli.mean.tobytes())
        digest.update(frame.center.tobytes())
        if frame.cloud is not None:
            digest.update(frame.cloud.xyz.tobytes())
        numbers = np.frombuffer(digest.digest(), np.uint8).astype(np.float64)
        born = not len(density.bernoulli)
        known = density.bernoulli
        # All other columns of a Bernoulli are one.
        ones = {name: np.ones((1, *column.shape[1:]), column.dtype) for name, column in known.columns()}
        rows = optipmb.Bernoullis(**ones).replaced(
            mean=numbers.reshape(8, 6)[:1] / 100.0,
            covariance=np.eye(6)[None],
            label=np.zeros(1, np.int64),
            id=known.id if len(known) else np.array([density.next_id]),
            born_ns=known.born_ns if len(known) else np.array([frame.stamp_ns]),
            seen_ns=np.array([frame.stamp_ns]),
        )
        after = optipmb.Density(frame.stamp_ns, density.next_id + born, rows, density.poisson, density.labels)
        found = optipmb.Tracks(
            id=rows.id,
            label=rows.label,
            center=numbers[None, :3],
            size=np.ones((1, 3)),
            yaw=np.zeros(1),
            heading_confidence=np.ones(1),
            velocity=numbers[None, 3:5],
            yaw_rate=np.zeros(1),
            acceleration=np.zeros(1),
            existence=rows.existence,
            score=rows.score,
            covariance=rows.covariance,
            age=np.maximum(0.0, (frame.stamp_ns - rows.born_ns) * 1e-9),
            time_since_detection=np.zeros(1),
            detection=np.array([-1]),
            confirmed=np.ones(1, np.bool_),
        )
        return optipmb.StepResult(after, found, replace(nothing(), cloud_used=frame.cloud is not None, born=int(born)))


def chained(parameters: optipmb.Parameters) -> Chained:
    return Chained(parameters)


def delayed(sensor: Sensor, seconds: float) -> Sensor:
    return replace(sensor, start_s=sensor.start_s + seconds)
