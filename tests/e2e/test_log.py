"""The log of detections: a successor elsewhere tracks the frames of an outage, also of publishers without a cache."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from fleet import Fleet
from gateway import GatewayProcess
from log_process import LogProcess
from nats_process import NatsProcess
from optipmb_client import Connection, kept_tracks
from optipmb_schemas import Tracks, decode
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_service.cluster.message_log import MessageLog
from optipmb_service.cluster.store import StoreError
from optipmb_service.zenoh.transport import TRACKS_CACHE
from router import Node, Sensor, plain, until
from service_process import ServiceProcess
from takeovers import KEYS, check, expected

SENSORS = [Sensor(stream=f"site/node-{number}/lidar") for number in range(3)]


class Logged:
    """A router, a NATS server, and a bridge between them that receives; members come and go."""

    def __init__(self, folder: Path, fleet: Fleet, nats: NatsProcess, bridge: LogProcess, node: Node) -> None:
        self.nats, self.bridge, self.node = nats, bridge, node
        self.log = MessageLog([nats.url], KEYS.prefix)
        self.endpoint = fleet.endpoint
        self._folder, self._fleet = folder, fleet

    def member(self, instance: str, **settings: object) -> ServiceProcess:
        # Before its first checkpoint a stream is read as far back; a busy machine takes long to start a member.
        settings = {"standby_s": 300.0} | settings
        return self._fleet.service(instance, cluster=self.nats.url, store=self._folder / instance, **settings)

    def send(self, first: int, last: int) -> None:
        """Publish frames of all streams without caches, at the rate of a sensor."""
        for seq in range(first, last):
            self.node.send_plain(*(sensor.detections(seq) for sensor in SENSORS))
            time.sleep(0.05)  # the rate of a sensor, not a wait for anything

    def in_log(self, frames: int) -> bool:
        """Whether the log has so many frames of each stream, each once."""
        try:
            for sensor in SENSORS:
                read = self.log.connection.call(self.log.read("detections", sensor.stream, 1), 10.0)
                if sorted(message.seq for _, message in read) != list(range(frames)):
                    return False
        except StoreError:  # the server is not there yet
            return False
        return True

    def tracked(self, frames: int, owner: str) -> int:
        """Send on until a member tracks all streams, and some more; all are tracked as if nothing had happened.

        Returns how many frames there are then.
        """

        def goes_on() -> bool:
            nonlocal frames
            frames += 1
            self.send(frames - 1, frames)
            items = tuple(self.node.tracks_seen.items)
            seen = [decode(payload, Tracks) for _, payload, _ in items]
            by_owner = {one.stream for one in seen if one.delivery and one.delivery.instance == owner}
            return by_owner >= {sensor.stream for sensor in SENSORS}

        until(goes_on, f"{owner} tracks all streams")
        self.send(frames, frames + 10)
        for sensor in SENSORS:
            check(self.node, frames + 10, owner=owner, sensor=sensor)
        return frames + 10


@pytest.fixture
def logged(tmp_path: Path) -> Iterator[Logged]:
    (tmp_path / "nats").mkdir()
    with (
        NatsProcess(tmp_path / "nats") as nats,
        Fleet(tmp_path) as fleet,
        Node(fleet.endpoint) as node,
        LogProcess(fleet.endpoint, nats.url) as bridge,
    ):
        bridge.wait_receiving(node)
        logged = Logged(tmp_path, fleet, nats, bridge, node)
        yield logged
        logged.log.connection.close(10.0)


def test_a_successor_reads_what_nobody_tracked(logged: Logged) -> None:
    """A member is killed, frames come while there is none, another one goes on from its checkpoint, to the byte.

    The publishers have no caches, and the successor was not there. So it is before the first checkpoint, too.
    """
    logged.send(0, 10)
    first = logged.member("a")
    frames = logged.tracked(10, "a")
    first.process.kill()
    first.process.wait(60)
    logged.send(frames, frames + TRACKS_CACHE)
    logged.member("b")
    frames = logged.tracked(frames + TRACKS_CACHE, "b")

    # What both of them published can be asked for.
    def kept(stream: str) -> list[bytes]:
        with Connection(logged.endpoint) as connection:
            return [plain(one) for one in kept_tracks(connection, stream)]

    for sensor in SENSORS:
        tracks, _ = expected(frames, sensor)
        until(lambda stream=sensor.stream, tracks=tracks: kept(stream) == tracks, "all tracks are in the log")

    # Over gRPC as well.
    with GatewayProcess(logged.endpoint) as gateway:
        gateway.wait_ready()
        asked = pb.QueryTracksRequest(pattern=SENSORS[0].stream)
        answers = list(gateway.stub().QueryTracks(asked))
        assert len(answers) > TRACKS_CACHE
        assert [plain(convert.from_proto(one.tracks, Tracks)) for one in answers] == kept(SENSORS[0].stream)
        gateway.end()


def test_two_bridges_write_once_and_wait_for_the_servers(logged: Logged) -> None:
    """Each message is in the log once, also when published while no server was there."""
    first = logged.bridge
    with LogProcess(logged.endpoint, logged.nats.url, "second") as second:
        second.wait_receiving(logged.node)
        logged.send(0, 20)
        until(lambda: logged.in_log(20), "both have put 20 frames into the log")
        repeated = partial(map, lambda bridge: bridge.figure("repeated_total"), (first, second))
        until(lambda: sum(repeated()) >= 20 * len(SENSORS), "each frame has come from both")
        assert logged.in_log(20)

        logged.nats.kill()
        until(lambda: first.readiness[0] == second.readiness[0] == "degraded", "both say that they cannot write")
        assert first.readiness[1].startswith("log: ")
        logged.send(20, 40)
        until(lambda: first.figure("waiting_bytes") > 0 < second.figure("waiting_bytes"), "messages wait")
        logged.nats.start()
        until(lambda: logged.in_log(40), "all are in the log")
        until(lambda: first.readiness == second.readiness == ("ready", ""), "both are ready again")
        assert first.figure("dropped_total") == second.figure("dropped_total") == 0
        assert second.end()[0] == 0
