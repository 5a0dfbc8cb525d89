"""Cost of a frame in the service, part by part, compared with another version of the code in one run.

python benchmarks/frame_cost.py [--beside DIR] [--profile NAME ...] [--objects N] [--points N] [--scene NAME]
    [--rejoin] [--rounds N]

A frame goes its way through one process, with everything real but the network and the store: a packet is handed over,
decoded, tracked and published, and every tenth frame a checkpoint is encoded. What counts is the processor time of the
thread, by the default profile and by a tuned one. `--beside` names a checkout of another version: rounds of the two
follow each other, each in a process of its own, and the medians of the rounds are compared. `--rejoin` compares a
session that joins tracks over gaps with one that does not, which take each frame in turns.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

import load
import optipmb_schemas as schemas
from optipmb_service.app.worker import warm_up
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import encode_checkpoint
from optipmb_service.session.session import Session
from optipmb_service.streams.outbox import StreamOutbox
from optipmb_service.streams.profiles import Profiles
from optipmb_service.streams.stream import Stream
from optipmb_service.streams.streams import Streams
from optipmb_service.telemetry.logs import configure
from optipmb_service.telemetry.metrics import Metrics
from optipmb_service.telemetry.problem_reporter import ProblemReporter
from optipmb_service.zenoh.topics import Packet

import optipmb
from optipmb import tracker as tracker_module

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

HERE = Path(__file__).resolve().parents[1]
STREAM, JOINING = "site-of-load/node/lidar1", "site-of-load/node/lidar2"
WARM = 100
FRAMES = 400
RATE_HZ = 10.0
CHECKPOINT_EVERY = 10


class Parts:
    """Processor time of the parts of a frame: of calls of functions, less the timed calls inside them."""

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


def packets(stream: str, frames: load.Frames, k: int) -> Iterator[Packet]:
    """Yield the messages of frame k, its cloud first."""
    keys, begins = schemas.Keys(), load.head(stream, bytes(16), load.FIRST + k, 10**18 + round(k * 1e9 / RATE_HZ))
    bodies = (
        (frames.clouds[k % len(frames)], keys.points(stream), schemas.Points),
        (frames.detections[k % len(frames)], keys.detections(stream), schemas.Detections),
    )
    for body, key, kind in bodies:
        if body is not None:
            payload = load.message(body, begins)
            yield Packet(key, payload, len(payload), schemas.encoding_of(kind), time.time_ns(), time.monotonic_ns())


def measured(options: argparse.Namespace) -> list[dict[str, float]]:
    """Return the median microseconds of each part of a frame, of each session."""
    sys.path.append(str(HERE / "tests" / "support"))
    import gaps  # noqa: PLC0415 - found by the path above
    from registries import Around, streams_of  # noqa: PLC0415 - likewise

    class Counting(Around):
        published = 0

        def publish(self, *_: bytes | None) -> None:
            self.published += 1

    configure("console", "error")
    warm_up()
    parts = Parts()
    timed: tuple[tuple[str, Any, str], ...] = (
        ("handing over", Streams, "receive"),
        ("decoding", Packet, "message"),
        ("session", Session, "on_detections"),
        ("session", Session, "on_points"),
        ("conversion", convert, "frame_of"),
        ("conversion", convert, "cloud_of"),
        ("conversion", convert, "tracks_of"),
        ("step", optipmb.Tracker, "step"),
        ("joining", tracker_module, "rejoin_tracks"),
        ("publishing", StreamOutbox, "_send"),
        ("metrics", Metrics, "received"),
        ("metrics", Metrics, "published"),
        ("metrics", Metrics, "tracks"),
        ("turn", Stream, "work"),
    )
    for part, owner, name in timed:
        setattr(owner, name, parts.time(part, getattr(owner, name)))
    network, problems = Counting(), list[schemas.Problem]()
    streams: Any = streams_of(
        network,
        reporter=ProblemReporter(problems.append),
        tracker=optipmb.Tracker,
        profiles=Profiles.read(options.one, {}),
        rejoin={JOINING: {}},
    )
    frames = load.generated(options.objects, options.points, RATE_HZ)
    if options.scene:
        frames = load.listed(gaps.record(options.scene, 1, (WARM + FRAMES) / RATE_HZ).frames)
    names = (STREAM, JOINING) if options.rejoin else (STREAM,)
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    checkpoints: dict[str, list[float]] = {name: [] for name in names}
    for k, name in itertools.product(range(WARM + FRAMES), names):
        for packet in packets(name, frames, k):
            streams.receive(packet)
        network.run()
        row = parts.taken()
        if k >= WARM:
            rows[name].append(row)
            if k % CHECKPOINT_EVERY == 0:
                began_ns = time.thread_time_ns()
                encode_checkpoint(streams.of(name).session.snapshot())
                checkpoints[name].append((time.thread_time_ns() - began_ns) / 1e3 / CHECKPOINT_EVERY)
    if network.published != len(names) * (WARM + FRAMES) or problems:
        raise RuntimeError(f"{network.published} frames were answered, {problems[:1]}")
    found = []
    for name in names:
        medians = {part: median(row[part] for row in rows[name]) for part in rows[name][0]}
        medians["checkpoint"] = median(checkpoints[name])
        mean = fmean(sum(row.values()) for row in rows[name]) + fmean(checkpoints[name])
        found.append(medians | {"sum": sum(medians.values()), "mean of the sum": mean})
    return found


def roots(tree: Path) -> str:
    """Return the search path on which the packages of a checkout come first."""
    return os.pathsep.join(str(tree / part) for part in ("", "schemas", "service", "clients"))


def rounds(trees: Sequence[Path], options: argparse.Namespace) -> list[dict[str, float]]:
    """Measure checkouts and profiles side by side; return the medians of the rounds."""
    seen: list[list[list[dict[str, float]]]] = []
    for _ in range(options.rounds):
        started = [
            subprocess.Popen(  # noqa: S603 - it calls itself, with its own options
                [sys.executable, __file__, *sys.argv[1:], "--one", profile],
                env=os.environ | {"PYTHONPATH": roots(tree)},
                stdout=subprocess.PIPE,
                text=True,
            )
            for profile in options.profile
            for tree in trees
        ]
        seen.append([one for process in started for one in json.loads(process.communicate()[0])])
    return [{part: median(row[part] for row in rows) for part in rows[0]} for rows in zip(*seen, strict=True)]


def main() -> None:
    """Measure, and print a table of microseconds per frame."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--beside", type=Path, help="checkout of another version")
    parser.add_argument("--profile", nargs="+", default=["generic", "nuscenes"], help="the default and a tuned one")
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--scene", help="one of tests/support/gaps.py in the place of objects that drive in circles")
    parser.add_argument("--rejoin", action="store_true", help="compare a session that joins tracks over gaps")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--one", help="one round of the packages on the search path by this profile, as JSON")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options)))
        return
    trees = [*([options.beside.resolve()] if options.beside else []), HERE]
    results = rounds(trees, options)
    kinds = ("", ", joining") if options.rejoin else ("",)
    columns = [
        f"`{profile}`{', before' if tree is not HERE else ''}{kind}"
        for profile, tree, kind in itertools.product(options.profile, trees, kinds)
    ]
    print("| part, us | " + " | ".join(columns) + " |")
    for part in results[0]:
        print(f"| {part} | " + " | ".join(f"{result[part]:.1f}" for result in results) + " |")


if __name__ == "__main__":
    main()
