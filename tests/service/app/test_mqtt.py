"""The bridge to MQTT: topics and payloads, the queue, and repetition when the broker goes and comes."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broker import Broker, mosquitto
from optipmb_client import merging
from optipmb_client.errors import ClientError
from optipmb_schemas import Detections
from optipmb_schemas.json_form import Selection, event_json, problem_json, tracks_json, zones_json
from optipmb_service.settings import MqttSettings, Settings
from watched import PROBLEM, STREAM, Session, events, links, plain, settled, tracks

paho = pytest.importorskip("paho.mqtt.client")
CallbackAPIVersion = pytest.importorskip("paho.mqtt.enums").CallbackAPIVersion
mqtt = pytest.importorskip("optipmb_service.edges.mqtt")

TOPIC = f"optipmb/v1/{STREAM}"
ALIVE = "optipmb/v1/mqtt/one/alive"
CONFIRMED = Selection(confirmed=True)
AT = 1_167_609_600 * 10**9  # 2007-01-01, 94,694,401,000 ms in TimestampIts


@contextlib.asynccontextmanager
async def bridging(
    session: Session, broker: Broker | str, process: Settings | None = None, **settings: Any
) -> AsyncIterator[Any]:
    address = broker if isinstance(broker, str) else f"mqtt://127.0.0.1:{broker.port}"
    network: Any = session
    chosen = {"instance": "one", "mqtt": MqttSettings(broker=address, **settings)}
    bridge = mqtt.Bridge((process or Settings()).model_copy(update=chosen), network)
    running = asyncio.create_task(bridge.run())
    try:
        yield bridge
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not true():  # noqa: ASYNC110 - nothing tells of it
            await asyncio.sleep(0.01)


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Session:
    """The session of the bridge, which waits little for its broker."""
    monkeypatch.setattr(mqtt, "RETRY_S", 0.05)
    return Session()


@pytest.mark.parametrize("versions", [(5,), (4,)])
async def test_topics_are_keys_and_payloads_the_texts_of_readers(session: Session, versions: tuple[int, ...]) -> None:
    """Each with its quality of service; in MQTT 3.1.1 where the broker refuses 5.

    The first of a topic is confirmed, so that it is known whether the broker takes it. Linked tracks have their
    global id.
    """
    session.links = [links((STREAM, 1, "a"))]
    ids = ["", "a" * 32]
    async with Broker(versions) as broker, bridging(session, broker, tracks_hz=0) as bridge:
        assert bridge.state == "degraded"
        await until(lambda: bridge.connected)
        assert (bridge.state, bridge.failure) == ("ready", "")
        session.publish(tracks(1), events(1, 2), settled(2), PROBLEM)
        await broker.wait(1, "/problems")
        await broker.wait(1, "/zones")
        await until(lambda: bridge.published.total() == 5)
        session.publish(tracks(2), PROBLEM)
        await broker.wait(2, "/tracks")
        await broker.wait(2, "/problems")
        found = {(one.topic, one.qos, one.retain): plain(one.payload) for one in broker.messages}
        assert found == {
            (ALIVE, 1, True): b"1",
            (f"{TOPIC}/tracks", 1, False): tracks_json(tracks(1), CONFIRMED, None, ids),
            (f"{TOPIC}/tracks", 0, False): tracks_json(tracks(2), CONFIRMED, None, ids),
            (f"{TOPIC}/events", 1, False): event_json(events(1, 2))[1],
            (f"{TOPIC}/zones", 1, True): zones_json(events(1)),
            **{(f"{TOPIC}/problems", qos, False): problem_json(PROBLEM) for qos in (0, 1)},
        }
        assert broker.of("/events") == event_json(events(1, 2))
        await until(lambda: bridge.published.total() == 7)
        assert dict(bridge.published) == {"tracks": 2, "events": 2, "zones": 1, "problems": 2}
        assert broker.refused == ([] if 5 in versions else [5])
    assert broker.of("/alive") == [b"1", b"0"]


CPM = {"sites": {"garage": {"origin": (48.0, 11.0, 500.0)}}, "cpm": {"garage/*/*": {"station_id": 4711}}}


@pytest.mark.parametrize("outputs", [{}, {"garage/*/*": {}}])
async def test_collective_perception_messages_have_a_topic_of_their_own(session: Session, outputs: Any) -> None:
    """Of the states that `outputs` predicts where a stream has them; other topics only where they are wanted."""
    async with (
        Broker() as broker,
        bridging(session, broker, Settings(**CPM, outputs=outputs), topics=["cpm"]) as bridge,
    ):
        await until(lambda: bridge.connected)
        now = AT + 10**8
        one = tracks(1).model_copy(update={"stamp_ns": AT})
        session.publish(one, one.model_copy(update={"predicted_to_ns": now}))
        (text,) = await broker.wait(1, "/cpm")
        message = json.loads(text)["message"]
        assert (message["station_id"], len(message["perceived_object_container"])) == (4711, 1)
        assert message["management_container"]["reference_time"] == 94_694_401_000 + (100 if outputs else 0)
        assert {one.topic for one in broker.messages} == {ALIVE, f"{TOPIC}/cpm"}


async def test_the_field_of_view_of_a_sensor_is_in_the_messages(session: Session) -> None:
    """Of the stream that the settings name; the next time that the sensors are named."""
    cpm = {"garage/*/*": {"station_id": 1, "sensors": [{"id": 1, "type": "lidar", "stream": "garage/rig/eye"}]}}
    async with Broker() as broker, bridging(session, broker, Settings(**CPM | {"cpm": cpm}), topics=["cpm"]) as bridge:
        await until(lambda: bridge.connected)
        view = {"azimuth": [-1, 1], "elevation": [-1, 1], "range": [0, 50]}
        header = {"stream": "garage/rig/eye", "epoch": bytes(16), "seq": 0, "stamp_ns": AT, "frame": "world"}
        none = {
            "center": np.empty((0, 3)),
            "size": np.empty((0, 3)),
            "yaw": [],
            "score": [],
            "label": [],
            "labels": ["car"],
        }
        session.publish(tracks(1).model_copy(update={"stamp_ns": AT}))
        session.publish(Detections(**header, **none, field_of_view=view))
        session.publish(tracks(2).model_copy(update={"stamp_ns": AT + 10**9}))
        found = [json.loads(one)["message"]["sensor_information_container"][0] for one in await broker.wait(2, "/cpm")]
        assert ["perception_region_shape" in one for one in found] == [False, True]


async def test_events_wait_for_the_broker_and_tracks_do_not(session: Session) -> None:
    """What the broker has not confirmed is sent again, in order; the newest counts are too."""
    async with Broker(silent=True) as broker, bridging(session, broker, tracks_hz=0) as bridge:
        broker.silent = False
        await until(lambda: bridge.connected)
        broker.silent = True
        session.publish(events(1, 2), settled(2))
        await broker.wait(2, "/events")
        await broker.__aexit__()
        await until(lambda: not bridge.connected)
        session.publish(tracks(1), PROBLEM, events(3), settled(4), events(5), settled(6))
        assert "degraded" in bridge.state
        broker.messages.clear()
        broker.silent = False
        async with broker:
            await broker.wait(4, "/events")
            await broker.wait(2, "/zones")
            sent = [json.loads(one)["n"] for one in broker.of("/events")]
            assert sent == [1000, 1001, 3000, 5000]
            assert json.loads(broker.of("/zones")[-1])["seq"] == 5
            session.publish(tracks(7))
            assert [json.loads(one)["seq"] for one in await broker.wait(1, "/tracks")] == [7]
            assert broker.of("/problems") == []


async def test_the_oldest_events_are_lost_where_too_many_wait(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the bound of the queue messages are counted, and the numbers of later ones show the gap."""
    monkeypatch.setattr(mqtt, "EVENTS", 3)
    broker = Broker()
    async with broker:
        pass
    async with bridging(session, broker) as bridge:
        await asyncio.to_thread(session.wait, 3)
        session.publish(events(1, 5), settled(2))
        await until(lambda: bridge.lost == 2)
        async with broker:
            missed, *found = [json.loads(one) for one in await broker.wait(4, "/events")]
            assert missed == {"type": "missed", "stream": "*/*/*", "events": 2}
            assert [one["n"] for one in found] == [1002, 1003, 1004]


async def test_settings_choose_streams_topics_and_the_rate(session: Session) -> None:
    """A frame within half a second of the one before is left out at 2 Hz."""
    async with Broker() as broker, bridging(session, broker, streams=["garage/*/lidar"], topics=["tracks"]) as bridge:
        await until(lambda: bridge.connected)
        assert [key for key, _ in session.subscriptions] == ["optipmb/v1/garage/*/lidar/tracks"]
        for seq in range(6):
            session.publish(tracks(seq))
            await until(lambda: bridge.published["tracks"] == 1 + (seq == 5))  # noqa: B023 - awaited here
        assert [json.loads(one)["seq"] for one in await broker.wait(2, "/tracks")] == [0, 5]


@pytest.mark.parametrize("name", ["credentials", "tls"])
async def test_files_that_cannot_be_read_end_the_start(session: Session, tmp_path: Path, name: str) -> None:
    """One line that names the settings."""
    with pytest.raises(ClientError, match=r"settings mqtt\.credentials, mqtt\.tls: .*No such file"):
        async with bridging(session, "mqtts://127.0.0.1:1", **{name: tmp_path / "none"}):
            pass


async def published(session: Session, broker: Broker, bridge: Any, seq: int) -> set[str]:
    """Publish a frame of many objects, one of few, and an event; return the topics of the received messages."""
    await until(lambda: bridge.connected)
    broker.messages.clear()
    many = tracks(seq, count=400).model_copy(update={"confirmed": np.ones(400, np.int64)})
    session.publish(many, tracks(seq, "garage/rig/few"), events(seq), settled(seq + 1))
    await broker.wait(1, "/events")
    await broker.wait(1, "few/tracks")
    return {one.topic for one in broker.messages}


@pytest.mark.parametrize(("says", "version", "connections"), [(True, 5, 1), (False, 5, 4), (False, 4, 5)])
async def test_a_message_that_the_broker_cannot_take_blocks_no_other(
    session: Session, *, says: bool, version: int, connections: int
) -> None:
    """It is left out and named with its stream, topic and size.

    At once where the broker says its limit; else after it alone has ended two connections. Then messages as large are
    left out too.
    """
    broker = Broker((version,), most=20_000, says_most=says)
    async with broker, bridging(session, broker, tracks_hz=0) as bridge:
        assert f"{TOPIC}/tracks" not in await published(session, broker, bridge, 1)
        await until(lambda: bridge.refused.total() > 0)
        (problem,) = session.problems
        assert (problem.stream, problem.code, problem.path) == (STREAM, "too_large", f"{TOPIC}/tracks")
        assert int(problem.received.removesuffix(" bytes")) > 20_000
        assert bridge.state == "degraded"
        assert f"{TOPIC}/tracks" in bridge.failure
        assert f"{TOPIC}/tracks" not in await published(session, broker, bridge, 3)
        await until(lambda: bridge.refused.total() > 1)
        assert broker.connections == connections
        session.publish(tracks(5))
        await broker.wait(1, f"{STREAM}/tracks")
        await until(lambda: bridge.state == "ready")
        assert bridge.lost == 0


async def test_refused_topics_are_bounded(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of streams are arbitrary: the bridge knows the last topics that were refused."""
    monkeypatch.setattr(merging, "MOST_STREAMS", 2)
    async with Broker(denied=("/tracks",)) as broker, bridging(session, broker, tracks_hz=0) as bridge:
        await until(lambda: bridge.connected)
        session.publish(*(tracks(1, f"garage/rig/{name}") for name in "abc"))
        await until(lambda: bridge.refused.total() == 3)
        assert bridge.failure.startswith("mqtt: 2 topics are refused")


async def test_what_the_broker_refuses_is_not_published(session: Session) -> None:
    """By the reason codes of MQTT 5, also of topics whose later messages are not confirmed."""
    async with (
        Broker(denied=("/tracks", "/events")) as broker,
        bridging(session, broker, tracks_hz=0) as bridge,
    ):
        await until(lambda: bridge.connected)
        session.publish(tracks(1), tracks(2, "garage/rig/b"), events(1, 2), settled(2))
        await broker.wait(1, "/zones")
        await until(lambda: bridge.refused.total() == 4)
        assert dict(bridge.refused) == {"Not authorized": 4}
        assert (dict(bridge.published), bridge.lost) == ({"zones": 1}, 2)
        assert bridge.state == "degraded"
        assert "3 topics are refused" in bridge.failure
        assert "Not authorized" in bridge.failure
        broker.denied = ()
        session.publish(tracks(3), tracks(3, "garage/rig/b"), events(3), settled(4))
        await until(lambda: bridge.state == "ready")


async def test_two_bridges_of_one_name_say_so(session: Session) -> None:
    """The one whose connection is taken over names the reason, and waits before it comes again."""
    async with Broker() as broker, bridging(session, broker) as bridge:
        await until(lambda: bridge.connected)
        broker.take_over()
        await until(lambda: not bridge.connected)
        assert "duplicate_name: another client is optipmb-one" in bridge.failure
        assert "Session taken over" in bridge.failure
        await asyncio.sleep(20 * mqtt.RETRY_S)
        assert broker.connections == 1


async def test_a_real_broker_keeps_counts_and_says_who_is_gone(session: Session, tmp_path: Path) -> None:
    """Mosquitto gives late subscribers the newest counts; when the bridge dies, its last will."""
    with mosquitto(tmp_path) as address:
        async with bridging(session, address, tracks_hz=0) as bridge:
            await until(lambda: bridge.connected)
            session.publish(tracks(1), events(1, 2), settled(2))
            await until(lambda: bridge.published.total() == 4)
            port = int(address.rpartition(":")[2])
            held: dict[str, Any] = {}
            client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
            client.on_message = lambda _client, _data, message: held.update({message.topic: message})
            client.connect("127.0.0.1", port)
            client.subscribe("optipmb/v1/#", qos=1)
            client.loop_start()
            await until(lambda: len(held) == 2)
            payloads = {topic: message.payload for topic, message in held.items()}
            assert payloads == {ALIVE: b"1", f"{TOPIC}/zones": zones_json(events(1))}
            session.publish(events(3, zones=None), settled(4))
            await until(lambda: f"{TOPIC}/events" in held)
            assert held[f"{TOPIC}/events"].payload == event_json(events(3))[0]
            assert held[f"{TOPIC}/events"].properties.ContentType == "application/json"
            client.disconnect()
            client.loop_stop()


async def test_counts_of_zones_that_are_gone_are_cleared(session: Session, tmp_path: Path) -> None:
    """The broker still has them; streams that no service answers for keep theirs."""
    streams = (STREAM, "garage/rig/without", "garage/rig/unknown")
    session.counted = [events(1), events(1, stream=streams[1], zones=None)]
    with mosquitto(tmp_path) as address:
        port = int(address.rpartition(":")[2])
        client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
        async with bridging(Session(), address) as first:
            await until(lambda: first.connected)  # the broker has started
        client.connect("127.0.0.1", port)
        client.loop_start()
        for stream in streams:
            client.publish(f"optipmb/v1/{stream}/zones", b"{}", 1, retain=True).wait_for_publish(60)
        changed: dict[str, bytes] = {}
        client.on_message = lambda _client, _data, message: changed.update({message.topic: message.payload})
        client.subscribe("optipmb/v1/+/+/+/zones", 1)
        async with bridging(session, address):
            await until(lambda: changed.get(f"optipmb/v1/{streams[1]}/zones") == b"")
        assert [changed[f"optipmb/v1/{stream}/zones"] for stream in streams] == [b"{}", b"", b"{}"]
        client.disconnect()
        client.loop_stop()
