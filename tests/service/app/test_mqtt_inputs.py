"""Detections over MQTT: topics feed the streams of the settings, and payloads of other makers become frames."""

import asyncio
import contextlib
import json
import re
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from socket import SHUT_WR, create_connection
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from broker import CONNACK, CONNECT, PUBLISH, SUBSCRIBE, Broker, mosquitto
from json_senders import damaged, document, exists
from optipmb_schemas import Detections, Keys, MessageError, decode
from optipmb_service.app.configuration import load
from optipmb_service.edges.json_frames import FrameReader
from optipmb_service.edges.mapping import other_value
from optipmb_service.zenoh.client import Client
from router import Node, Sensor, plain
from routers import free_endpoint
from structlog.testing import capture_logs

paho = pytest.importorskip("paho.mqtt.client")
PacketTypes = pytest.importorskip("paho.mqtt.packettypes").PacketTypes
Properties = pytest.importorskip("paho.mqtt.properties").Properties
CallbackAPIVersion = pytest.importorskip("paho.mqtt.enums").CallbackAPIVersion
mqtt = pytest.importorskip("optipmb_service.edges.mqtt")
mqtt_inputs = pytest.importorskip("optipmb_service.edges.mqtt_inputs")

SENSOR = Sensor()
PAGE = Path(__file__).parents[3] / "docs/json.md"
RADAR = {
    "objects": "data.targets[]",
    "class": "kind",
    "score": "conf",
    "score_scale": 0.01,
    "position": ["pos.x", "pos.y"],
    "yaw": "angle",
    "angle_unit": "deg",
    "time": "ts",
    "time_unit": "ms",
}
SIDES = {"left": 0.59, "top": 0.64, "right": 0.65, "bottom": 0.7}
STAMP = "2026-11-27T08:00:00.500Z"
PAYLOADS = {
    "optipmb": document(SENSOR.detections(0)),
    "mapped": {"ts": 5, "data": {"targets": [{"kind": "car", "conf": 90, "pos": {"x": 1.5, "y": 2}, "angle": 90}] * 2}},
    "axis": {
        "frame": {"timestamp": STAMP, "observations": [{"bounding_box": SIDES, "class": {"type": "car", "score": 1}}]}
    },
    "frigate": {
        "type": "update",
        "before": {"label": "car"},
        "after": {
            "camera": "gate",
            "label": "car",
            "score": 0.8,
            "box": [1135, 699, 1255, 763],
            "frame_time": 5.25,
            "false_positive": False,
        },
    },
    "scenescape": {
        "timestamp": STAMP,
        "objects": {"car": [{"category": "car", "confidence": 0.5, "translation": [1, 2, 0], "size": [4, 2, 1]}] * 2},
    },
}
CAMERA = "garage/gate/cam"


@contextlib.contextmanager
def publisher(address: str, name: str = "") -> Iterator[Any]:
    client = paho.Client(CallbackAPIVersion.VERSION2, name, protocol=paho.MQTTv5)
    connected = threading.Event()
    client.on_connect = lambda *_: connected.set()
    client.connect_async("127.0.0.1", int(address.rpartition(":")[2]))
    client.reconnect_delay_set(0.1, 0.1)
    client.loop_start()
    assert connected.wait(60)
    try:
        yield client
    finally:
        client.disconnect()
        client.loop_stop()
        client.on_connect = None


async def until(true: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not true():  # noqa: ASYNC110 - nothing tells of it
            await asyncio.sleep(0.01)


def send(client: Any, topic: str, payload: Any, **options: Any) -> None:
    text = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    client.publish(topic, text, qos=1, **options).wait_for_publish(60)


async def test_frames_over_mqtt_give_the_same_bytes(start: Any, tmp_path: Path) -> None:
    """As over Zenoh; repeated and retained ones are left out, a wrong one is a problem and does not end the bridge."""
    messages = [SENSOR.detections(seq) for seq in range(5)]
    endpoint = start()[1]
    with Node(endpoint) as node:
        node.send(*messages)
        expected = [plain(one) for one in await asyncio.to_thread(node.tracks, SENSOR.stream, len(messages))]
    endpoint = start()[1]
    inputs = {"site/{1}/lidar": {"topic": "sensors/+/det"}, "yard/late/lidar": {"topic": "late"}}
    with mosquitto(tmp_path) as address, Node(endpoint) as node, publisher(address) as client:
        send(client, "late", document(messages[0]), retain=True)
        async with bridged(endpoint, address, inputs) as bridge:
            send(client, "sensors/node/det", b'{"objects": [{"class": 1}]}')
            send(client, "sensors/no de/det", document(messages[0]))
            assert (await asyncio.to_thread(node.problem, SENSOR.stream, "invalid_value")).path == "objects[0].class"
            for one in messages:
                for _ in range(2):
                    send(client, "sensors/node/det", document(one, "epoch", "seq"))
            for _ in range(2):
                send(client, "sensors/node/det", document(SENSOR.detections(len(messages))))
            tracks = await asyncio.to_thread(node.tracks, SENSOR.stream, len(messages))
            await until(lambda: bridge.inputs.duplicates["mqtt"] == 1)
            assert [plain(one) for one in tracks[: len(messages)]] == expected
            assert sum(bridge.inputs.refused.values()) == 2
            assert bridge.inputs.frames["mqtt"] == 2 * len(messages) + 1, "the retained one is old"


async def test_inputs_are_subscribed_before_the_bridge_is_alive() -> None:
    """Who sends when the bridge says that it is alive is heard from the first message on."""
    endpoint, inputs = free_endpoint(), {SENSOR.stream: {"topic": "sensor"}}
    async with Broker() as broker:
        address = f"mqtt://127.0.0.1:{broker.port}"
        async with bridged(endpoint, address, inputs, connect=[], listen=[endpoint], router=True):
            await broker.wait(1, "/alive")
    assert broker.kinds[:3] == [CONNECT, SUBSCRIBE, PUBLISH]


async def test_frames_keep_their_order_while_nothing_is_tracked(tmp_path: Path) -> None:
    """Frames that come while 64 are without tracks are tried again, and are sent in the order in which they came."""
    endpoint, inputs, arrived, numbers = free_endpoint(), {SENSOR.stream: {"topic": "sensor"}}, [], range(76)
    with mosquitto(tmp_path) as address, publisher(address) as client:
        async with bridged(endpoint, address, inputs, connect=[], listen=[endpoint], router=True) as bridge:
            take = bridge.inputs.client.listen(Keys().detections(SENSOR.stream), arrived.append)
            for number in numbers:
                send(client, "sensor", {"objects": [{"class": "car", "position": [number, 0]}]})
                await asyncio.sleep(0.03 * (number > 64))  # each is tried again at another time
            await until(lambda: len(arrived) == len(numbers))
            take.close()
    found = [decode(one.payload.to_bytes(), Detections).center[0, 0] for one in arrived]
    assert found == list(numbers)


async def test_a_frame_that_is_published_again_counts_once(start: Any, tmp_path: Path) -> None:
    """Each connection ends before the confirmation, and the frame comes twice more, over two bridges: ids go on."""
    endpoint, inputs = start()[1], {SENSOR.stream: {"topic": "sensor"}}
    with mosquitto(tmp_path) as address, Node(endpoint) as node, publisher(address) as client:
        for first, last in ((0, 3), (3, 7)):  # the confirmation of frame 3 was lost with the first bridge
            async with bridged(endpoint, address, inputs) as bridge:
                for seq in range(first, last + 1):
                    payload = json.dumps(document(SENSOR.detections(seq))).encode()
                    await asyncio.to_thread(cut, address, "sensor", payload)
                    for _ in range(2):
                        send(client, "sensor", payload)
                    frames = await asyncio.to_thread(node.tracks, SENSOR.stream, seq + 1)
                count = 3 * (last + 1 - first)
                await until(lambda: bridge.inputs.duplicates["mqtt"] == count - 4)  # noqa: B023 - awaited here
                assert bridge.inputs.frames["mqtt"] == 4
    assert [one.stamp_ns for one in frames] == list(map(SENSOR.stamp_ns, range(8)))
    assert len({(one.session, *one.id.tolist()) for one in frames}) == 1


async def test_constant_correlation_data_is_a_problem(start: Any, tmp_path: Path) -> None:
    """Other content under the key of an earlier message is refused, counted, and told on the stream."""
    endpoint, inputs = start()[1], {SENSOR.stream: {"topic": "sensor"}}
    properties = Properties(PacketTypes.PUBLISH)
    properties.CorrelationData = b"constant"
    with mosquitto(tmp_path) as address, Node(endpoint) as node, publisher(address) as client:
        async with bridged(endpoint, address, inputs) as bridge:
            for at in (0, 0, 1, 2):
                send(client, "sensor", {"objects": [{"class": "car", "position": [at, 0]}]}, properties=properties)
            problem = await asyncio.to_thread(node.problem, SENSOR.stream, "duplicate_key")
            assert f"correlation data {b'constant'.hex()}" in problem.expected
            await until(lambda: bridge.inputs.refused["mqtt", "duplicate_key"] == 2)
            assert (bridge.inputs.frames["mqtt"], bridge.inputs.duplicates["mqtt"]) == (1, 1)


async def test_two_bridges_share_a_subscription(start: Any, tmp_path: Path) -> None:
    """Each message of `$share/GROUP/TOPIC` goes to one of them, and all frames are tracked."""
    endpoint, inputs = start()[1], {"site/{1}/lidar": {"topic": "$share/g/sensors/+/det"}}
    with mosquitto(tmp_path) as address, Node(endpoint) as node, publisher(address) as client:
        async with (
            bridged(endpoint, address, inputs) as one,
            bridged(endpoint, address, inputs, instance="second") as other,
        ):
            for seq in range(20):
                send(client, "sensors/node/det", document(SENSOR.detections(seq), "epoch", "seq"))
            await asyncio.to_thread(node.tracks, SENSOR.stream, 20)
            counts = [each.inputs.frames["mqtt"] for each in (one, other)]
    assert sum(counts) == 20
    assert min(counts) > 0


async def test_a_message_that_feeds_no_stream_is_a_problem(tmp_path: Path) -> None:
    """Of a topic that no input has, or whose levels are no names: the log names the topic; both are counted."""
    endpoint, given = free_endpoint(), {"site/{1}/lidar": {"topic": "sensors/+/det"}}
    router = {"connect": [], "listen": [endpoint], "router": True}
    with mosquitto(tmp_path) as address, capture_logs() as lines:
        async with bridged(endpoint, address, given, **router) as bridge:
            settings = load(None, {"mqtt": {"inputs": given}}).settings
            sources, confirmed = mqtt_inputs.MqttInputs(settings, bridge.inputs), []
            for topic in ("other", "sensors/no de/det"):
                message = {"payload": b'{"objects": []}', "retain": False, "qos": 1, "properties": None}
                sources.take(SimpleNamespace(topic=topic, **message), lambda: confirmed.append(1))
            await until(lambda: len(confirmed) == 2)
            assert bridge.inputs.refused == {("mqtt", "other_sensor"): 0, ("mqtt", "invalid_value"): 2}
    problems = {(one["code"], one["path"]) for one in lines if one["event"] == "problem"}
    assert problems == {("invalid_value", "other"), ("invalid_value", "sensors/no de/det")}


async def test_another_bridge_of_the_name_is_named(start: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the broker says nothing: connections that end again and again are those of two clients of one name."""
    monkeypatch.setattr(mqtt, "RETRY_S", 0.05)
    monkeypatch.setattr(mqtt, "TAKEN_OVER", -1)
    endpoint, inputs = start()[1], {SENSOR.stream: {"topic": "sensor"}}
    with mosquitto(tmp_path) as address, capture_logs() as lines:
        async with bridged(endpoint, address, inputs), bridged(endpoint, address, inputs):
            await until(lambda: any("another client of the name" in one.get("reason", "") for one in lines))
    ended = [one["reason"] for one in lines if one["event"] == "mqtt_disconnected"]
    assert "likely" not in ended[0]


def test_a_byte_order_mark_hides_no_value() -> None:
    """By which a payload is that of an input."""
    payload = b'\xef\xbb\xbf{"camera": "gate"}'
    assert [other_value(payload, {"camera": name}) for name in ("gate", "yard")] == [None, ("camera", "gate")]


def cut(address: str, topic: str, payload: bytes) -> None:
    """Publish a message with QoS 1, and end the connection before the confirmation has come."""
    body = len(topic).to_bytes(2) + topic.encode() + b"\0\1" + payload
    length = bytes([len(body) & 0x7F | 0x80, len(body) >> 7])
    with create_connection(("127.0.0.1", int(address.rpartition(":")[2])), 60) as connection:
        connection.sendall(bytes([CONNECT, 15]) + b"\0\4MQTT\4\2\0\x3c\0\3cut")
        assert connection.recv(4)[0] == CONNACK  # all of it: nothing is unread at the end
        connection.sendall(bytes([PUBLISH | 2]) + length + body)
        connection.shutdown(SHUT_WR)  # the broker reads up to here, and its answers are not read


async def test_what_has_come_outlasts_its_connection(tmp_path: Path) -> None:
    """Frames that wait for room are sent when another client has taken the bridge's connection to the broker."""
    endpoint, arrived, topics = free_endpoint(), [], [*["sensor"] * 64, "other"]
    inputs = {SENSOR.stream: {"topic": "sensor"}, "site/node/other": {"topic": "other"}}
    router = {"connect": [], "listen": [endpoint], "router": True}
    with mosquitto(tmp_path) as address, publisher(address) as client:
        async with bridged(endpoint, address, inputs, **router) as bridge:
            take = bridge.inputs.client.listen(Keys().all("detections"), arrived.append)
            for topic in topics:
                send(client, topic, {"objects": []})
            await until(lambda: len(arrived) == len(topics))
            for topic in ("sensor", "sensor", "other"):
                send(client, topic, {"objects": []})
            await until(lambda: len(arrived) > len(topics))  # the last has come, so the others have, too
            with publisher(address, "optipmb-bridge"):
                await until(lambda: not bridge.connected)
                await until(lambda: len(arrived) == len(topics) + 3)
            take.close()


async def test_cameras_of_a_topic_feed_streams_of_their_own(tmp_path: Path) -> None:
    """Events of Frigate by `after.camera`; events of a camera that no input has are left out, and counted."""
    endpoint, arrived = free_endpoint(), []
    camera = str(calibration(tmp_path))
    given = {
        f"garage/{name}/cam": {"camera": camera, "format": "frigate", "only": {"after.camera": name}}
        for name in ("gate", "yard")
    }
    inputs = {stream: {"topic": "frigate/events"} for stream in given}
    with mosquitto(tmp_path) as address, publisher(address) as client:
        router = {"connect": [], "listen": [endpoint], "router": True}
        async with bridged(endpoint, address, inputs, inputs=given, **router) as bridge:
            take = bridge.inputs.client.listen(Keys().all("detections"), arrived.append)
            for name in ("gate", "street", "yard"):
                event = PAYLOADS["frigate"] | {"after": PAYLOADS["frigate"]["after"] | {"camera": name}}
                send(client, "frigate/events", event)
            await until(lambda: len(arrived) == 2 and bridge.inputs.refused["mqtt", "other_sensor"] == 1)
            take.close()
    found = {decode(one.payload.to_bytes(), Detections).stream for one in arrived}
    assert found == inputs.keys()


async def test_damaged_payloads_end_nothing(start: Any, tmp_path: Path) -> None:
    """200 payloads of Frigate with a fault and 10 MB of spaces are frames or refused; another stream loses nothing."""
    endpoint = start()[1]
    inputs = {
        SENSOR.stream: {"topic": "sensor"},
        "yard/damaged/lidar": {"topic": "damaged"},
        CAMERA: {"topic": "frigate"},
    }
    only = {"after.camera": "gate"}
    given = {CAMERA: {"camera": str(calibration(tmp_path)), "format": "frigate", "only": only}}
    with mosquitto(tmp_path) as address, Node(endpoint) as node, publisher(address) as client:
        async with bridged(endpoint, address, inputs, inputs=given) as bridge:
            for number, text in enumerate([*damaged(PAYLOADS["frigate"], 200), b" " * 10_000_000]):
                send(client, "frigate", text)
                if number % 20 == 0:
                    send(client, "damaged", text)
                    send(client, "sensor", document(SENSOR.detections(number // 20)))
            tracks = await asyncio.to_thread(node.tracks, SENSOR.stream, 11)
            counts = bridge.inputs
            await until(
                lambda: sum(sum(one.values()) for one in (counts.frames, counts.duplicates, counts.refused)) == 223
            )
            assert counts.refused["mqtt", "too_large"] == 2
    assert [one.stamp_ns for one in tracks] == list(map(SENSOR.stamp_ns, range(11)))


@pytest.mark.parametrize("name", ["optipmb", "mapped", "axis", "frigate", "scenescape"])
def test_damaged_payloads_get_a_path(name: str, tmp_path: Path) -> None:
    """An error in one of 200 payloads with a fault names a place that is in the payload."""
    needed = {"mapped": {"mapping": RADAR}, "frigate": {"only": {"after.camera": "gate"}}}.get(name, {})
    given = {"camera": str(calibration(tmp_path)), "format": name} | needed
    reader, refused = FrameReader(load(None, {"inputs": {CAMERA: given}}).settings), []
    reader.read(json.dumps(PAYLOADS[name]).encode(), CAMERA)
    for text in damaged(PAYLOADS[name], 200):
        try:
            reader.read(text, CAMERA)
        except MessageError as error:
            refused.append((error.path, text))
    assert len(refused) > 100
    # A map that the mapping expects may be missing.
    assert [one for one in refused if not (exists(*one) or exists(one[0].rpartition(".")[0], one[1]))] == []


@contextlib.asynccontextmanager
async def bridged(endpoint: str, address: str, topics: Any, **more: Any) -> AsyncIterator[Any]:
    """Run the bridge of a broker with these inputs."""
    given = {"connect": [endpoint], "instance": "bridge", "mqtt": {"broker": address, "inputs": topics}}
    settings = load(None, given | more).settings
    network = await asyncio.to_thread(Client, settings)
    bridge = mqtt.Bridge(settings, network)
    running = asyncio.create_task(bridge.run())
    try:
        await until(lambda: bridge.connected)
        yield bridge
    finally:
        running.cancel()
        await asyncio.wait([running])
        await asyncio.to_thread(network.close)


def calibration(folder: Path) -> Path:
    """Write the calibration of the page on cameras."""
    text = (PAGE.parent / "cameras.md").read_text(encoding="utf-8")
    file = folder / "gate.toml"
    file.write_text(re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[0])
    return file


def read(settings: dict[str, Any], payload: Any) -> Any:
    text = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    given = load(None, {"inputs": {SENSOR.stream: {"format": "mapped", "mapping": settings}}}).settings
    return FrameReader(given).read(text, SENSOR.stream)


def test_a_payload_of_another_maker_becomes_a_frame() -> None:
    """Paths, percent, degrees, milliseconds; no targets are an empty frame."""
    target = {"kind": "car", "conf": 90, "pos": {"x": 1.5, "y": 2}, "angle": 90, "more": [1]}
    frame = read(
        RADAR, {"ts": 1_795_766_400_250, "data": {"targets": [target, {"kind": "car", "pos": {"x": 0, "y": 0}}]}}
    )
    message = frame.message
    assert frame.is_stamped
    assert message.stamp_ns == 1_795_766_400_250_000_000
    np.testing.assert_allclose(message.center, [[1.5, 2, np.nan], [0, 0, np.nan]])
    np.testing.assert_allclose(message.score, [0.9, 1.0])
    np.testing.assert_allclose(message.yaw, [np.pi / 2, np.nan])
    assert len(read(RADAR, {"ts": 1, "data": {"targets": []}}).message.label) == 0


def test_a_map_of_classes_and_a_fixed_sensor() -> None:
    """`*` and `@key` take classes from the keys of a map; a time of a zone; the pose of the settings."""
    pose = {"translation": [1, 2, 3], "quaternion": [1, 0, 0, 0]}
    settings = {"objects": "objects.*[]", "class": "@key", "position": "at", "time": "t", "time_zone": "+01:00"}
    payload = {"t": "2026-11-27T09:00:00", "objects": {"car": [{"at": [1, 2, 3]}], "bus": [], "van": [{"at": [4, 5]}]}}
    message = read(settings | {"frame": "sensor", "pose": pose}, payload).message
    assert message.labels == ("car", "van")
    assert message.stamp_ns == 1_795_766_400_000_000_000
    assert message.pose is not None
    assert read(settings | {"class": "= bus"}, payload).message.labels == ("bus",)


@pytest.mark.parametrize(
    ("payload", "path"),
    [
        ({"ts": 1}, "data"),
        ({"ts": 1, "data": {"targets": {}}}, "data.targets"),
        ({"data": {"targets": []}}, "ts"),
        ({"ts": "1", "data": {"targets": []}}, "ts"),
        ({"ts": 1, "data": {"targets": [{"pos": {"x": 1, "y": 1}}]}}, "data.targets[0].kind"),
        ({"ts": 1, "data": {"targets": [{"kind": "car", "pos": {"x": 1, "y": "1"}}]}}, "data.targets[0].pos.y"),
        ({"ts": 1, "data": {"targets": [{"kind": "car"}]}}, "data.targets[0]"),
        (
            {"ts": 1, "data": {"targets": [{"kind": "car", "pos": {"x": 1, "y": 1}, "conf": 200}]}},
            "data.targets[0].conf",
        ),
        (b"{", ""),
        (b"[" * 100_000, ""),
    ],
)
def test_an_error_names_the_path_in_the_payload(payload: Any, path: str) -> None:
    """Of the sender's document, not of ours."""
    with pytest.raises(MessageError) as raised:
        read(RADAR, payload)
    assert raised.value.path == path
    assert isinstance(payload, bytes) or exists(path, json.dumps(payload).encode())


def test_the_settings_of_the_page(tmp_path: Path) -> None:
    """They are accepted as they stand; --try shows what a payload becomes."""
    text = PAGE.read_text(encoding="utf-8")
    file = tmp_path / "settings.toml"
    file.write_text(re.findall(r"```toml\n(\[mqtt\.inputs.*?)```", text, re.DOTALL)[0])
    settings = load(file).settings
    payload = re.findall(r"```json\n(\{\"ts\".*?)```", text, re.DOTALL)[0]
    (name,) = [name for name in settings.mqtt.inputs if "{1}" in name]
    made = json.loads(mqtt_inputs.tried(settings, name, payload.encode()))
    assert (made["labels"], made["score"]) == (["car"], [0.9])
    with pytest.raises(ValueError, match="option --input"):
        mqtt_inputs.tried(settings, "a/b/c", b"{}")
