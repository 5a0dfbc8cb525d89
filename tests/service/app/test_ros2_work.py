"""The thread of the bridge to ROS 2: messages, and timers."""

import time
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_client.incoming import Arrival
from optipmb_schemas import encode, encoding_of
from optipmb_schemas.ros2.cpm import CPM
from optipmb_schemas.ros2.tracks import TRACKED, header_of
from optipmb_schemas.ros2.types import own_types
from optipmb_service.app.configuration import load
from optipmb_service.edges.ros2.graph import NO_HASH, Endpoint, Node, TopicKey
from optipmb_service.edges.ros2.work import QUEUE, TF, Work
from structlog.testing import capture_logs
from tracks_message import tracks_message

HANGS_S = 30.0


def test_more_than_can_be_handled_keeps_nothing_waiting_that_is_due(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where each message is followed by the next, diagnostics are sent and the work returns in its time."""
    node: Any = SimpleNamespace(endpoint=lambda *about: about, client=None)
    work = Work(load(None, {"store": "none"}).settings, node)
    diagnosed: list[float] = []
    monkeypatch.setattr(work, "_diagnose", lambda: diagnosed.append(time.monotonic()))
    gives_up = time.monotonic() + HANGS_S

    def handle() -> None:
        if time.monotonic() < gives_up:
            work._put(handle)

    work._put(handle)
    work.work(0.05)
    assert diagnosed
    assert work._queue
    work.work(0.05)
    assert time.monotonic() < gives_up


class Bridging:
    """A bridge whose node is a stand-in: what it subscribes to is called, what it publishes is kept."""

    def __init__(self, stream: str, **given: Any) -> None:
        self.stream = stream
        self.published: list[tuple[str, Any]] = []
        self.sent: list[Any] = []
        self._receive: dict[str, Any] = {}
        self._take: dict[str, Any] = {}
        self.types = types = own_types(perception=True)

        def publish(topic: str, message: Any) -> None:
            types.write(message)
            self.published.append((topic, message))

        def ignore(*_: Any, **__: Any) -> None:
            """Do nothing."""

        node: Any = SimpleNamespace(types=types, publish=publish, client=None, join=self._receive.__setitem__)
        node.advertise = node.watch = ignore
        node.subscribe = lambda endpoint, take, **_: self._take.update({endpoint.topic: take})
        node.send = lambda _, message: self.sent.append(message)
        node.listened = lambda _: False
        node.endpoint = lambda kind, topic, type_, qos: Endpoint(Node(0, "", "", "", 0), 0, kind, topic, type_, "", qos)
        self._work = Work(load(None, {"store": "none", **given}).settings, node)
        self._work.open()
        self._work._bridge._streams[stream].epoch = bytes(16)

    def receive(self, *messages: Any, topic: str = "tracks") -> None:
        for message in messages:
            arrival = Arrival(f"optipmb/v1/{self.stream}/{topic}", encode(message), encoding_of(message), 0)
            self._receive[self.stream](arrival)
        while self._work._queue:
            self._work.work(0.05)

    def put(self, topic: str, kind: str, **fields: Any) -> None:
        """Put a message of ROS into the queue."""
        self._take[topic](TopicKey(0, topic, kind, NO_HASH), self.types.write(self.types.new(kind, **fields)))

    def of(self, kind: str) -> list[Any]:
        return [one for _, one in self.published if one.__msgtype__ == kind]


def test_tracks_that_ros_cannot_hold_keep_no_others_waiting() -> None:
    """Tracks after January 2038 are logged with their key, and tracks of the next frames are published."""
    stream = "garage/robot-1/lidar"
    bridging = Bridging(stream, ros2={"streams": {stream: {"detections": "/boxes"}}})
    stamps = (10**18, 2**62, 10**18 + 10**8)
    with capture_logs() as logs:
        bridging.receive(*(tracks_message(stream, seq, [1], stamp_ns=one) for seq, one in enumerate(stamps)))
    found = [one.header.stamp for one in bridging.of(TRACKED)]
    assert [one.sec * 10**9 + one.nanosec for one in found] == [10**18, 10**18 + 10**8]
    ((what, said),) = [(one["key"], one["message"]) for one in logs if one["event"] == "problem"]
    assert what == f"optipmb/v1/{stream}/tracks"
    assert "2147483647" in said


def test_static_transforms_stay_where_more_comes_than_can_be_handled() -> None:
    """They are said once: without them no later detections would have a pose."""
    stream = "garage/robot-1/lidar"
    bridging = Bridging(stream, ros2={"streams": {stream: {"detections": "/boxes"}}})
    turn = {"rotation": {"w": 1.0}}
    fixed = {"header": header_of(1, "map"), "child_frame_id": "lidar", "transform": turn}
    bridging.put("/tf_static", TF, transforms=[fixed])
    for stamp_ns in range(1, QUEUE + 1):
        bridging.put("/boxes", "vision_msgs/msg/Detection3DArray", header=header_of(stamp_ns, "lidar"))
    bridging.receive()
    assert len(bridging.sent) == QUEUE - 1
    assert bridging.sent[-1].stamp_ns == QUEUE


def test_a_wrong_transform_takes_no_other_along() -> None:
    """One message has transforms of many frames: the wrong one is logged with its place, and the others hold."""
    stream = "garage/robot-1/lidar"
    bridging = Bridging(stream, ros2={"streams": {stream: {"detections": "/boxes"}}})
    fixed = {"header": header_of(1, "map"), "child_frame_id": "lidar", "transform": {"rotation": {"w": 1.0}}}
    with capture_logs() as logs:
        bridging.put("/tf", TF, transforms=[fixed | {"child_frame_id": "arm", "transform": {}}, fixed])
        bridging.put("/boxes", "vision_msgs/msg/Detection3DArray", header=header_of(1, "lidar"))
        bridging.receive()
    ((topic, said),) = [(one["topic"], one["message"]) for one in logs if one["event"] == "problem"]
    assert topic == "/tf"
    assert said.startswith("transforms[0]")
    assert len(bridging.sent) == 1


@pytest.mark.parametrize("outputs", [{}, {"garage/*/*": {}}])
def test_collective_perception_messages_have_a_topic_below_the_tracks(outputs: dict[str, Any]) -> None:
    """Of twenty objects each, of the states that `outputs` predicts where the stream has them."""
    stream = "garage/robot-1/lidar"
    about: dict[str, Any] = {
        "sites": {"garage": {"origin": (48.0, 11.0, 500.0)}},
        "cpm": {"garage/*/*": {"station_id": 7}},
    }
    about["ros2"] = {"streams": {stream: {"detections": "/boxes", "cpm": True}}}
    bridging = Bridging(stream, outputs=outputs, **about)
    at = 1_167_609_600 * 10**9  # 2007-01-01, 94,694,401,000 ms in TimestampIts
    one = tracks_message(stream, 0, range(25), stamp_ns=at, confirmed=1)
    bridging.receive(one)
    bridging.receive(one.model_copy(update={"predicted_to_ns": at + 10**8}), topic="now")
    found = [(topic, message.payload) for topic, message in bridging.published if message.__msgtype__ == CPM]
    assert [topic for topic, _ in found] == ["/boxes/tracks/cpm"] * 2
    times = {payload.management_container.reference_time.value for _, payload in found}
    assert times == {94_694_401_000 + (100 if outputs else 0)}
    containers = [payload.cpm_containers.value.array[0] for _, payload in found]
    objects = [one.container_data_perceived_object_container for one in containers]
    assert [len(one.perceived_objects.array) for one in objects] == [20, 5]
    assert {one.number_of_perceived_objects.value for one in objects} == {25}
