"""Who may do what on a protected network: every claim probed from both sides through a real router process.

The router drops forbidden messages silently. So each forbidden message is followed by an allowed one, on the
same link and to the same receiver: when that has come, the first would have come too.
"""

import itertools
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from log_process import LogProcess
from nats_process import NatsProcess
from optipmb_client import Publisher, Subscriber
from optipmb_schemas import Density, Keys, ServiceStatus, SessionState, decode
from optipmb_service.cluster.message_log import MessageLog
from optipmb_service.cluster.store import StoreError
from protected import REFUSAL_MS, Network, Party, make
from router import until
from routers import free_endpoint
from service_process import ServiceProcess

KEYS = Keys()
ROBOT, OTHER = "garage/robot-1", "garage/robot-2"
LIDAR = f"{ROBOT}/lidar"
NODE, SECOND, VIEWER, SERVICE = f"node/{ROBOT}", f"node/{OTHER}", "viewer/ops", "service/tracker"
FRAMES = 20
RATE = 5000
FLOOD = 30_000
PACE_S = 0.005
"""Between frames, as of a very fast sensor: the router drops what comes closer together than its rate allows."""
EVERYBODY = (
    *("--node", ROBOT, "--node", OTHER, "--service", "tracker", "--service", "spare"),
    *("--reads", f"{ROBOT}=garage/fused/crossing"),
    *("--viewer", "ops", "--megabytes", "1", "--rate", str(RATE)),
)  # fmt: skip


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with Network(tmp_path_factory.mktemp("tls"), *EVERYBODY) as one:
        yield one


@pytest.fixture(scope="module")
def service(network: Network) -> Iterator[ServiceProcess]:
    with network.service() as one:
        one.wait_ready()
        yield one


@pytest.fixture
def node(network: Network) -> Iterator[Party]:
    with Party(network.config(NODE)) as one:
        yield one


@pytest.fixture
def viewer(network: Network) -> Iterator[Party]:
    with Party(network.config(VIEWER)) as one:
        yield one.read(*(KEYS.all(topic) for topic in ("detections", "points", "tracks", "problems")))  # type: ignore[arg-type]  # all are topics


def publish(network: Network, role: str, stream: str, frames: int) -> Publisher:
    """Publish frames as a node does; the publisher stays open, its cache with it."""
    publisher = Publisher(stream, config=network.config(role), frame="world")
    for k in range(frames):
        car: dict[str, Any] = {"label": ["car"], "center": [[k, 0, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.0]}
        publisher.publish(stamp_ns=10**18 + k * 10**8, **car, score=[0.9])
        time.sleep(PACE_S)  # below the limit of the rate, not a wait for anything
    return publisher


def refused(config: Path, **changes: Any) -> bool:
    try:
        with Party(config, patience_ms=REFUSAL_MS, **changes):
            return False
    except zenoh.ZError:
        return True


# Who is let in


@pytest.mark.parametrize("role", [NODE, VIEWER, SERVICE])
def test_a_certificate_of_the_authority_is_let_in(network: Network, role: str) -> None:
    """A process with a certificate of the authority links to the router."""
    with Party(network.config(role)) as party:
        party.settle()


def test_a_foreign_authority_is_not_let_in(network: Network, tmp_path: Path) -> None:
    """A certificate with the right name that another authority issued links to nothing."""
    assert make(tmp_path, *network.options).returncode == 0
    tls = {"root_ca_certificate": str(network.folder / NODE / "ca.pem")}
    changes = {f"transport/link/tls/{name}": value for name, value in tls.items()}
    assert refused(tmp_path / NODE / "zenoh.json5", **changes)


def test_without_a_certificate_nobody_is_let_in(network: Network) -> None:
    """TLS without a certificate of one's own links to nothing."""
    changes = {f"transport/link/tls/connect_{name}": None for name in ("private_key", "certificate")}
    assert refused(network.config(NODE), **changes, **{"transport/link/tls/enable_mtls": False})


def test_plain_tcp_is_not_let_in(network: Network) -> None:
    """The port speaks nothing but TLS."""
    plain = [network.endpoint.replace("tls/", "tcp/")]
    assert refused(network.config(NODE), **{"connect/endpoints": plain, "transport/link/protocols": ["tcp"]})


def test_a_node_cannot_pose_as_the_router(network: Network, tmp_path: Path) -> None:
    """A certificate of a node is none of a server: clients refuse to link to who shows it."""
    impostor = json.loads(network.config("router").read_text())
    folder = network.folder / NODE
    tls = {"listen_private_key": str(folder / "key.pem"), "listen_certificate": str(folder / "cert.pem")}
    impostor["transport"]["link"]["tls"] |= tls
    endpoint = free_endpoint().replace("tcp/", "tls/")
    impostor["listen"]["endpoints"] = [endpoint]
    (tmp_path / "zenoh.json5").write_text(json.dumps(impostor))
    with Party(tmp_path / "zenoh.json5"):
        assert refused(network.config(NODE), **{"connect/endpoints": [endpoint]})


def test_a_stranger_with_a_certificate_may_do_nothing(network: Network, node: Party, viewer: Party) -> None:
    """A certificate of the authority whose name the router does not know reads, writes and asks nothing."""
    network.make("--node", "garage/stranger")  # the router has read its table before
    with Party(network.config("node/garage/stranger")) as stranger:
        stranger.read("**")
        stranger.put(KEYS.detections("garage/stranger/lidar"), b"stranger")
        assert stranger.tokens("**") == set()
        assert node.deliver(KEYS.detections(LIDAR), b"node", viewer)
        assert stranger.ask(KEYS.all_status(), timeout=1.0) == []
        assert (KEYS.detections("garage/stranger/lidar"), b"stranger") not in viewer.seen
        assert stranger.seen == []


# Nodes


def test_a_node_gets_tracks_of_its_own_detections(network: Network, service: ServiceProcess) -> None:
    """A node publishes under its own name and reads the tracks that come of it, with the client as it is."""
    stream = f"{ROBOT}/camera"
    tracks = Subscriber(stream, config=network.config(NODE), timeout=60)
    with tracks, publish(network, NODE, stream, FRAMES):
        seqs = [message.seq for message in itertools.islice(tracks, FRAMES)]
    assert seqs == list(range(FRAMES))


@pytest.mark.parametrize("topic", ["detections", "points"])
def test_a_node_cannot_write_for_another(node: Party, viewer: Party, topic: str) -> None:
    """A message under another node's name reaches no subscriber."""
    theirs, own = (f"{KEYS.prefix}/{name}/lidar/{topic}" for name in (OTHER, ROBOT))
    node.put(theirs, b"forged")
    assert node.deliver(own, b"own", viewer)
    assert (theirs, b"forged") not in viewer.seen


@pytest.mark.parametrize("topic", ["tracks", "problems"])
def test_a_node_cannot_write_results(node: Party, viewer: Party, topic: str) -> None:
    """Tracks and problems come from services alone, also under the node's own name."""
    key = f"{KEYS.prefix}/{LIDAR}/{topic}"
    node.put(key, b"forged")
    assert node.deliver(KEYS.detections(LIDAR), b"after", viewer)
    assert (key, b"forged") not in viewer.seen


@pytest.mark.parametrize("pattern", ["**", KEYS.all("tracks"), KEYS.tracks(f"{OTHER}/lidar")])
def test_a_node_cannot_read_anothers_tracks(node: Party, network: Network, viewer: Party, pattern: str) -> None:
    """Neither by name nor by a wider pattern; its own tracks reach it."""
    own, theirs = KEYS.tracks(LIDAR), KEYS.tracks(f"{OTHER}/lidar")
    node.read(pattern, own)
    with Party(network.config(SERVICE)) as tracker:
        tracker.put(theirs, b"theirs")
        assert tracker.deliver(own, b"own", node)
        assert viewer.wait(lambda seen: (theirs, b"theirs") in seen)
    assert (theirs, b"theirs") not in node.seen


@pytest.mark.parametrize("topic", ["tracks", "events", "problems"])
def test_a_node_reads_sessions_of_its_site_that_it_is_let_read(
    node: Party, network: Network, viewer: Party, topic: str
) -> None:
    """Tracks, events and problems of a fused session that `--reads` names; of another one nothing."""
    own, other = (f"{KEYS.prefix}/garage/fused/{name}/{topic}" for name in ("crossing", "yard"))
    node.read(own, other)
    viewer.read(other)
    with Party(network.config(SERVICE)) as tracker:
        tracker.put(other, b"other")
        assert tracker.deliver(own, b"own", node)
        assert viewer.wait(lambda seen: (other, b"other") in seen)
    assert (other, b"other") not in node.seen


def test_a_node_cannot_read_anothers_detections(node: Party, network: Network, viewer: Party) -> None:
    """Inputs of other nodes stay with the services and viewers."""
    key = KEYS.detections(f"{OTHER}/lidar")
    node.read(KEYS.all("detections"), key)
    with Party(network.config(SECOND)) as second:
        assert second.deliver(key, b"theirs", viewer)
    assert node.seen == []


def test_a_node_asks_about_its_own_streams_alone(node: Party, service: ServiceProcess) -> None:
    """`q/state` of its own streams is answered, of another node's it is not; nor is the status of the service."""
    (own,) = node.ask(KEYS.query(LIDAR, "state"))
    assert decode(own, SessionState).stream == LIDAR
    assert node.ask(KEYS.query(f"{OTHER}/lidar", "state"), timeout=1.0) == []
    assert node.ask(KEYS.all_status(), timeout=1.0) == []


def test_a_node_cannot_pose_as_the_owner_of_a_stream(node: Party, viewer: Party, service: ServiceProcess) -> None:
    """A node cannot say that it tracks a stream, which would keep the services from doing so, nor pose as a service."""
    node.token(KEYS.owner(LIDAR, "forged"))
    node.token(KEYS.alive("forged"))
    assert node.deliver(KEYS.detections(LIDAR), b"after", viewer)
    assert viewer.tokens(KEYS.all_alive()) == {KEYS.alive("tracker")}
    assert all("forged" not in token for token in viewer.tokens(KEYS.all_owners()))


def test_a_node_cannot_answer_for_a_service(node: Party, viewer: Party, service: ServiceProcess) -> None:
    """A node that answers the question about the service is not heard."""
    node.session.declare_queryable(KEYS.all_status(), lambda query: query.reply(query.key_expr, b"forged"))
    (status,) = viewer.ask(KEYS.all_status())
    assert decode(status, ServiceStatus).instance == "tracker"


# Services and viewers


def test_a_bridge_into_the_log_uses_the_certificate_of_a_service(
    network: Network, service: ServiceProcess, tmp_path: Path
) -> None:
    """With it `optipmb-service log` receives the detections and tracks of all streams."""
    stream = f"{ROBOT}/logged"
    config = str(network.config("service/spare"))
    (tmp_path / "nats").mkdir()
    with (
        NatsProcess(tmp_path / "nats") as nats,
        LogProcess(network.endpoint, nats.url, "log", "--zenoh-config", config) as bridge,
    ):
        bridge.wait_ready()
        assert service.process.poll() is None
        log = MessageLog([nats.url], KEYS.prefix)
        with publish(network, NODE, stream, FRAMES):

            def logged() -> bool:
                try:
                    topics = [
                        log.connection.call(log.read(topic, stream, 1), 10.0) for topic in ("detections", "tracks")
                    ]
                except StoreError:
                    return False
                return [len({message.seq for _, message in read}) for read in topics] == [FRAMES, FRAMES]

            until(logged, "all detections and tracks are in the log")
        log.connection.close(10.0)


def test_a_service_cannot_write_inputs(network: Network, viewer: Party) -> None:
    """A service writes tracks and no detections: its key forges no detections of sensors."""
    with Party(network.config(SERVICE)) as tracker:
        tracker.put(KEYS.detections(LIDAR), b"forged")
        assert tracker.deliver(KEYS.tracks(LIDAR), b"after", viewer)
    assert (KEYS.detections(LIDAR), b"forged") not in viewer.seen


def test_a_viewer_reads_and_asks_but_changes_nothing(
    network: Network, node: Party, viewer: Party, service: ServiceProcess
) -> None:
    """A viewer sees the status and all streams; its orders are not heard, and its messages reach no subscriber."""
    (status,) = viewer.ask(KEYS.all_status())
    assert decode(status, ServiceStatus).instance == "tracker"
    assert b"optipmb_info" in viewer.ask(KEYS.metrics("tracker"))[0]
    (density,) = viewer.ask(KEYS.query(LIDAR, "density"))
    assert decode(density, Density).stream == LIDAR
    for order in (KEYS.query(LIDAR, "reset"), KEYS.move("tracker"), KEYS.drain("tracker")):
        assert viewer.ask(order, timeout=1.0) == []
    with Party(network.config(VIEWER)) as writer:
        writer.put(KEYS.detections(LIDAR), b"forged")
        assert len(writer.ask(KEYS.all_status())) == 1  # this link is in order: the put has passed the router
    assert node.deliver(KEYS.detections(LIDAR), b"node", viewer)
    assert (KEYS.detections(LIDAR), b"forged") not in viewer.seen


@pytest.mark.parametrize("role", [NODE, VIEWER, SERVICE])
def test_the_router_shows_nothing_of_itself(network: Network, role: str) -> None:
    """The router's administration space, with its configuration, is closed to everybody."""
    with Party(network.config(role)) as party:
        assert party.ask("@/**", timeout=1.0) == []


# Limits


def test_a_message_that_is_too_large_does_not_pass(node: Party, viewer: Party) -> None:
    """Above the limit of the router a message goes nowhere; below it passes; the link goes on."""
    key = KEYS.points(LIDAR)
    small, large = bytes(900_000), bytes(1_100_000)
    node.put(key, large)
    assert node.deliver(KEYS.detections(LIDAR), b"after", viewer)
    assert node.deliver(key, small, viewer)
    assert (key, large) not in viewer.seen


def test_a_flood_is_cut_and_others_go_on(network: Network, node: Party, viewer: Party) -> None:
    """Of a flood only so many messages a second pass, and another node's message comes through meanwhile."""
    theirs, own = KEYS.detections(f"{OTHER}/lidar"), KEYS.detections(LIDAR)
    began = time.monotonic()
    with Party(network.config(SECOND)) as flooder:
        for number in range(FLOOD):
            flooder.put(theirs, b"%d" % number)
            if number == FLOOD // 2:
                node.put(own, b"in time")
        assert viewer.wait(lambda seen: (own, b"in time") in seen)
        flooder.put(KEYS.points(f"{OTHER}/lidar"), b"last")  # another topic has a budget of its own
        assert viewer.wait(lambda seen: any(payload == b"last" for _, payload in seen[-50:]))
        seconds = time.monotonic() - began
    passed = sum(key == theirs for key, _ in viewer.seen)
    assert 1 <= passed <= 2 + RATE * seconds
    assert passed < FLOOD


# Recovery


def test_a_service_that_comes_late_recovers_what_it_missed(tmp_path: Path) -> None:
    """Detections from before the service, and tracks from before the subscriber, are recovered under access control."""
    with Network(tmp_path, *EVERYBODY) as network, publish(network, NODE, LIDAR, FRAMES):
        with network.service() as service, Party(network.config(VIEWER)) as viewer:
            service.wait_ready()
            assert viewer.wait_for_frames(FRAMES) == FRAMES
            with Subscriber(LIDAR, config=network.config(NODE), history=True, timeout=60) as late:
                assert [message.seq for message in itertools.islice(late, FRAMES)] == list(range(FRAMES))
            service.process.kill()
        with network.service("spare") as spare, Party(network.config(VIEWER)) as viewer:
            spare.wait_ready()
            assert viewer.wait_for_frames(FRAMES) == FRAMES


# Certificates


def test_a_second_run_keeps_what_holds(network: Network) -> None:
    """Run again, the command keeps authority and certificates; with `--renew` new ones work at the same router."""
    before = (network.folder / NODE / "cert.pem").read_bytes()
    assert "new certificate" not in network.make()
    assert (network.folder / NODE / "cert.pem").read_bytes() == before
    assert "certificate kept" not in network.make("--renew")
    assert (network.folder / NODE / "cert.pem").read_bytes() != before
    assert not refused(network.config(NODE))


def test_keys_are_private(network: Network) -> None:
    """No key can be read by anybody but its owner."""
    keys = [*network.folder.rglob("key.pem"), *network.folder.rglob("ca.key")]
    assert {key.parent.name for key in keys} >= {"robot-1", "robot-2", "tracker", "spare", "ops", "router", "authority"}
    assert {key.stat().st_mode & 0o777 for key in keys} == {0o600}


@pytest.mark.parametrize(
    "options",
    [
        *(("--node", one) for one in ("robot-1", "a/b/c", "service/x", "a/*", "a/fused")),
        *(("--reads", one) for one in ("a/b=c", "a/b=a/fused/x")),  # of no node
        ("--viewer", "a/b"),
    ],
)
def test_names_that_could_mean_more_are_refused(tmp_path: Path, options: tuple[str, ...]) -> None:
    """A name that is no name, or would match more than one, is refused in one line."""
    done = make(tmp_path, *options)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert re.match(r"make\.py: (expected (site/\S+|a name) of letters|--reads: expected a node)", done.stderr)
