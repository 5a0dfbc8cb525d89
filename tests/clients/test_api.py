"""Publisher and Subscriber through a real router; plain Zenoh sessions play the other side."""

import re
import threading
import time
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from opentelemetry.sdk.trace import TracerProvider
from optipmb_client import Connection, ConnectionFailed, EventSubscriber, Publisher, Subscriber
from optipmb_client.incoming import Inbox
from optipmb_client.links import Link
from optipmb_schemas import (
    Delivery,
    Detections,
    Events,
    Keys,
    Message,
    MessageError,
    Points,
    Pose,
    Problem,
    Tracks,
    decode,
    encode,
    encoding_of,
)
from proxy import Proxy
from router import until
from routers import free_endpoint, open_client
from tracks_message import SESSION, tracks_message

DEADLINE_S = 60.0
STREAM = "garage/robot-1/lidar"
POSE = ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0])
ONE = {"label": ["Car"], "center": [[1, 2, 0]], "size": [[4, 2, 1.5]], "yaw": [0.1], "score": [0.9]}


@pytest.fixture
def link(endpoint: str) -> Iterator[Connection]:
    with Connection(endpoint) as connection:
        yield connection


def listen(connection: Connection, topic: str) -> Inbox:
    inbox = Inbox(10_000)
    connection.subscribe(f"optipmb/v1/*/*/*/{topic}", inbox)
    return inbox


def tracks(seq: int, **changes: Any) -> Tracks:
    return tracks_message(STREAM, seq, **changes)


def problem(message: str) -> Problem:
    return Problem(stream=STREAM, instance="test", code="malformed", message=message)


class Service:
    """The other side of a subscriber: puts payloads on the stream's keys."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def put(self, topic: str, payload: bytes, encoding: str = "") -> None:
        self._session.put(
            f"optipmb/v1/{STREAM}/{topic}", payload, encoding=encoding or None, priority=zenoh.Priority.DATA_HIGH
        )

    def tracks(self, *messages: Tracks) -> None:
        for message in messages:
            self.put("tracks", encode(message), encoding_of(Tracks))


@pytest.fixture
def service(endpoint: str) -> Iterator[Service]:
    with open_client(endpoint) as session:
        yield Service(session)


def test_messages_carry_the_context_of_the_active_span(link: Connection) -> None:
    """Detections and clouds do, whichever way they are published; without a span they carry nothing."""
    boxes, clouds = listen(link, "detections"), listen(link, "points")
    tracer = TracerProvider(shutdown_on_exit=False).get_tracer("node")
    with Publisher(STREAM, connection=link) as publisher:
        until(lambda: publisher.points_wanted, "clouds are wanted")
        with tracer.start_as_current_span("detect") as span:
            publisher.publish(stamp_ns=5, pose=POSE, points=[[1.0, 2.0, 3.0]], **ONE)
            publisher.publish_points(stamp_ns=6, pose=POSE, points=[[1.0, 2.0, 3.0]])
        publisher.publish(stamp_ns=7, pose=POSE, **ONE)
        arrivals = [inbox.get(DEADLINE_S) for inbox in (boxes, clouds, clouds, boxes)]
    context = span.get_span_context()
    said = f"00-{context.trace_id:032x}-{context.span_id:016x}-{context.trace_flags:02x}"
    assert [one.traceparent for one in arrivals if one] == [said, said, said, ""]


def test_detections_arrive_as_published(link: Connection) -> None:
    """What `publish` was given is what a receiver decodes, with the publisher's epoch and numbers from 0."""
    inbox = listen(link, "detections")
    with Publisher(STREAM, connection=link) as publisher:
        for stamp in (5, 6):
            spread = [np.diag([0.5, 0.2, 1.0]).tolist()]
            publisher.publish(stamp_ns=stamp, velocity=[[np.nan, np.nan]], position_covariance=spread, pose=POSE, **ONE)
        arrivals = [inbox.get(10.0), inbox.get(10.0)]
    first, second = (decode(a.payload, Detections, encoding=a.encoding) for a in arrivals if a)
    assert (first.seq, second.seq, first.stamp_ns, second.stamp_ns) == (0, 1, 5, 6)
    assert first.epoch == second.epoch == publisher.epoch
    assert (first.stream, first.frame, first.labels) == (STREAM, "sensor", ("Car",))
    assert first.pose is not None
    assert first.pose.translation.tolist() == [1.0, 2.0, 3.0]
    assert first.center.tolist() == [[1.0, 2.0, 0.0]]
    assert first.size.tolist() == [[4.0, 2.0, 1.5]]
    assert (first.yaw.tolist(), first.score.tolist(), first.label.tolist()) == ([0.1], [0.9], [0])
    assert first.velocity is not None
    assert np.isnan(first.velocity).all()
    assert first.position_covariance is not None
    assert first.position_covariance.tolist() == spread
    assert first.has_points is None


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from(["Car", "Pedestrian", "Cyclist"]), max_size=6))
def test_class_names_and_indices_say_the_same(names: list[str]) -> None:
    """Names per object, and indices into a list of names, give detections of the same classes."""
    sent: list[bytes] = []
    known = ["Cyclist", "Car", "Pedestrian"]
    count = len(names)
    boxes = {
        "center": np.zeros((count, 3)),
        "size": np.ones((count, 3)),
        "yaw": np.zeros(count),
        "score": np.ones(count),
    }
    with offline_publisher(sent, "world") as publisher:
        publisher.publish(stamp_ns=0, label=names, **boxes)
        publisher.publish(stamp_ns=1, label=[known.index(name) for name in names], labels=known, **boxes)
    for payload in sent:
        message = decode(payload, Detections)
        assert [message.labels[index] for index in message.label] == names


class Recorder:
    """A connection that only records sent messages."""

    def __init__(self, sent: list[bytes], *, wanted: bool) -> None:
        self.wanted = wanted
        self.put = lambda payload, _: sent.append(payload)

    def senders(self, *_: object, **__: object) -> tuple["Recorder", "Recorder"]:
        return self, self

    def pack(self, message: Message) -> bytes:
        return encode(message)

    def close(self) -> None:
        """Do nothing."""


def offline_publisher(sent: list[bytes], frame: str = "sensor", *, wanted: bool = True) -> Publisher:
    return Publisher(STREAM, connection=cast("Link", Recorder(sent, wanted=wanted)), frame=cast("Any", frame))


BAD = [
    ({"score": [1.5]}, "score[0]"),
    ({"score": [float("nan")]}, "score[0]"),
    ({"size": [[4, 0, 1.5]]}, "size[0][1]"),
    ({"center": [[1, 2]]}, "center"),
    ({"yaw": [0.0, 1.0]}, "yaw"),
    ({"label": [7]}, "label[0]"),
    ({"label": [1], "labels": ["Car"]}, "label"),
    ({"pose": None}, "pose"),
    ({"pose": ([0, 0, 0], [2.0, 0, 0, 0])}, "quaternion"),
    ({"stamp_ns": -1}, "stamp_ns"),
    ({"label": "Car"}, "label"),
    ({"label": 1}, "label"),
    ({"center": [[1, 2, 3], [1, 2]]}, "center[1]"),
    ({"center": 5}, "center"),
    ({"pose": np.eye(4)}, "pose"),
    ({"pose": 5}, "pose"),
    ({"points": [[1, 2, 3], [1, 2]]}, "xyz[1]"),
    ({"points": [[1, 2, float("nan")]]}, "xyz[0][2]"),
    ({"stamp_ns": 1.5}, "stamp_ns"),
    ({"velocity": [[np.inf, 0]]}, "velocity[0][0]"),
    ({"points": np.zeros((4, 2), np.float32)}, "xyz"),
    ({"points": "nonsense"}, "xyz"),
    ({"relocation": 5}, "relocation"),
    ({"relocation": ([0, 0, 0], [0.8, 0.6, 0, 0])}, "relocation.quaternion"),
    ({"relocation": ([0, 0], [1.0, 0, 0, 0])}, "relocation.translation"),
    ({"attributes": []}, "attributes"),
    ({"attributes": [7]}, "attributes[0]"),
    ({"attributes": [{"plate": 7}]}, "attributes[0].text"),
    ({"attributes": [{"plate": ("AB 1", 2.0)}]}, "attributes[0].score"),
    ({"points_pose": ([0, 0], [1.0, 0, 0, 0]), "points": np.zeros((4, 3), np.float32)}, "translation"),
]


@pytest.mark.parametrize(("wrong", "path"), BAD, ids=[next(iter(wrong)) + str(n) for n, (wrong, _) in enumerate(BAD)])
def test_a_wrong_argument_is_named_and_nothing_is_sent(wrong: dict[str, object], path: str) -> None:
    """Bad values raise MessageError with the path of the field; nothing goes out, and no number is used up."""
    sent: list[bytes] = []
    with offline_publisher(sent) as publisher:
        with pytest.raises(MessageError, match=re.escape(path)):
            publisher.publish(**({"stamp_ns": 0, "pose": POSE} | ONE | wrong))  # type: ignore[arg-type]  # wrong on purpose
        assert sent == []
        assert publisher.publish(stamp_ns=0, pose=POSE, **ONE) == 0


def test_an_unknown_frame_is_refused() -> None:
    """`frame` is sensor or world."""
    with offline_publisher([], "car") as publisher, pytest.raises(MessageError, match="frame"):
        publisher.publish(stamp_ns=0, pose=POSE, **ONE)


@pytest.mark.parametrize("stream", ["a/b", "a/b/c/d", "a/b/ c", "a/*/c", "", "owner/b/c"])
def test_a_name_that_is_no_stream_is_refused_before_connecting(stream: str) -> None:
    """A bad stream name raises MessageError at once, whether or not there is a network."""
    with pytest.raises(MessageError, match="stream"):
        Publisher(stream, free_endpoint(), timeout=30.0)


def test_a_cloud_is_sent_before_its_detections() -> None:
    """With points, the cloud goes first, with the same stamp, and the detections announce it."""
    sent: list[bytes] = []
    points = np.arange(12, dtype=np.float32).reshape(3, 4)
    with offline_publisher(sent) as publisher:
        publisher.publish(stamp_ns=7, pose=POSE, points=points, points_pose=([9, 9, 9], [1.0, 0, 0, 0]), **ONE)
    cloud, boxes = decode(sent[0], Points), decode(sent[1], Detections)
    assert (cloud.stamp_ns, boxes.stamp_ns, boxes.has_points, cloud.seq) == (7, 7, True, 0)
    assert cloud.epoch == boxes.epoch
    assert cloud.xyz.tolist() == points[:, :3].tolist()
    assert cloud.pose is not None
    assert cloud.pose.translation.tolist() == [9.0, 9.0, 9.0]


def test_a_motion_of_the_world_is_counted_and_repeated() -> None:
    """Given once, it is in all later messages; a message that is refused does not count."""
    sent: list[bytes] = []
    turn = [0.8, 0.0, 0.0, 0.6]
    with offline_publisher(sent) as publisher:
        publisher.publish(stamp_ns=0, pose=POSE, **ONE)
        publisher.publish(stamp_ns=1, pose=POSE, relocation=([5, 6, 7], turn), **ONE)
        publisher.publish(stamp_ns=2, pose=POSE, **ONE)
        with pytest.raises(MessageError, match="score"):
            publisher.publish(stamp_ns=3, pose=POSE, relocation=([0, 0, 1], turn), **(ONE | {"score": [2.0]}))
        publisher.publish(stamp_ns=3, pose=POSE, relocation=Pose(translation=[0, 0, 1], quaternion=turn), **ONE)
    said = [decode(payload, Detections).relocation for payload in sent]
    assert [one and (one.world, one.translation.tolist()) for one in said] == [
        None,
        (1, [5.0, 6.0, 7.0]),
        (1, [5.0, 6.0, 7.0]),
        (2, [0.0, 0.0, 1.0]),
    ]


def test_points_without_a_return_are_left_out() -> None:
    """Rows with a coordinate that is not finite are not sent; the others are, in order."""
    sent: list[bytes] = []
    points = np.array([[1, 1, 1], [np.nan, 0, 0], [2, 2, 2], [0, np.inf, 0]], dtype=np.float32)
    with offline_publisher(sent) as publisher:
        publisher.publish(stamp_ns=7, pose=POSE, points=points, **ONE)
    assert decode(sent[0], Points).xyz.tolist() == [[1, 1, 1], [2, 2, 2]]


def test_clouds_that_nobody_wants_are_not_sent_unless_insisted() -> None:
    """Without a subscriber to clouds the detections do not announce one; `has_points=True` sends it in any case."""
    sent: list[bytes] = []
    points = np.zeros((3, 3), dtype=np.float32)
    with offline_publisher(sent, wanted=False) as publisher:
        publisher.publish(stamp_ns=7, pose=POSE, points=points, **ONE)
        assert [decode(payload, Detections).has_points for payload in sent] == [None]
        publisher.publish(stamp_ns=8, pose=POSE, points=points, has_points=True, **ONE)
        assert decode(sent[1], Points).stamp_ns == 8
        assert decode(sent[2], Detections).has_points is True
        assert publisher.publish_points(stamp_ns=9, points=points, pose=POSE) is None
        assert len(sent) == 3


def test_a_frame_without_cloud_says_so_once_the_stream_has_clouds() -> None:
    """Before the first cloud has_points is left open; after it, a frame without one says that none comes."""
    sent: list[bytes] = []
    with offline_publisher(sent) as publisher:
        publisher.publish(stamp_ns=1, pose=POSE, **ONE)
        assert publisher.publish_points(stamp_ns=2, points=np.zeros((1, 3), np.float32), pose=POSE) == 0
        publisher.publish(stamp_ns=3, pose=POSE, **ONE)
    assert decode(sent[0], Detections).has_points is None
    assert decode(sent[2], Detections).has_points is False


def test_arrays_of_other_kinds_are_taken() -> None:
    """Integers of numpy, float32 arrays, empty lists and objects with `__array__` are all valid arguments."""

    class Tensor:
        def __array__(self, dtype: object = None, *, copy: bool | None = None) -> np.ndarray:
            return np.ones((1, 3), np.float32)

    sent: list[bytes] = []
    with offline_publisher(sent, "world") as publisher:
        none: Any = {"velocity": [], "position_covariance": []}
        publisher.publish(stamp_ns=np.int64(3), label=[], center=[], size=[], yaw=[], score=[], **none)
        publisher.publish(stamp_ns=4, label=["Car"], center=Tensor(), size=Tensor(), yaw=np.zeros(1, "f4"), score=[1])
    assert decode(sent[0], Detections).center.shape == (0, 3)
    assert decode(sent[1], Detections).center.tolist() == [[1.0, 1.0, 1.0]]


def test_numbers_stay_in_order_from_many_threads(link: Connection) -> None:
    """Frames published by several threads at once carry each number once, and go out in the order of the numbers."""
    inbox = listen(link, "detections")
    with Publisher(STREAM, connection=link, cache=400) as publisher:

        def publish() -> None:
            for _ in range(50):
                publisher.publish(stamp_ns=0, pose=POSE, **ONE)

        threads = [threading.Thread(target=publish) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        arrivals = [inbox.get(10.0) for _ in range(200)]
    assert [decode(a.payload, Detections).seq for a in arrivals if a] == list(range(200))


def test_a_late_service_gets_the_frames_kept(link: Connection) -> None:
    """A service that comes after the frames receives the newest `cache` of them."""
    with Publisher(STREAM, connection=link, cache=3) as publisher:
        for stamp in range(10):
            publisher.publish(stamp_ns=stamp, pose=POSE, **ONE)
        inbox = Inbox(10)
        link.subscribe("optipmb/v1/*/*/*/detections", inbox)
        arrivals = [inbox.get(10.0) for _ in range(3)]
    assert [decode(a.payload, Detections).seq for a in arrivals if a] == [7, 8, 9]


def test_publishing_after_close_is_one_clear_error(endpoint: str) -> None:
    """A closed publisher raises ConnectionFailed, and may be closed again."""
    publisher = Publisher(STREAM, endpoint)
    publisher.close()
    publisher.close()
    with pytest.raises(ConnectionFailed, match="closed"):
        publisher.publish(stamp_ns=0, pose=POSE, **ONE)


@pytest.mark.parametrize("pattern", [STREAM, "garage/*/*", "*/*/*", "*/robot-1/lidar"])
def test_subscriber_takes_names_and_patterns(link: Connection, service: Service, pattern: str) -> None:
    """The name of a stream and every pattern of it receive its tracks; the loop ends after the timeout."""
    with Subscriber(pattern, connection=link, timeout=0.5) as subscriber:
        settle(subscriber, service)
        service.tracks(tracks(1), tracks(2))
        assert [message.seq for message in received(subscriber, 2)] == [1, 2]


def settle(subscriber: Subscriber, service: Service) -> None:
    """Wait until what the service puts arrives at the subscriber: its declaration has reached the other session.

    The epoch is one that no test uses: a frame of a test must not be a correction of one that came from here.
    """
    deadline = time.monotonic() + DEADLINE_S
    number = -1
    arrived = None
    while arrived is None:
        assert time.monotonic() < deadline, "nothing arrives"
        number += 1
        service.tracks(tracks(number, epoch=b"settle".ljust(16)))
        arrived = subscriber.receive(0.05)
    while arrived is not None and arrived.tracks.seq != number:
        arrived = subscriber.receive(DEADLINE_S)


def received(subscriber: Subscriber, count: int) -> list[Tracks]:
    """Return `count` messages and all further ones until the subscriber's timeout."""
    first = [subscriber.receive(DEADLINE_S) for _ in range(count)]
    return [*(one.tracks for one in first if one is not None), *subscriber]


def test_old_tracks_come_where_they_are_asked_for(endpoint: str, link: Connection) -> None:
    """By default those from now on, of no stream that has ended; with history all that is kept, marked as recovered."""
    others = [tracks_message("garage/robot-2/lidar", seq) for seq in range(3)]
    keys, encoding = Keys(), encoding_of(others[0])
    times = dict.fromkeys(("received_ns", "queue_ms", "decode_ms", "step_ms"), 1)
    delivery = {"delivery": Delivery(instance="one", published_ns=time.time_ns(), **times)}
    with Connection(endpoint) as service:
        silent = service.cached_sender(keys.tracks("garage/robot-2/lidar"), encoding, cache=10)
        sender = service.cached_sender(keys.tracks(STREAM), encoding, cache=10)
        for message in others:
            silent.put(encode(message))
        for seq in range(5):
            sender.put(encode(tracks(seq, **delivery)))
        with (
            Subscriber("garage/*/*", connection=link, timeout=2.0) as subscriber,
            Subscriber("garage/*/*", connection=link, timeout=2.0, history=True) as late,
        ):
            kept = [late.receive(DEADLINE_S) for _ in range(8)]
            assert [one.recovered for one in kept if one and one.tracks.stream == STREAM] == [True] * 5
            now = {"delivery": delivery["delivery"].model_copy(update={"published_ns": time.time_ns()})}
            for seq in range(5, 8):
                sender.put(encode(tracks(seq, **now)))
            found = [subscriber.receive(DEADLINE_S) for _ in range(3)]
            assert [(one.tracks.seq, one.recovered) for one in found if one] == [(5, False), (6, False), (7, False)]
            assert [one.tracks.seq for one in (late.receive(DEADLINE_S) for _ in range(3)) if one] == [5, 6, 7]
            assert subscriber.receive(1.5) is None  # nor do heartbeats bring any
            assert subscriber.missed == ()


def test_the_first_tracks_after_a_subscriber_is_made_come(endpoint: str) -> None:
    """Over a network that takes its time, too, though the publisher was there before."""
    with Proxy(endpoint, delay_s=0.05) as far, Connection(endpoint) as service, Connection(far.endpoint) as link:
        sender = service.cached_sender(Keys().tracks(STREAM), encoding_of(Tracks), cache=10)
        sender.put(encode(tracks(0)))
        with Subscriber(STREAM, connection=link) as subscriber:
            for seq in (1, 2):
                sender.put(encode(tracks(seq)))
            found = [subscriber.receive(DEADLINE_S) for _ in range(2)]
            assert [one.tracks.seq for one in found if one] == [1, 2]


@pytest.mark.parametrize("pattern", ["garage/*", "garage/**", "a/b/c/d", "gar*/a/b", "$*/a/b", ""])
def test_a_pattern_that_is_none_is_refused(pattern: str) -> None:
    """Only whole names may be replaced by a star."""
    with pytest.raises(MessageError, match="stream"):
        Subscriber(pattern, free_endpoint(), connect_timeout=30.0)


def test_repeated_messages_are_left_out_and_newer_revisions_kept(link: Connection, service: Service) -> None:
    """The same frame again, or an older revision of it, is not given out; a newer revision, session or epoch is."""
    with Subscriber(STREAM, connection=link, timeout=0.5) as subscriber:
        settle(subscriber, service)
        before = subscriber.statistics.repeated
        service.tracks(
            tracks(1),
            tracks(1),
            tracks(2, revision=1),
            tracks(2),
            tracks(2, revision=2, gap=1),
            tracks(1, session="a" * 32),
            tracks(1, epoch=bytes(15) + b"x"),
        )
        assert [(m.seq, m.revision, m.session, m.epoch) for m in received(subscriber, 5)] == [
            (1, 0, SESSION, bytes(16)),
            (2, 1, SESSION, bytes(16)),
            (2, 2, SESSION, bytes(16)),
            (1, 0, "a" * 32, bytes(16)),
            (1, 0, SESSION, bytes(15) + b"x"),
        ]
        assert subscriber.statistics.repeated - before == 2


def test_corrections_can_be_left_out(link: Connection, service: Service) -> None:
    """A program that does not look back gets every frame once; what corrected it is counted."""
    with Subscriber(STREAM, connection=link, timeout=0.5, corrections=False) as subscriber:
        settle(subscriber, service)
        service.tracks(tracks(1), tracks(2), tracks(1, revision=1, gap=1), tracks(2, revision=1), tracks(3))
        assert [(m.seq, m.revision) for m in received(subscriber, 3)] == [(1, 0), (2, 0), (3, 0)]
        assert subscriber.statistics.corrected == 1


def test_garbage_between_tracks_is_counted_and_passed_over(link: Connection, service: Service) -> None:
    """Bytes that are no message, and messages of another type, do not disturb the loop."""
    with Subscriber(STREAM, connection=link, timeout=0.5) as subscriber:
        settle(subscriber, service)
        service.put("tracks", b"\xff\xff garbage", encoding_of(Tracks))
        service.put("tracks", encode(problem("x")), encoding_of(Problem))
        service.put("tracks", b"", "")
        service.tracks(tracks(1))
        assert [message.seq for message in received(subscriber, 1)] == [1]
        assert subscriber.statistics.invalid == 3


def test_what_is_no_event_is_counted_and_passed_over(link: Connection, service: Service) -> None:
    """An `EventSubscriber` has the counts of a `Subscriber`."""
    with EventSubscriber(STREAM, connection=link, final=False, timeout=0.05) as subscriber:

        def counted() -> bool:
            service.put("events", b"garbage", encoding_of(Events))
            return not list(subscriber) and subscriber.statistics.invalid > 0

        until(counted, "garbage is counted")
        fields = tracks(1).model_dump(include={"stream", "epoch", "seq", "stamp_ns", "session", "labels"})
        service.put("events", encode(Events(**fields, events=())), encoding_of(Events))
        subscriber.timeout = DEADLINE_S
        assert next(iter(subscriber)).seq == 1
        assert subscriber.statistics.delivered == 1


def test_problems_go_to_the_callback(link: Connection, service: Service) -> None:
    """Problems of the stream reach `on_problem` from the loop, in order with the tracks."""
    seen: list[str] = []
    with Subscriber(STREAM, connection=link, timeout=0.5, on_problem=lambda p: seen.append(p.message)) as subscriber:
        settle(subscriber, service)
        deadline = time.monotonic() + DEADLINE_S
        while not seen and time.monotonic() < deadline:
            service.put("problems", encode(problem("first")), encoding_of(Problem))
            subscriber.receive(0.05)
        service.put("problems", encode(problem("second")), encoding_of(Problem))
        service.put("problems", b"garbage", encoding_of(Problem))
        while seen[-1] != "second":
            assert time.monotonic() < deadline, seen
            subscriber.receive(0.05)
    assert seen[0] == "first"
    assert seen[-1] == "second"


def test_a_slow_program_loses_its_oldest_messages_and_counts_them(link: Connection, service: Service) -> None:
    """Of 100 messages with room for 4, the newest 4 are given out; the others are counted as dropped."""
    with Subscriber(STREAM, connection=link, timeout=0.5, queue=4) as subscriber:
        settle(subscriber, service)
        before = subscriber.statistics.dropped
        service.tracks(*(tracks(number) for number in range(100)))
        deadline = time.monotonic() + DEADLINE_S
        while subscriber.statistics.dropped - before < 96 and time.monotonic() < deadline:
            time.sleep(0.01)  # reading would make room, which is what must not happen here
        assert [message.seq for message in received(subscriber, 4)] == [96, 97, 98, 99]
        assert subscriber.statistics.dropped - before == 96


def test_closing_ends_a_loop_in_another_thread(link: Connection) -> None:
    """`close` ends a loop that waits without a timeout."""
    subscriber = Subscriber(STREAM, connection=link)
    loop = threading.Thread(target=lambda: list(subscriber), daemon=True)
    loop.start()
    subscriber.close()
    loop.join(DEADLINE_S)
    assert not loop.is_alive()


def test_receive_waits_no_longer_than_asked(link: Connection) -> None:
    """`receive` with a timeout returns None when it has passed."""
    with Subscriber(STREAM, connection=link) as subscriber:
        begun = time.monotonic()
        assert subscriber.receive(0.1) is None
        assert time.monotonic() - begun > 0.09
