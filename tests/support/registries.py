"""The streams of a process alone: nothing of the network, of other members or of a disk around them."""

import time
from collections.abc import Callable
from typing import Any, Self

from optipmb_schemas import Detections, Keys, Points, encode, encoding_of
from optipmb_service.session.checkpoint import Checkpoint
from optipmb_service.settings import Settings
from optipmb_service.streams.parts import Parts
from optipmb_service.streams.profiles import Profiles
from optipmb_service.streams.streams import Streams
from optipmb_service.telemetry.metrics import Metrics
from optipmb_service.telemetry.problem_reporter import ProblemReporter
from optipmb_service.zenoh.topics import Packet
from sessions import chained


class Around:
    """Everything around the streams: it grants them all, keeps their states, and gives them turns when told to."""

    strained = unlinked = False
    durable = True

    def __init__(self) -> None:
        self._working: list[Callable[[], bool]] = []
        self.kept: dict[str, Checkpoint] = {}

    def submit(self, work: Callable[[], bool]) -> None:
        self._working.append(work)

    def run(self) -> None:
        while self.turn():
            pass

    def turn(self) -> bool:
        if not self._working:
            return False
        work = self._working.pop(0)
        if work():
            self._working.append(work)
        return True

    def put(self, checkpoint: Checkpoint, _: int | None, then: Callable[[], None] | None = None) -> None:
        self.kept[checkpoint.stream] = checkpoint
        if then is not None:
            then()

    def recall(
        self, stream: str, restore: Callable[[Checkpoint], Any], then: Callable[[Any], None], _: object = None
    ) -> None:
        then(restore(self.kept[stream]) if stream in self.kept else None)

    def forget(self, _: str) -> None:
        """Nothing is still to be written."""

    def holds(self, _: str) -> bool:
        return True

    def fence(self, _: str) -> int:
        return 1

    def may_write(self, *_: object) -> bool:
        return True

    def open_publisher(self, _: str, **kinds: bool) -> Self:  # noqa: ARG002 - as the service calls it
        return self

    def ask_cache(self, *_: object) -> None:
        """Nothing is in a cache."""

    def look(self) -> None:
        """Wake no waiting thread."""

    release = look

    def publish(self, *_: bytes | None) -> None:
        """Tracks go nowhere."""

    publish_events = publish


def streams_of(
    around: Around,
    log: Any = None,
    *,
    profiles: Profiles | None = None,
    reporter: Any = None,
    tracker: Any = chained,
    traces: Any = None,
    arm: Any = lambda *_: None,
    **settings: Any,
) -> Streams:
    parts: Any = around  # in the place of several
    return Streams(
        Parts(
            settings=Settings(instance="test", store="none", step_limit_s=60, **settings),  # kernels may be compiled
            profiles=profiles or Profiles.read("nuscenes", {}),
            tracker=tracker,
            transport=parts,
            member=parts,
            checkpoints=parts,
            log=log,
            scheduler=parts,
            arm=arm,
            reporter=reporter or ProblemReporter(lambda _: None),
            metrics=Metrics(),
            traces=traces,
        )
    )


def packet_of(message: Detections | Points) -> Packet:
    payload, keys = encode(message), Keys()
    key = (keys.detections if isinstance(message, Detections) else keys.points)(message.stream)
    return Packet(key, payload, len(payload), encoding_of(type(message)), time.time_ns(), time.monotonic_ns())
