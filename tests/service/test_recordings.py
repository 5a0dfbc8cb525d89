"""The service gives the bytes that it gave when they were recorded: packets in, bytes out.

`recordings.json` has, for each scenario and tracker, how many outputs of each kind there were and the digest of
their bytes. With the `chained` tracker, which hashes the frames in their order, they depend on the service alone. With
the `filter` they depend on the tracker too, whose numbers may differ on another kind of processor. After a change that
is meant to change bytes, `OPTIPMB_TEST_RECORD=1 pytest tests/service/test_recordings.py` rewrites the file.
"""

import json
import os
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import optipmb_schemas as schemas
import pytest
from fusing import FUSED
from optipmb_service.cluster.leases import Change, partition_of
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint
from optipmb_service.streams.profiles import Profiles
from optipmb_service.streams.queries import StreamQueries
from optipmb_service.zenoh.topics import Packet
from registries import Around, packet_of, streams_of
from router import SECOND
from scenarios import FILE, PROFILE, SCENARIOS, SENSOR, STREAM, Raw, Recorded, Step
from sessions import chained

import optipmb

RECORD: Final = bool(os.environ.get("OPTIPMB_TEST_RECORD"))
BETWEEN_NS: Final = SECOND // 50
"""Time between two steps."""

RECORDED: Final = optipmb.load_profile(PROFILE)
OTHER: Final = RECORDED.model_copy(update={"name": "other", "nominal_period": 0.2, "detection_time": 0.2})
PROFILES: Final = Profiles("recorded", (), {one.name: one for one in (RECORDED, OTHER)})
OF_SESSIONS: Final = (
    "frames", "duplicates", "late", "inserted", "corrected", "refused", "gaps", "new_epochs", "clouds_used",
    "clouds_missed", "repaired",
)  # fmt: skip
OF_STREAMS: Final = ("received", "shed", "clouds_refused", "clouds_shed")
"""Counts of messages that are recorded."""
TRACKERS: Final = {"chained": chained, "filter": optipmb.Tracker}
KEYS: Final = schemas.Keys()


class Failing:
    def __init__(self, tracker: Any) -> None:
        self._tracker = tracker

    def step(self, density: optipmb.Density, frame: optipmb.Frame) -> optipmb.StepResult:
        if len(frame.score) == 7:
            raise ZeroDivisionError("seven")
        result: optipmb.StepResult = self._tracker.step(density, frame)
        return result


def told(counts: object, *names: str) -> bytes:
    """Return counts as text."""
    return f"{type(counts).__name__}({', '.join(f'{name}={getattr(counts, name)}' for name in names)})".encode()


class Surroundings(Around):
    """The surroundings of a process that may hold the partitions; records published messages."""

    def __init__(self, out: Recorded, kept: dict[str, bytes]) -> None:
        super().__init__()
        self.holding = True
        self._out = out
        self._saved = kept

    def holds(self, _: str) -> bool:
        return self.holding

    def fence(self, _: str) -> int | None:  # type: ignore[override]  # without a lease there is none
        return 1 if self.holding else None

    def put(self, checkpoint: Any, _: int | None, then: Callable[[], None] | None = None) -> None:
        self._saved[checkpoint.stream] = encode_checkpoint(checkpoint)
        if then is not None:
            then()

    def recall(self, stream: str, restore: Any, then: Any, _: object = None) -> None:
        then(restore(decode_checkpoint(self._saved[stream])) if stream in self._saved else None)

    def publish(self, payload: bytes, _: bytes | None = None) -> None:
        self._out.message(schemas.decode(payload, schemas.Tracks))

    def report(self, problem: schemas.Problem, _: int) -> None:
        self._out.message(problem)


class Question:
    def __init__(self, key: str, message: schemas.Message | None, out: Recorded) -> None:
        self.key = key
        self.payload = None if message is None else schemas.encode(message)
        self.encoding = "" if message is None else schemas.encoding_of(message)
        self.finished = threading.Event()
        self._out = out

    def answer(self, _: str, message: schemas.Message) -> None:
        self._out.message(message)

    def refuse(self, problem: schemas.Problem) -> None:
        self._out.message(problem)

    def finish(self) -> None:
        self.finished.set()


class Process:
    """The streams of a process without a network: packets in, payloads out. The clock is the test's."""

    def __init__(self, stream: str, tracker: Callable[[optipmb.Parameters], Any], out: Recorded) -> None:
        self._stream = stream
        self._out = out
        self._kept: dict[str, bytes] = {}
        self._tracker = lambda parameters: Failing(tracker(parameters))
        self.now_ns = 1000 * SECOND

    def run(self, steps: Iterable[Step]) -> None:
        self._begin()
        for step in steps:
            self.now_ns += BETWEEN_NS
            self._step(step)
            self._streams.resume()
            self._around.run()
        self._streams.finish()
        self._around.run()
        self._ask("state", None)
        self._out.add("totals", told(self._streams.totals(), *OF_SESSIONS, *OF_STREAMS))

    def _begin(self) -> None:
        self._around = Surroundings(self._out, self._kept)
        self._streams = streams_of(
            self._around,
            profiles=PROFILES,
            reporter=self._around,
            tracker=self._tracker,
            late_clouds=True,
            queue_frames=32,
            fuse=("site/node/*",) if self._stream == FUSED else (),
        )
        nothing: Any = None
        self._queries = StreamQueries(self._streams, nothing)

    def _step(self, step: Step) -> None:
        if isinstance(step, tuple):
            for one in step:
                self._step(one)
        elif isinstance(step, float):
            self.now_ns += round(step * SECOND)
        elif isinstance(step, str):
            self._command(step)
        elif isinstance(step, Raw):
            self._streams.receive(self._packet(step.payload))
        elif isinstance(step, (schemas.Points, schemas.Detections)):
            self._streams.receive(packet_of(step))
        else:
            self._ask("reset" if isinstance(step, schemas.ResetRequest) else "parameters", step)

    def _packet(self, payload: bytes) -> Packet:
        key, encoding = KEYS.detections(SENSOR.stream), schemas.encoding_of(schemas.Detections)
        return Packet(key, payload, len(payload), encoding, time.time_ns(), time.monotonic_ns())

    def _command(self, command: str) -> None:
        if command == "caches":
            self._streams.cache_answered(KEYS.detections(self._stream))
        elif command == "keep":
            self._streams.keep()
        elif command == "leave":
            self._around.holding = False
            self._streams.changed(partition_of(self._stream), Change.RECALLED)
        else:
            between = self._streams.recent([self._stream]) if command == "take" else []
            self._begin()
            self._streams.hold(self._stream)
            self._streams.take_up(self._stream, between)
        self._around.run()

    def _ask(self, name: str, message: schemas.Message | None) -> None:
        question = Question(KEYS.query(self._stream, name), message, self._out)  # type: ignore[arg-type]  # one of them
        self._queries.answer(question)  # type: ignore[arg-type]  # asked for no more
        self._around.run()
        assert question.finished.wait(60.0)


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_outputs_are_those_that_were_recorded(scenario: str, tracker: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every scenario gives the tracks, problems, replies and counters of the recording."""
    out, name = Recorded(), f"{scenario} {tracker}"
    one = Process(STREAM.get(scenario, SENSOR.stream), TRACKERS[tracker], out)
    monkeypatch.setattr(time, "monotonic_ns", lambda: one.now_ns)
    one.run(SCENARIOS[scenario]())
    found = out.summary()
    recordings = json.loads(FILE.read_text()) if FILE.exists() else {}
    if RECORD:
        FILE.write_text(json.dumps(recordings | {name: found}, indent=1, sort_keys=True) + "\n")
        return
    assert found == recordings[name]
