"""The backlog of a session: what waits there is bounded, in order, and in one place; what leaves unprocessed counts."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.streams.backlog import UNASKED_NS, UNLIMITED, Backlog, BacklogBounds, ByteBudget
from optipmb_service.units import SECOND
from optipmb_service.zenoh.topics import PACKET_BYTES, Packet

TOPICS = {True: "detections", False: "points"}


class Lost:
    def __init__(self) -> None:
        self.packets: list[Packet] = []

    def __call__(self, _: str, packets: list[Packet]) -> None:
        self.packets += packets


def bounds_of(**limits: Any) -> BacklogBounds:
    """Return bounds; the default is none."""
    bounds = BacklogBounds(Lost(), UNLIMITED, UNLIMITED, UNLIMITED, ByteBudget(), ByteBudget(), UNLIMITED)
    return replace(bounds, **limits)


def live(**limits: Any) -> Backlog:
    """Return a backlog whose stream processes messages as they come."""
    backlog = Backlog("a/b/c", bounds_of(**limits), 0)
    backlog.attach(lambda: None, lambda *_: None)
    backlog.go_live()
    return backlog


def packet(number: int = 0, *, frame: bool = True, size: int = 0, at_s: float = 0, stream: str = "s") -> Packet:
    return Packet(f"{stream}/{TOPICS[frame]}", bytes(size), size, "", number, round(at_s * SECOND))


def taken(backlog: Backlog) -> list[Packet]:
    """Take all packets; commands are run."""
    packets = []
    while (item := backlog.take()) is not None:
        if isinstance(item, Packet):
            packets.append(item)
        else:
            item()
    return packets


def numbers(packets: list[Packet]) -> list[int]:
    return [one.wall_ns for one in packets]


@settings(deadline=None)
@given(st.lists(st.integers(0, 2), max_size=60), st.integers(1, 5), st.integers(1, 5))
def test_a_live_backlog_is_bounded_ordered_and_counts(kinds: list[int], frames: int, clouds: int) -> None:
    """The newest frames and clouds stay, in order, clouds first; commands are never lost; the rest is counted."""
    backlog, ran = live(frames=frames, clouds=clouds), list[int]()
    for number, kind in enumerate(kinds):
        if kind == 2:
            backlog.command(lambda number=number: ran.append(number), urgent=False)  # type: ignore[misc]  # bound now
        else:
            backlog.push(packet(number, frame=kind == 0))
    sent = [[number for number, kind in enumerate(kinds) if kind == wanted] for wanted in range(3)]
    assert numbers(taken(backlog)) == sent[1][-clouds:] + sent[0][-frames:]
    assert ran == sent[2]
    assert backlog.counts() == (0, max(0, len(sent[0]) - frames), max(0, len(sent[1]) - clouds))


def test_urgent_commands_go_first() -> None:
    """A question overtakes the frames that wait, an ordinary command does not."""
    backlog, order = live(), []
    backlog.push(packet())
    backlog.command(lambda: order.append("later"), urgent=False)
    backlog.command(lambda: order.append("now"), urgent=True)
    while (item := backlog.take()) is not None:
        order.append("frame") if isinstance(item, Packet) else item()
    assert order == ["now", "frame", "later"]


def test_no_sensor_takes_the_room_of_another() -> None:
    """A sensor that floods a session loses its own frames and clouds, and the loss is counted for it."""
    backlog = live(frames=3, clouds=2, bytes=4000)
    for frame in (True, False):
        backlog.push(packet(frame=frame, stream="slow"))
    for number in range(9):
        for frame in (True, False):
            backlog.push(packet(number, frame=frame, size=10, stream="fast"))
    backlog.push(packet(9, size=3000, stream="fast"))
    assert backlog.shed_since().keys() == {"fast"}
    assert not backlog.shed_since()
    assert {("slow", True), ("slow", False)} <= {(one.origin, one.frame) for one in taken(backlog)}


def test_a_live_backlog_gives_back_what_it_took() -> None:
    """Frames and clouds beyond the bytes go, the oldest clouds first; a message above the bound is not taken."""
    budget = ByteBudget(10 * PACKET_BYTES)
    backlog = live(bytes=6 * PACKET_BYTES, queued=budget)
    for number in range(4):
        backlog.push(packet(number, frame=False))
    for number in range(4):
        backlog.push(packet(number))
    assert (backlog.counts(), budget.used) == ((4, 0, 2), 6 * PACKET_BYTES)
    backlog.push(packet(9, size=7 * PACKET_BYTES))
    assert (backlog.counts(), budget.used) == ((0, 5, 4), 0)
    assert backlog.take() is None


@given(st.lists(st.tuples(st.integers(1, 50), st.booleans(), st.floats(0, 2)), max_size=60))
def test_what_waits_for_a_takeover_is_bounded(arrivals: list[tuple[int, bool, float]]) -> None:
    """By bytes over all streams and by age; the rest is in order, clouds go before frames."""
    budget = ByteBudget(4 * PACKET_BYTES)
    bounds = bounds_of(held=budget, keep_ns=5 * SECOND)
    backlogs = [Backlog("a/b/c", bounds, 0), Backlog("a/b/d", bounds, 0)]
    now_s = 0.0
    for number, (size, frame, pause_s) in enumerate(arrivals):
        now_s += pause_s
        backlogs[number % 2].push(packet(size=size, frame=frame, at_s=now_s), own=False)
        assert 0 <= budget.used <= 4 * PACKET_BYTES
    for one in backlogs:
        one.trim(round(now_s * SECOND))
        times = [entry.now_ns for entry in one.recent()]
        assert times == sorted(times)
        assert all(now_s * SECOND - at <= 5 * SECOND + 1 for at in times)
        one.attach(lambda: None, lambda *_: None)
        one.go_live()
        taken(one)
    assert budget.used == 0


@pytest.mark.parametrize("recovered", [False, True])
@pytest.mark.parametrize("room", [3, 6])
def test_clouds_of_a_takeover_go_first(room: int, *, recovered: bool) -> None:
    """When there is no room a session gives up its clouds, then its oldest frames, of any source."""
    backlog = live(held=ByteBudget(room * PACKET_BYTES))
    backlog.open()
    packets = [packet(number, size=0, frame=frame) for number in range(5) for frame in (True, False)]
    if recovered:
        backlog.recover(packets)
    else:
        for one in packets:
            backlog.push(one)
    backlog.go_live()
    left = taken(backlog)
    assert numbers([one for one in left if one.frame]) == list(range(max(0, 5 - room), 5))
    assert len(left) == room


def test_what_was_missed_goes_before_what_waits() -> None:
    """Packets from the log or a cache, then packets received while the session was opened, then newer ones."""
    backlog = live()
    backlog.push(packet(1))
    backlog.open(packet(0))
    backlog.push(packet(2, frame=False))
    assert backlog.take() is None
    backlog.recover([packet(100), packet(101)])
    backlog.go_live()
    backlog.push(packet(3))
    assert numbers(taken(backlog)) == [100, 101, 0, 1, 2, 3]


def test_what_others_received_goes_before_what_was_held_here() -> None:
    """A session that comes here goes on with what others received of it; what both have is taken once."""
    backlog = Backlog("a/b/c", bounds_of(), 0)
    for number in (1, 2):
        backlog.push(packet(number, size=number))
    backlog.bring([packet(0), packet(1, size=1)])
    backlog.attach(lambda: None, lambda *_: None)
    backlog.go_live()
    assert numbers(taken(backlog)) == [0, 1, 2]


def test_brought_messages_take_no_more_room_than_there_is() -> None:
    """The oldest go and are counted, so that other sessions keep their messages."""
    bounds = bounds_of(held=ByteBudget(5 * PACKET_BYTES))
    other, backlog = (Backlog(name, bounds, 0) for name in ("a/b/other", "a/b/c"))
    for number in range(2):
        other.push(packet(number))
    lost = backlog.bring([packet(number) for number in range(6)])
    assert numbers(lost) == [0, 1, 2]
    other.push(packet(2))
    assert (numbers(backlog.recent()), numbers(other.recent())) == ([3, 4, 5], [1, 2])


ACTIONS = st.sampled_from(["own", "cloud", "foreign", "take", "open", "live", "leave", "give", "recover", "trim"])


@settings(deadline=None)
@given(st.lists(ACTIONS, max_size=80), st.integers(1, 12))
def test_every_message_ends_in_one_place(actions: list[str], room: int) -> None:
    """Through all changes of a session, each message to be tracked here is taken, handed over, or counted, once."""
    queued, held, lost = ByteBudget(room * PACKET_BYTES), ByteBudget(room * PACKET_BYTES), Lost()
    backlog = Backlog("a/b/c", bounds_of(lost=lost, frames=4, clouds=2, queued=queued, held=held, keep_ns=0), 0)
    backlog.attach(lambda: None, lambda *_: None)
    sent, ended = list[int](), list[int]()
    changes: dict[str, Any] = {
        "foreign": lambda number: backlog.push(packet(1000 + number), own=False),
        "open": lambda _: backlog.open(),
        "live": lambda _: backlog.go_live(),
        "leave": lambda _: backlog.leave(asked_for=True),
        "recover": lambda number: backlog.recover([packet(1000 + number)]),
        "trim": lambda _: backlog.trim(UNASKED_NS + SECOND),
    }
    for number, action in enumerate(actions):
        if action in {"own", "cloud"}:
            assert backlog.push(packet(number, frame=action == "own"))
            sent.append(number)
        elif action == "take":
            ended += numbers([item]) if isinstance(item := backlog.take(), Packet) else []
        elif action == "give":
            ended += numbers(backlog.recent()) if backlog.state == "foreign" else []
            backlog.trim(UNASKED_NS + SECOND)  # delivered packets are dropped uncounted
        else:
            changes[action](number)
    backlog.go_live()
    ended += numbers(taken(backlog)) + numbers(lost.packets)
    own = [number for number in ended if number < 1000]
    _, frames, clouds = backlog.counts()
    assert len(own) == len(set(own))
    assert len(sent) == len(own) + frames + clouds
    assert (queued.used, held.used) == (0, 0)


@pytest.mark.parametrize("expected", [True, False])
def test_first_messages_are_kept_until_they_are_asked_for(*, expected: bool) -> None:
    """What a new stream sent is kept beyond the usual time until its member has asked; no other stream's is."""
    backlog = Backlog("a/b/c", bounds_of(keep_ns=10 * SECOND), 0)
    backlog.unasked = expected
    backlog.push(packet(), own=False)
    assert backlog.trim(UNASKED_NS) is not expected
    assert len(backlog.recent()) == expected
    backlog.trim(10 * SECOND + 1)
    assert not backlog.recent()
