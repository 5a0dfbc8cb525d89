"""The thread of the bridge to ROS 2: messages, and timers."""

import time
from types import SimpleNamespace
from typing import Any

import optipmb_schemas as schemas
import pytest
from optipmb_client.incoming import Arrival
from optipmb_schemas.ros2.tracks import TRACKED
from optipmb_schemas.ros2.types import own_types
from optipmb_service.edges.ros2.graph import Endpoint, Node
from optipmb_service.edges.ros2.work import Work
from optipmb_service.settings import load
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


def test_tracks_that_ros_cannot_hold_keep_no_others_waiting() -> None:
    """Tracks after January 2038 are logged with their key, and tracks of the next frames are published."""
    given: dict[str, Any] = {}
    published: list[Any] = []

    def publish(topic: str, message: Any) -> None:
        types.write(message)
        published.append(message)

    def ignore(*_: Any, **__: Any) -> None:
        """Do nothing."""

    types = own_types()
    node: Any = SimpleNamespace(types=types, publish=publish, client=None, join=given.__setitem__)
    node.advertise = node.subscribe = node.watch = ignore
    node.listened = lambda _: False
    node.endpoint = lambda kind, topic, type_, qos: Endpoint(Node(0, "", "", "", 0), 0, kind, topic, type_, "", qos)
    stream = "garage/robot-1/lidar"
    settings = load(None, {"store": "none", "ros2": {"streams": {stream: {"detections": "/boxes"}}}}).settings
    work = Work(settings, node)
    work.open()
    work._bridge._streams[stream].epoch = bytes(16)
    with capture_logs() as logs:
        for seq, stamp_ns in enumerate((10**18, 2**62, 10**18 + 10**8)):
            message = tracks_message(stream, seq, [1], stamp_ns=stamp_ns)
            key = f"optipmb/v1/{stream}/tracks"
            given[stream](Arrival(key, schemas.encode(message), schemas.encoding_of(message), 0))
        while work._queue:
            work.work(0.05)
    stamps = [one.header.stamp for one in published if one.__msgtype__ == TRACKED]
    assert [one.sec * 10**9 + one.nanosec for one in stamps] == [10**18, 10**18 + 10**8]
    ((what, said),) = [(one["key"], one["message"]) for one in logs if one["event"] == "problem"]
    assert what == key
    assert "2147483647" in said
