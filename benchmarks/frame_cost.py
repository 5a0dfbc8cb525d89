"""What a frame costs the service, part by part, beside another version of the code, in one run.

python benchmarks/frame_cost.py [--beside DIR] [--objects N] [--points N] [--rounds N]

A frame goes its way through one process, with everything real but the network and the store: a packet is handed over,
decoded, tracked and published, and every tenth frame a checkpoint is encoded. What counts is the processor time of the
thread. `--beside` names a checkout of another version: rounds of the two follow each other, each in a process of its
own, and the medians of the rounds are compared.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import optipmb_schemas as schemas
from optipmb_service.runtime.ports import Packet
from optipmb_service.runtime.profiles import Profiles
from optipmb_service.runtime.track_publisher import TrackPublisher
from optipmb_service.session import convert
from optipmb_service.session.session import Session
from optipmb_tools.load import generated

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

HERE = Path(__file__).resolve().parents[1]
STREAM = "site-of-load/node/lidar1"
WARM = 100
FRAMES = 400
RATE_HZ = 10.0
CHECKPOINT_EVERY = 10


class Parts:
    """Processor time of the parts of a frame: of calls of functions, less that of timed calls inside them."""

    def __init__(self) -> None:
        self.spent_ns: dict[str, int] = {}
        self._inside_ns = 0

    def time(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function as a part of the frame."""
        self.spent_ns[part] = 0

        def timed(*arguments: Any, **named: Any) -> Any:
            outer_ns, self._inside_ns = self._inside_ns, 0
            began_ns = time.thread_time_ns()
            try:
                return function(*arguments, **named)
            finally:
                took_ns = time.thread_time_ns() - began_ns
                self.spent_ns[part] += took_ns - self._inside_ns
                self._inside_ns = outer_ns + took_ns

        return timed

    def taken(self) -> dict[str, float]:
        """Return the microseconds since the last time."""
        taken = {part: spent_ns / 1e3 for part, spent_ns in self.spent_ns.items()}
        self.spent_ns = dict.fromkeys(self.spent_ns, 0)
        return taken


class Network:
    """Everything around the streams: it grants them all, takes what they publish, and runs their actors."""

    strained = False

    def __init__(self) -> None:
        self.waiting: list[Any] = []
        self.published = 0
        self.problems: list[str] = []

    def submit(self, actor: Any) -> None:
        """Take an actor that has something to do."""
        self.waiting.append(actor)

    def run(self) -> None:
        """Run the actors until none has anything to do."""
        while self.waiting:
            actor = self.waiting.pop(0)
            if (actor if callable(actor) else actor.work)():
                self.waiting.append(actor)

    def holds(self, stream: str) -> bool:
        """Every stream is tracked here."""
        return bool(stream)

    def fence(self, stream: str) -> int:
        """Return the fence of all streams."""
        return len(stream)

    def may_write(self, stream: str, fence: int | None) -> bool:
        """All may be published."""
        return fence == self.fence(stream)

    def open_publisher(self, stream: str) -> Network:
        """Be the publisher of a stream."""
        del stream
        return self

    def publish(self, payload: bytes) -> None:
        """Take tracks."""
        self.published += bool(payload)

    def publish_problem(self, problem: schemas.Problem) -> None:
        """Note what must not come."""
        self.problems.append(str(problem))


def packets(objects: int, points: int) -> Iterator[list[Packet]]:
    """Yield the messages of each frame, its cloud first."""
    frames, keys = generated(objects, points, RATE_HZ), schemas.Keys()
    load = first_of("load.material", "load", package="optipmb_tools")
    for k in range(WARM + FRAMES):
        begins = load.head(STREAM, bytes(16), load.FIRST + k, 10**18 + round(k * 1e9 / RATE_HZ))
        made = []
        detections, cloud = frames.detections[k % len(frames)], frames.clouds[k % len(frames)]
        bodies = (
            (cloud, keys.points(STREAM), schemas.Points),
            (detections, keys.detections(STREAM), schemas.Detections),
        )
        for body, key, kind in bodies:
            if body is not None:
                payload = load.message(body, begins)
                encoding = schemas.encoding_of(kind)
                made.append(Packet(key, payload, len(payload), encoding, time.time_ns(), time.monotonic_ns()))
        yield made


def first_of(*modules: str, package: str = "optipmb_service") -> Any:
    """Return the first of these modules of a package that the checkout has: an earlier one has it all in another."""
    for module in modules:
        with contextlib.suppress(ModuleNotFoundError):
            return import_module(f"{package}.{module}")
    raise ModuleNotFoundError(modules[-1])


def measured(objects: int, points: int) -> dict[str, float]:
    """Return the median microseconds of each part of a frame."""
    first_of("telemetry.logs", "observability.logs").configure("console", "error")
    first_of("app.kernels", "app.worker").warm_up()
    metrics = first_of("telemetry.metrics", "observability.metrics").Metrics
    reporter = first_of("telemetry.problem_reporter", "observability.problem_reporter").ProblemReporter
    parts = Parts()
    network: Any = Network()  # in the place of several parts
    decoding = first_of("runtime.stream", "runtime.stream_tracking", "runtime.stream_actor")
    table, persistence = first_of("runtime.streams", "runtime.registry"), first_of("runtime.persistence")
    streams_type = getattr(table, "Streams", None) or table.Registry
    turn_of = first_of("runtime.stream", "runtime.stream_actor")
    nothing: Any = None
    encode_checkpoint = first_of("session.checkpoint_codec", "session.checkpoint").encode_checkpoint
    for part, owner, name in (
        ("handing over", streams_type, "receive"),
        ("handing over", streams_type, "frame"),
        ("handing over", streams_type, "cloud"),
        ("decoding", decoding, "message_of"),
        ("session", Session, "on_detections"),
        ("session", Session, "on_points"),
        ("conversion", convert, "frame_of"),
        ("conversion", convert, "cloud_of"),
        ("conversion", convert, "tracks_of"),
        ("step", optipmb.Tracker, "step"),
        ("publishing", TrackPublisher, "send"),
        ("metrics", metrics, "received"),
        ("metrics", metrics, "published"),
        ("metrics", metrics, "tracks"),
        ("actor", getattr(turn_of, "Stream", None) or turn_of.StreamActor, "work"),
    ):
        if hasattr(owner, name):
            setattr(owner, name, parts.time(part, getattr(owner, name)))
    # Another checkout may have other parts.
    if hasattr(streams_type, "receive"):
        writer = persistence.CheckpointWriter(nothing, 1.0, network, off="")
        others = {"open_publisher": network.open_publisher, "checkpoints": writer, "log": None}
    else:
        others = {"sink": network, "persistence": persistence.NoPersistence()}
        with contextlib.suppress(ModuleNotFoundError):
            others["missed"] = import_module("optipmb_service.runtime.missed_frames").NoLog()
    streams = streams_type(
        first_of("settings.model", "settings").Settings(instance="cost", store="none"),
        Profiles.read("nuscenes", {}),
        reporter=reporter(network.publish_problem, lambda *_: None),
        scheduler=network,
        member=network,
        arm=lambda *_: None,
        metrics=metrics(),
        **others,
    )
    rows: list[dict[str, float]] = []
    checkpoints: list[float] = []
    for k, frame in enumerate(packets(objects, points)):
        for packet in frame:
            if hasattr(streams, "receive"):
                streams.receive(packet)
            else:
                (streams.frame if packet.key.endswith("detections") else streams.cloud)(packet)
        network.run()
        row = parts.taken()
        if k >= WARM:
            rows.append(row)
            if k % CHECKPOINT_EVERY == 0:
                session = (streams.of if hasattr(streams, "of") else streams.actor)(STREAM).session
                began_ns = time.thread_time_ns()
                encode_checkpoint(session.snapshot())
                checkpoints.append((time.thread_time_ns() - began_ns) / 1e3 / CHECKPOINT_EVERY)
    if network.published != WARM + FRAMES or network.problems:
        raise RuntimeError(f"{network.published} frames were answered, {network.problems[:1]}")
    medians = {part: median(row[part] for row in rows) for part in rows[0]}
    return medians | {"checkpoint": median(checkpoints), "sum": sum(medians.values()) + median(checkpoints)}


def roots(tree: Path) -> str:
    """Return the search path on which the packages of a checkout come first."""
    return os.pathsep.join(str(tree / part) for part in ("", "schemas", "service", "clients"))


def rounds(trees: Sequence[Path], options: argparse.Namespace) -> list[dict[str, float]]:
    """Measure the checkouts side by side; return the medians of the rounds."""
    seen: list[list[dict[str, float]]] = [[] for _ in trees]
    command = [sys.executable, __file__, "--one", "--objects", str(options.objects), "--points", str(options.points)]
    for _ in range(options.rounds):
        started = [
            subprocess.Popen(  # noqa: S603 - it calls itself, with numbers
                command, env=os.environ | {"PYTHONPATH": roots(tree)}, stdout=subprocess.PIPE, text=True
            )
            for tree in trees
        ]
        answers = [process.communicate()[0] for process in started]
        for rows, answer in zip(seen, answers, strict=True):
            rows.append(json.loads(answer))
    return [{part: median(row[part] for row in rows) for part in rows[0]} for rows in seen]


def main() -> None:
    """Measure, and print a table of microseconds per frame."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--beside", type=Path, help="checkout of another version")
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--one", action="store_true", help="one round of the packages on the search path, as JSON")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options.objects, options.points)))
        return
    trees = [*([options.beside.resolve()] if options.beside else []), HERE]
    results = rounds(trees, options)
    print("| part | " + " | ".join(["before", "after", "ratio"] if options.beside else ["us"]) + " |")
    for part in results[0]:
        values = [result[part] for result in results]
        shown = [f"{value:.1f}" for value in values] + [f"{values[-1] / values[0]:.2f}"] * (len(values) - 1)
        print(f"| {part} | " + " | ".join(shown) + " |")


if __name__ == "__main__":
    main()
