"""What a frame costs a running service: processor time by thread, beside services of other checkouts, in turns.

python benchmarks/service_cost.py [--beside DIR | --bare] [--objects N] [--points N] [--rounds N] [--seconds S]

The services run beside each other, as clients of one router, which is a router and nothing else. Each has streams of
its own, and checkpoints every second. One is sent 40 streams at 10 Hz for `--seconds`, then the next one, and so on for
`--rounds`. What else the machine does changes in seconds by a fifth and more, so figures of services that were measured
one after the other cannot be compared. The ratio is the median of those of neighbouring turns. With `--bare` the other
one is `bare_service.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import secrets
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final

from optipmb_client import Connection
from optipmb_client.incoming import Inbox
from optipmb_schemas import Detections, Keys, Points, encoding_of
from optipmb_tools.run.load import FIRST, chain, generated, head, message

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from service_process import ServiceProcess

if TYPE_CHECKING:
    from optipmb_client.incoming import Arrival
    from optipmb_tools.run.load import Frames

HERE: Final = Path(__file__).resolve().parents[1]
STREAMS: Final = 40
RATE_HZ: Final = 10.0
WARM_S: Final = 7.0
"""Caches and windows are full then, and nothing grows any more."""
RUN_IN_S: Final = 0.3
"""Of each turn, before it counts."""
SETTLE_S: Final = 0.05
STRAGGLERS_S: Final = 5.0
CACHE: Final = 50
END_S: Final = 20.0
EPOCH_NS: Final = 1_600_000_000_000_000_000

SHOWN: Final = {
    "all": "processor time of the process, us",
    "python": "threads of Python, us",
    "zenoh": "threads of Zenoh, which also hand messages over, us",
    "wakes": "threads that begin to run",
    "faults": "page faults",
    "p50": "latency p50, ms",
    "p99": "latency p99, ms",
}
ZENOH: Final = ("app-", "rx-", "tx-", "net-", "acc-")


class Tracks(Inbox):
    """Counts the tracks of a service as they arrive, and how long they took since the newest frame was sent."""

    def __init__(self) -> None:
        super().__init__(1)
        self.sent_ns = 0
        self.latencies_ns: list[int] = []

    def put(self, arrival: Arrival) -> None:
        """Take in tracks."""
        self.latencies_ns.append(arrival.monotonic_ns - self.sent_ns)


@dataclass(frozen=True)
class Threads:
    """What the system has counted of the threads of a process: microseconds by name, wakes, page faults."""

    spent_us: dict[str, float]
    wakes: int
    faults: int

    @classmethod
    def of(cls, pid: int) -> Threads:
        """Read it."""
        spent_us: dict[str, float] = {}
        wakes = faults = 0
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError):  # the thread has just ended
                name = (task / "comm").read_text().strip()
                kind = "zenoh" if name.startswith(ZENOH) else "python"
                spent_us[kind] = spent_us.get(kind, 0.0) + int((task / "schedstat").read_text().split()[0]) / 1e3
                faults += int((task / "stat").read_text().rpartition(")")[2].split()[7])
                status = (line.split(":") for line in (task / "status").read_text().splitlines())
                wakes += sum(int(value) for label, value in status if label == "voluntary_ctxt_switches")
        return cls(spent_us, wakes, faults)


class Loaded:
    """A running service and its streams.

    Args:
        pid: its process.
        prefix: of its keys.
        router: endpoint of the router.
        opened: closes what is opened.
        frames: what is sent.
    """

    def __init__(self, pid: int, prefix: str, router: str, opened: contextlib.ExitStack, frames: Frames) -> None:
        self._pid = pid
        connection, keys = opened.enter_context(Connection(router)), Keys(prefix)
        self._frames, self._epoch, self._next = frames, secrets.token_bytes(16), 0
        self._names = [chain(("load", f"{stream:05d}", "x")) for stream in range(STREAMS)]
        self._senders = [
            (
                connection.cached_sender(keys.detections(name), encoding_of(Detections), cache=CACHE),
                connection.plain_sender(keys.points(name), encoding_of(Points)),
            )
            for name in self._names
        ]
        self._tracks = Tracks()
        opened.callback(connection.subscribe(f"{prefix}/*/*/*/tracks", self._tracks).close)
        self.turns: list[dict[str, float]] = []

    def send(self, seconds: float) -> int:
        """Send frames of all streams at their times, those of different streams evenly spread; return how many."""
        period_s, begins = 1.0 / RATE_HZ, time.monotonic()
        rounds = max(1, round(seconds * RATE_HZ))
        for number in range(rounds):
            for stream, (detections, points) in enumerate(self._senders):
                time.sleep(max(0.0, begins + (number + stream / STREAMS) * period_s - time.monotonic()))
                at = (self._next + stream * 7) % len(self._frames)
                stamp_ns = EPOCH_NS + round(self._next * period_s * 1e9)
                start = head(self._names[stream], self._epoch, FIRST + self._next, stamp_ns)
                if (cloud := self._frames.clouds[at]) is not None:
                    points.put(message(cloud, start))
                payload = message(self._frames.detections[at], start)
                self._tracks.sent_ns = time.monotonic_ns()
                detections.put(payload)
            self._next += 1
        return rounds * STREAMS

    def _answered(self, seconds: float) -> list[int]:
        """Send frames and wait for all answers; return their latencies.

        Raises:
            RuntimeError: not all frames were answered.
        """
        latencies = self._tracks.latencies_ns = []
        sent = self.send(seconds)
        ends = time.monotonic() + STRAGGLERS_S
        while len(latencies) < sent and time.monotonic() < ends:
            time.sleep(SETTLE_S)
        if len(latencies) != sent:
            raise RuntimeError(f"{len(latencies)} of {sent} frames were answered")
        return latencies

    def turn(self, seconds: float) -> None:
        """Measure one turn."""
        self._answered(RUN_IN_S)
        before = Threads.of(self._pid)
        latencies = sorted(self._answered(seconds))
        after, sent = Threads.of(self._pid), len(latencies)
        spent = {kind: (after.spent_us[kind] - before.spent_us[kind]) / sent for kind in after.spent_us}
        self.turns.append(
            spent
            | {
                "all": sum(spent.values()),
                "wakes": (after.wakes - before.wakes) / sent,
                "faults": (after.faults - before.faults) / sent,
                "p50": latencies[sent // 2] / 1e6,
                "p99": latencies[sent * 99 // 100] / 1e6,
            }
        )


def started(tree: Path, prefix: str, router: str, opened: contextlib.ExitStack) -> int:
    """Start a service of a checkout; return its process."""
    environment = {
        "PYTHONPATH": os.pathsep.join(str(tree / part) for part in ("", "schemas", "service", "clients")),
        "PYTHONSAFEPATH": "1",
        "OPTIPMB_STORE": opened.enter_context(tempfile.TemporaryDirectory()),
        "OPTIPMB_PREFIX": prefix,
    }
    options = ("--connect", router, "--instance", prefix.partition("/")[0], "--log-level", "warning")
    service = opened.enter_context(ServiceProcess(*options, environment=environment, listen=False, fresh=True))
    service.wait_ready()
    return service.process.pid


def started_bare(prefix: str, router: str, opened: contextlib.ExitStack) -> int:
    """Start `bare_service.py`; return its process."""
    command = [sys.executable, str(HERE / "benchmarks" / "bare_service.py"), router, prefix]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)  # noqa: S603 - a script here
    opened.callback(process.communicate, timeout=END_S)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process.pid


def measured(trees: list[Path | None], options: argparse.Namespace) -> list[Loaded]:
    """Load services of the checkouts in turns; None: the bare one."""
    frames = generated(options.objects, options.points, RATE_HZ)
    with contextlib.ExitStack() as opened:
        router = opened.enter_context(ServiceProcess("router", "--instance", "router", fresh=True))
        router.wait_ready()
        services = []
        for number, tree in enumerate(trees):
            prefix, where = f"cost{number}/v1", router.endpoint
            pid = started(tree, prefix, where, opened) if tree else started_bare(prefix, where, opened)
            services.append(Loaded(pid, prefix, where, opened, frames))
        for service in services:
            service.send(WARM_S)
            time.sleep(STRAGGLERS_S)
        for number in range(options.rounds):
            for service in services if number % 2 else services[::-1]:
                service.turn(options.seconds)
        return services


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    others = parser.add_mutually_exclusive_group()
    others.add_argument("--beside", type=Path, help="checkout of another version")
    others.add_argument("--bare", action="store_true", help="compare with what tracks and does nothing else")
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=1.5, help="length of a turn")
    options = parser.parse_args()
    beside = options.beside is not None or options.bare
    trees: list[Path | None] = [*([options.beside and options.beside.resolve()] if beside else []), HERE]
    services = measured(trees, options)
    print(
        "| of a frame | " + " | ".join([*(["other"] if beside else []), "this", *(["ratio"] if beside else [])]) + " |"
    )
    for name, text in SHOWN.items():
        columns = [[turn[name] for turn in service.turns] for service in services]
        shown = [f"{median(column):.2f}" for column in columns]
        if beside:
            pairs = [after / before for before, after in zip(*columns, strict=True) if before]
            shown.append(f"{median(pairs):.2f}" if pairs else "")
        print(f"| {text} | " + " | ".join(shown) + " |")
    least = (min(turn["all"] for turn in service.turns) for service in services)
    print("least processor time of a turn: " + ", ".join(f"{us:.0f} us" for us in least))


if __name__ == "__main__":
    main()
