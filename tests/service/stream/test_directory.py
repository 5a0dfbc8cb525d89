"""Which streams a discoverer announces that have no session."""

from optipmb_service.streams.directory import BACK_NS, MAX_UNPROVEN_ANNOUNCED, QUEUED_NS, UNPROVEN_NS, StreamDirectory
from optipmb_service.units import SECOND

IDLE_NS = 600 * SECOND


class Discoverer:
    """A directory, with the sessions that there are."""

    def __init__(self) -> None:
        self.sessions: set[str] = set()
        self.directory = StreamDirectory("a", IDLE_NS, self.sessions.__contains__)

    def hear(self, now_ns: int, *streams: str) -> set[str]:
        """Notice a message of each stream; which streams are announced then."""
        for stream in streams:
            assert self.directory.noticed(stream, now_ns, recoverable=False)
        self.directory.expire(now_ns, discovering=True)
        return self.directory.announced()


def test_caches_are_awaited_of_publishers_that_are_there_or_may_come_back() -> None:
    """Caches of sensors present before, except sensors without a cache and sensors absent for long."""
    streams = front, rear, plain, other = ["site/node/front", "site/node/rear", "site/node/plain", "site/car/lidar"]
    one = StreamDirectory("a", IDLE_NS, lambda _: True)
    one.began_ns = SECOND

    def awaited(now_ns: int, *sensors: str) -> dict[str, bool]:
        return one.awaited("site/node", lambda stream: stream.startswith("site/node/"), sensors, now_ns)

    assert awaited(SECOND + BACK_NS - 1, front) == {front: False}
    assert awaited(SECOND + BACK_NS, front) == {}
    for stream in (front, rear, other):
        one.published(stream, "token", 2 * SECOND, present=True)
    one.noticed(plain, 2 * SECOND, recoverable=False)
    assert awaited(2 * SECOND, plain) == awaited(2 * BACK_NS, *streams[:3]) == {front: True, rear: True}
    one.published(front, "token", 3 * BACK_NS, present=False)
    assert awaited(4 * BACK_NS - 1, front) == {rear: True, front: False}
    assert awaited(4 * BACK_NS, front) == {rear: True}


def names(count: int, site: str = "site") -> list[str]:
    return [f"{site}/node-{number}/lidar" for number in range(count)]


def test_names_without_a_session_cost_a_bounded_number_of_tokens() -> None:
    """Of many streams that get no session a few are announced at once, and all are forgotten soon."""
    one, many = Discoverer(), names(50 * MAX_UNPROVEN_ANNOUNCED)
    assert one.hear(0, *many) == set(many[:MAX_UNPROVEN_ANNOUNCED])
    assert len(one.directory.streams()) == MAX_UNPROVEN_ANNOUNCED
    for turn in range(1, QUEUED_NS // UNPROVEN_NS + 3):
        assert len(one.hear(turn * (UNPROVEN_NS + 1))) <= MAX_UNPROVEN_ANNOUNCED
        assert len(one.directory.streams()) <= 3 * MAX_UNPROVEN_ANNOUNCED
    one.hear(QUEUED_NS + 5 * UNPROVEN_NS)
    assert one.directory.streams() == {}


def test_a_fleet_that_begins_at_once_is_announced() -> None:
    """Ten thousand streams that send one message and get sessions are all announced, in turns, and stay so."""
    one, fleet = Discoverer(), names(10_000)
    announced, now_ns = one.hear(0, *fleet), 0
    while len(announced) < len(fleet):
        assert len(announced - one.sessions) == MAX_UNPROVEN_ANNOUNCED
        one.sessions |= announced
        now_ns += SECOND
        announced = one.hear(now_ns)
    one.sessions |= announced
    assert one.hear(now_ns + 2 * UNPROVEN_NS) == set(fleet)
    assert now_ns < QUEUED_NS
