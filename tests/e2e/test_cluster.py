"""Services that share streams, by a folder or by nothing but a NATS server: killed, frozen, ended, cut off."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Self

import pytest
from commands import run_here
from fleet import Fleet, RouterProcess, freeze, thaw
from log_process import LogProcess
from nats_process import NatsProcess
from optipmb_schemas import Problem, ServiceStatus, SessionState, decode
from optipmb_service.cluster.leases import PARTITIONS
from optipmb_service.cluster.nats_connection import NatsConnection, token
from proxy import Proxy
from router import Node, Sensor, until
from routers import free_endpoint
from service_process import READY_S, ServiceProcess
from takeovers import KEYS, check, distinct, longest_silence_s, outage_s, published_by, send

SENSORS = [Sensor(stream=f"site/node-{number}/lidar") for number in range(6)]
FREEZE_S = 5.0
"""Longer than a lease, and than the links of a frozen process last."""
SLACK_S = 6.0
"""For a busy machine."""


class Cluster:
    """Two linked routers, and members that have a common folder, or a NATS server and each a folder of its own."""

    def __init__(self, folder: Path, nats: NatsProcess | None, fleet: Fleet, router: RouterProcess, node: Node) -> None:
        self.nats = nats
        self.node = node
        self.endpoint = fleet.endpoint
        self.router = router
        """The router that the node is not connected to."""
        self.beyond = router.endpoint
        self._folder = folder
        self._fleet = fleet

    def member(self, instance: str, endpoint: str = "", **settings: object) -> ServiceProcess:
        own: dict[str, object] = {"store": self._folder / "common"}
        if self.nats is not None:
            own = {"cluster": self.nats.url, "store": self._folder / instance}
        return self._fleet.service(instance, endpoint=endpoint, wait=True, **own | settings)

    def folder_of(self, number: int) -> Path:
        """Where a member keeps its state that shares its name with another one."""
        return self._folder / ("common" if self.nats is None else f"own-{number}")

    def owners(self) -> dict[str, str]:
        keys = self.node.alive(KEYS.all_owners())
        return {KEYS.stream_of(key): KEYS.instance_of(key) for key in keys}

    def settled(self, *instances: str) -> dict[str, str]:
        def reached() -> bool:
            tokens = self.node.alive(KEYS.all_owners())
            return len(tokens) == len(SENSORS) == len(self.owners()) and set(self.owners().values()) <= {*instances}

        def owned() -> str:
            return f"every stream is owned by one of {instances}, but not {sorted(self.node.alive(KEYS.all_owners()))}"

        until(reached, owned)
        return self.owners()

    def check(self, frames: int, *instances: str) -> dict[str, SessionState]:
        """All frames of all streams have been tracked as if nothing had happened."""
        owners = self.settled(*instances)
        return {one.stream: check(self.node, frames, owner=owners[one.stream], sensor=one) for one in SENSORS}

    def outage_s(self, since_ns: int) -> float:
        return max(outage_s(self.node, since_ns, sensor) for sensor in SENSORS)


@pytest.fixture(params=["folder", "nats"])
def cluster(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Cluster]:
    (tmp_path / "nats").mkdir()
    with (
        NatsProcess(tmp_path / "nats") if request.param == "nats" else nullcontext() as nats,
        Fleet(tmp_path) as fleet,
        RouterProcess(fleet.endpoint) as beyond,
        Node(fleet.endpoint) as node,
    ):
        yield Cluster(tmp_path, nats, fleet, beyond, node)


def holds(member: ServiceProcess, partitions: int) -> None:
    until(lambda: _held(member) == partitions, f"{partitions} partitions are held")


def ids_of(states: dict[str, SessionState]) -> dict[str, str]:
    return {stream: state.session for stream, state in states.items()}


def share(*members: ServiceProcess) -> None:
    for member in members:
        holds(member, PARTITIONS // len(members))


def _held(member: ServiceProcess) -> int:
    lines = [line for line in member.errors.splitlines() if "partitions_held" in line]
    return int(lines[-1].partition("held=")[2].split()[0]) if lines else 0


def test_members_take_over(cluster: Cluster, capsys: pytest.CaptureFixture[str]) -> None:
    """Fault 17: a member is killed, one on another router frozen and woken, a third ended: all goes on, to the byte.

    The sessions stay the same ones, so no id is used twice. The frozen one publishes nothing that it would have
    tracked, says that it has lost its lease, and gets its share of the partitions again.
    """
    node = cluster.node
    first = cluster.member("a")
    send(node, 0, 10, sensors=SENSORS)
    sessions = ids_of(cluster.check(10, "a"))
    second = cluster.member("b", cluster.beyond)
    share(first, second)
    send(node, 10, 20, sensors=SENSORS)
    cluster.check(20, "a", "b")

    first.process.kill()
    killed_ns = time.monotonic_ns()
    send(node, 20, 60, 0.1, sensors=SENSORS)
    states = cluster.check(60, "b")
    killed_s = cluster.outage_s(killed_ns)
    assert ids_of(states) == sessions

    third = cluster.member("c")
    share(second, third)
    send(node, 60, 70, sensors=SENSORS)
    cluster.check(70, "b", "c")
    freeze(second)
    frozen_ns = time.monotonic_ns()
    send(node, 70, 70 + round(FREEZE_S / 0.1), 0.1, sensors=SENSORS)
    frames = 70 + round(FREEZE_S / 0.1)
    cluster.check(frames, "c")
    frozen_s = cluster.outage_s(frozen_ns)
    before = [len(published_by(node, "b", sensor)) for sensor in SENSORS]
    thaw(second)
    second.wait_log("lease_lost")
    share(second, third)
    cluster.settled("b", "c")
    assert [len(published_by(node, "b", sensor)) for sensor in SENSORS] == before
    send(node, frames, frames + 10, sensors=SENSORS)
    cluster.check(frames + 10, "b", "c")

    ended_ns = time.monotonic_ns()
    assert third.end()[0] == 0
    send(node, frames + 10, frames + 30, sensors=SENSORS)
    states = cluster.check(frames + 30, "b")
    ended_s = cluster.outage_s(ended_ns)
    assert ids_of(states) == sessions
    with capsys.disabled():
        print(f"\nsilent after a kill {killed_s:.2f} s, a freeze {frozen_s:.2f} s, SIGTERM {ended_s:.2f} s (lease 2 s)")  # noqa: T201 - the figures


class Sending:
    """A replay of all streams at the rate of their sensors, from a frame on, until told otherwise."""

    def __init__(self, node: Node, first: int) -> None:
        self.frames = first
        self._node = node
        self._enough = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._enough.set()
        self._thread.join(60)

    def _run(self) -> None:
        while not self._enough.wait(0.1):
            self._node.send(*(sensor.detections(self.frames) for sensor in SENSORS))
            self.frames += 1


def test_all_members_are_restarted_in_turn(cluster: Cluster, capsys: pytest.CaptureFixture[str]) -> None:
    """While a replay goes on each of three members ends in order and comes back: no frame is lost, to the byte."""
    names = ("a", "b", "c")
    members = {name: cluster.member(name) for name in names}

    def shared() -> None:
        until(lambda: min(map(_held, members.values())) >= PARTITIONS // len(names), "each has its share")

    shared()
    send(cluster.node, 0, 1, sensors=SENSORS)
    sessions = ids_of(cluster.check(1, *names))
    with Sending(cluster.node, 1) as sending:
        for name in names:
            shared()
            assert members[name].end()[0] == 0
            members[name] = cluster.member(name)
        shared()
    assert ids_of(cluster.check(sending.frames, *names)) == sessions
    silent_s = max(longest_silence_s(cluster.node, sensor) for sensor in SENSORS)
    with capsys.disabled():
        print(f"\nsilent for {silent_s:.2f} s at most while three members were restarted in turn")  # noqa: T201 - the figure


@pytest.mark.parametrize("cluster", ["nats"], indirect=True)
def test_a_machine_becomes_a_cluster(cluster: Cluster, tmp_path: Path) -> None:
    """Sessions that were copied out of a folder go on in the cluster, to the byte; used folders and clusters refuse."""
    assert cluster.nats is not None

    def copied(store: Path = tmp_path / "alone") -> tuple[int, str]:
        arguments = ("copy", "--store", store, "--cluster", cluster.nats and cluster.nats.url)
        done = subprocess.run(
            [sys.executable, "-m", "optipmb_service", *map(str, arguments)], capture_output=True, text=True, check=False
        )
        return done.returncode, done.stdout + done.stderr

    status, text = copied()
    assert (status, "expected the checkpoints of a service, found none" in text) == (1, True)
    alone = cluster.member("alone", cluster="", store=tmp_path / "alone")
    send(cluster.node, 0, 10, sensors=SENSORS)
    sessions = ids_of(cluster.check(10, "alone"))
    status, text = copied()
    assert (status, "a service uses it: end it first" in text) == (1, True)
    assert alone.end()[0] == 0
    assert copied() == (0, "copied 6 sessions; left out 0 of streams that the cluster has sessions of\n")
    assert copied() == (0, "copied 0 sessions; left out 6 of streams that the cluster has sessions of\n")
    names = ("a", "b")
    members = [cluster.member(name) for name in names]
    share(*members)
    send(cluster.node, 10, 20, sensors=SENSORS)
    assert ids_of(cluster.check(20, *names)) == sessions
    status, text = copied()
    assert (status, "tracks in the cluster: end its members, copy, and start them again" in text) == (1, True)


def test_a_site_that_is_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A router 30 ms away loses the way to the others, and its member that to the server: the rest goes on without it.

    When all is whole again the member has lost its lease, says so, publishes nothing twice, and gets its share again.
    """
    (tmp_path / "nats").mkdir()
    with (
        NatsProcess(tmp_path / "nats") as nats,
        Fleet(tmp_path) as fleet,
        Proxy(nats.address, delay_s=0.015) as to_server,
        Proxy(fleet.endpoint, delay_s=0.015) as to_router,
        RouterProcess(to_router.endpoint) as beyond,
        Node(fleet.endpoint) as node,
    ):
        cluster = Cluster(tmp_path, nats, fleet, beyond, node)
        here = cluster.member("here")
        send(node, 0, 10, sensors=SENSORS)
        sessions = ids_of(cluster.check(10, "here"))
        away = cluster.member("away", beyond.endpoint, cluster=f"nats://{to_server.address}")
        share(here, away)
        send(node, 10, 20, sensors=SENSORS)
        cluster.check(20, "here", "away")

        to_router.cut()
        to_server.cut()
        cut_ns = time.monotonic_ns()
        send(node, 20, 80, 0.1, sensors=SENSORS)
        cluster.check(80, "here")
        silent_s = cluster.outage_s(cut_ns)
        to_server.mend()
        to_router.mend()
        away.wait_log("lease_lost")
        share(here, away)
        send(node, 80, 90, sensors=SENSORS)
        assert ids_of(cluster.check(90, "here", "away")) == sessions
    with capsys.disabled():
        print(f"\nsilent for {silent_s:.2f} s at most after a site was cut off (lease 2 s)")  # noqa: T201 - the figure


def test_a_member_without_a_router(cluster: Cluster) -> None:
    """The router of one member is killed: it says so, the other one goes on within a lease; it gets its share again.

    All frames are tracked, to the byte. Where no member has a router, each keeps its partitions.
    """
    node, address = cluster.node, free_endpoint().removeprefix("tcp/")

    def ready() -> tuple[int, str]:
        try:
            with urllib.request.urlopen(f"http://{address}/readyz", timeout=10.0) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()

    here, away = cluster.member("here"), cluster.member("away", cluster.beyond, http=address)
    share(here, away)
    send(node, 0, 10, sensors=SENSORS)
    sessions = ids_of(cluster.check(10, "here", "away"))
    assert ready()[0] == 200
    cluster.router.kill()
    killed_ns = time.monotonic_ns()
    send(node, 10, 40, 0.1, sensors=SENSORS)
    status, text = ready()
    assert (status, '"unlinked"' in text, "no router" in text) == (503, True, True)
    cluster.check(40, "here")
    assert cluster.outage_s(killed_ns) < 2.0 + SLACK_S  # `lease_s`
    members = node.ask(KEYS.status("here"), ServiceStatus).members
    assert sorted((one.state, len(one.fences)) for one in members) == [("alive", PARTITIONS), ("unlinked", 0)]

    cluster.router.start()
    share(here, away)
    send(node, 40, 50, sensors=SENSORS)
    states = cluster.check(50, "here", "away")
    assert ready()[0] == 200
    assert ids_of(states) == sessions


def test_two_members_of_one_name(cluster: Cluster) -> None:
    """Both track their shares, also of publishers without a cache, and each reports the other one."""
    for number in range(2):
        cluster.member("twin", store=cluster.folder_of(number))
    node = cluster.node

    def shared() -> bool:
        members = decode(node.query(KEYS.status("twin"))[0][2], ServiceStatus).members
        return [len(one.fences) for one in members] == [PARTITIONS // 2] * 2

    until(shared, "each has its share")
    for seq in range(20):
        node.send_plain(*(sensor.detections(seq) for sensor in SENSORS))
        time.sleep(0.05)  # the rate of a sensor, not a wait for anything
    for sensor in SENSORS:
        check(node, 20, owner="twin", sensor=sensor)

    def reported() -> bool:
        problems = [decode(payload, ServiceStatus).problems for _, _, payload in node.query(KEYS.status("twin"))]
        return [any(one.code == "duplicate_name" for one in some) for some in problems] == [True, True]

    until(reported, "both report the other one")


def test_a_cut_between_two_routers(tmp_path: Path) -> None:
    """Frames that are in the log and do not arrive are tracked from there, also of publishers without a cache.

    The way between two routers is cut, that to the NATS server is not: the member on the far side keeps its partitions.
    Whole again, repeated messages are tracked once.
    """
    (tmp_path / "nats").mkdir()
    with (
        NatsProcess(tmp_path / "nats") as nats,
        Fleet(tmp_path) as fleet,
        Proxy(fleet.endpoint) as between,
        RouterProcess(between.endpoint) as beyond,
        Node(fleet.endpoint) as node,
        Node(beyond.endpoint) as far,
        LogProcess(fleet.endpoint, nats.url) as bridge,
    ):
        bridge.wait_receiving(node)
        cluster = Cluster(tmp_path, nats, fleet, beyond, node)
        here = cluster.member("here")
        away = cluster.member("away", beyond.endpoint)
        share(here, away)

        def send_plain(first: int, last: int) -> None:
            for seq in range(first, last):
                node.send_plain(*(sensor.detections(seq) for sensor in SENSORS))
                time.sleep(0.1)  # the rate of a sensor, not a wait for anything

        send_plain(0, 10)
        owners = cluster.settled("here", "away")
        owned = [sensor for sensor in SENSORS if owners[sensor.stream] == "away"]
        assert owned
        between.cut()
        send_plain(10, 40)
        for sensor in owned:
            until(lambda sensor=sensor: len(distinct(far, sensor)) == 40, "all frames are tracked", 2.0 + SLACK_S)
        assert all(len(distinct(node, sensor)) < 40 for sensor in owned)
        between.mend()
        send_plain(40, 50)
        cluster.check(50, "here", "away")


def purge(nats: NatsProcess) -> None:
    connection = NatsConnection([nats.url], lambda: None)
    until(lambda: not connection.failure, "it is connected")
    assert connection.call(connection.ask(f"STREAM.PURGE.OPTIPMB_{token(KEYS.prefix)}", {}))["purged"] > 0
    connection.close(10.0)


@pytest.mark.parametrize("cluster", ["nats"], indirect=True)
def test_all_leases_and_checkpoints_are_purged(cluster: Cluster) -> None:
    """Members write their leases again, and their sessions go on, to the byte, also after a kill."""
    assert cluster.nats is not None
    first, second = members = [cluster.member(name) for name in "ab"]
    share(*members)
    send(cluster.node, 0, 10, sensors=SENSORS)
    sessions = ids_of(cluster.check(10, "a", "b"))
    purge(cluster.nats)
    for member in members:
        member.wait_log("leases_gone")
    send(cluster.node, 10, 40, sensors=SENSORS)
    cluster.check(40, "a", "b")
    assert not any("lease_lost" in member.errors for member in members)
    time.sleep(1.5)  # three times `checkpoint_s`
    second.process.kill()
    send(cluster.node, 40, 60, 0.1, sensors=SENSORS)
    assert ids_of(cluster.check(60, "a")) == sessions
    assert first.end()[0] == 0


@pytest.mark.parametrize("cluster", ["nats"], indirect=True)
def test_a_member_that_dies_before_a_purge(cluster: Cluster) -> None:
    """Its record is gone, and its partitions are taken within the lease all the same."""
    assert cluster.nats is not None
    first, second = members = [cluster.member(name) for name in "ab"]
    share(*members)
    second.process.kill()
    purge(cluster.nats)
    holds(first, PARTITIONS)


def test_a_member_that_was_cut_off_contests_nothing(tmp_path: Path) -> None:
    """The member that assigns streams is cut off for longer than links last: afterwards no problem remains."""
    (tmp_path / "nats").mkdir()
    names = ("a", "b", "c")
    with (
        NatsProcess(tmp_path / "nats") as nats,
        Fleet(tmp_path) as fleet,
        ExitStack() as proxies,
        Node(fleet.endpoint) as node,
    ):
        cluster = Cluster(tmp_path, nats, fleet, fleet.router, node)
        ways = {name: [proxies.enter_context(Proxy(to)) for to in (nats.address, fleet.endpoint)] for name in names}
        members = {
            name: cluster.member(name, to_router.endpoint, cluster=f"nats://{to_server.address}")
            for name, (to_server, to_router) in ways.items()
        }
        for member in members.values():
            until(lambda member=member: _held(member) in {21, 22}, "each holds a third of the partitions")
        send(node, 0, 20, sensors=SENSORS)
        cluster.check(20, *names)
        looks = next(
            one.member.partition("/")[0]
            for one in node.ask(KEYS.status("a"), ServiceStatus).members
            if 0 in one.partitions
        )
        for proxy in ways[looks]:
            proxy.cut()
        send(node, 20, 100, 0.1, sensors=SENSORS)
        cluster.check(100, *set(names) - {looks})
        for proxy in ways[looks]:
            proxy.mend()
        members[looks].wait_log("lease_lost")
        send(node, 100, 250, 0.1, sensors=SENSORS)  # owners are compared twice, each time after three leases
        cluster.check(250, *names)
        problems = [decode(payload, Problem) for _, payload, _ in node.problems_seen.items]
    assert not [one.received for one in problems if one.code == "contested"]


def test_a_member_drains(cluster: Cluster, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Fault 18: an operator drains a member while all streams go on, has it back, and another ends: no frame is lost.

    `optipmb status` shows it, in 80 columns. A member that is alone is not drained.
    """
    node, endpoint = cluster.node, cluster.endpoint
    monkeypatch.setenv("COLUMNS", "80")
    first = cluster.member("a")

    def run(*arguments: str) -> tuple[int, str]:
        done = run_here(capsys, *arguments, "--connect", endpoint)
        return done.returncode, done.stdout + done.stderr

    status, text = run("drain", "a")
    assert (status, "another member" in text) == (1, True)
    second = cluster.member("b", cluster.beyond)
    with Sending(node, 0) as sending:
        for member in (first, second):
            holds(member, 32)
        cluster.settled("a", "b")
        began_ns = time.monotonic_ns()
        assert run("drain", "a") == (0, "a holds no streams\n")
        holds(second, 64)
        cluster.settled("b")
        _, text = run("status")
        lines = [line.split() for line in text.splitlines() if line.startswith(("a/", "b/"))]
        assert [(line[1], line[2]) for line in lines] == [("draining", "0"), ("alive", "64")]
        assert max(map(len, text.splitlines())) <= 80
        assert node.ask(KEYS.status("a"), ServiceStatus).state == "draining"
        members = node.ask(KEYS.status("b"), ServiceStatus).members
        assert [(one.state, len(one.fences)) for one in members] == [("draining", 0), ("alive", 64)]
        drained_s = max(longest_silence_s(node, one, began_ns) for one in SENSORS)
        assert run("drain", "a", "--undo")[0] == 0
        for member in (first, second):
            holds(member, 32)
        cluster.settled("a", "b")
        began_ns = time.monotonic_ns()
        assert second.end()[0] == 0
        cluster.settled("a")
        before = sending.frames
        until(lambda: sending.frames > before + 5, "more frames")
        ended_s = max(longest_silence_s(node, one, began_ns) for one in SENSORS)
    cluster.check(sending.frames, "a")
    with capsys.disabled():
        print(f"\nsilent after a drain {drained_s:.2f} s, SIGTERM {ended_s:.2f} s, at 10 Hz")  # noqa: T201 - the figures


@pytest.mark.parametrize("cluster", ["nats"], indirect=True)
def test_the_server_is_gone_for_longer_than_a_lease(cluster: Cluster) -> None:
    """Nothing is published without the server, and the service says so; when it is back all is tracked, to the byte.

    The workers of a service are members like any other, each with its share; streams can be moved between them.
    """
    node, nats = cluster.node, cluster.nats
    assert nats is not None
    service = cluster.member("pair", workers=2, lease_s=6.0)  # long, so that no lease ends on a busy machine
    send(node, 0, 10, sensors=SENSORS)
    until(lambda: service.errors.count("held=32 ") == 2, "each worker holds half of the partitions")
    cluster.check(10, "pair-w0", "pair-w1")

    def states() -> set[str]:
        return {node.ask(KEYS.status(f"pair-w{index}"), ServiceStatus).state for index in range(2)}

    def published() -> list[int]:
        return [len(node.tracks(sensor.stream, 1)) for sensor in SENSORS]

    until(lambda: states() == {"ready"}, "both are ready")
    nats.kill()
    until(lambda: states() == {"paused"}, "both are paused")
    assert node.ask(KEYS.status("pair"), ServiceStatus).state == "degraded"
    before = published()
    send(node, 10, 20, sensors=SENSORS)
    assert states() == {"paused"}
    assert published() == before
    nats.start()
    until(lambda: states() == {"ready"}, "both are ready again")
    send(node, 20, 30, sensors=SENSORS)
    cluster.check(30, "pair-w0", "pair-w1")
    assert "lease_lost" not in service.errors
    for worker in (1, 0):
        node.move("pair", SENSORS[0].stream, worker)
        send(node, 40 - 10 * worker, 50 - 10 * worker, sensors=SENSORS)
        cluster.check(50 - 10 * worker, "pair-w0", "pair-w1")
        assert cluster.owners()[SENSORS[0].stream] == f"pair-w{worker}"
    assert service.end()[0] == 0


def test_the_example_names_a_process_that_ends(tmp_path: Path) -> None:
    """With the last line of its log, and status 1."""
    program = tmp_path / "service"
    program.write_text('#!/bin/sh\necho "$1: the address is in use" >&2\n[ "$1" = nats ] || exec sleep 60\n')
    program.chmod(0o755)
    script = Path(__file__).parents[2] / "examples" / "cluster.sh"
    environment = os.environ | {"SERVICE": str(program), "STORE": str(tmp_path)}
    done = subprocess.run(["/bin/sh", script], env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "nats has ended; its last line: nats: the address is in use\n" in done.stderr


def test_the_topology_of_kubernetes_runs_as_processes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The example starts it with one command, tracks come through either router, and an interrupt ends all of it."""
    routers = [free_endpoint() for _ in range(2)]
    names = {"ROUTER_A": routers[0], "ROUTER_B": routers[1], "NATS": free_endpoint().removeprefix("tcp/")}
    script = Path(__file__).parents[2] / "examples" / "cluster.sh"
    program = Path(sys.executable).with_name("optipmb-service")
    environment = os.environ | names | {"SERVICE": str(program), "STORE": str(tmp_path)}
    with (
        (tmp_path / "log").open("w") as log,
        subprocess.Popen(["/bin/sh", script], env=environment, stdout=log, stderr=log, process_group=0) as process,
    ):
        try:
            until(
                lambda: len(re.findall("^ready ", (tmp_path / "log").read_text(), re.MULTILINE)) == 6,
                "all ready",
                READY_S,
            )
            for endpoint in routers:
                arguments = ("replay", "--dataset", "scene", "--option", "frames=20", "--connect", endpoint)
                assert run_here(capsys, *arguments).returncode == 0
            status = run_here(capsys, "status", "--connect", routers[1]).stdout
            assert all(name in status for name in ("service-0", "service-1"))
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        with pytest.raises(ProcessLookupError):
            os.killpg(process.pid, 0)
