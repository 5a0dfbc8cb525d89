"""What becomes of frames in time: order, duplicates, late ones, gaps, jumps, restarted publishers, waiting."""

from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.session.policy import JumpLimits
from optipmb_service.session.state import FilterState, SensorState
from optipmb_service.session.timeline import WINDOW, Cursor, Decision, FrameId, StreamTimeline, Timeline, Verdict

import optipmb

SECOND = 1_000_000_000
LIMIT = 5 * SECOND
LIMITS = JumpLimits(SECOND, LIMIT)
A, B, C = (bytes([letter]) * 16 for letter in b"abc")


def mark(seq: int, seconds: float, epoch: bytes = A) -> FrameId:
    return FrameId(epoch, seq, round(seconds * SECOND))


def state_after(cursor: Cursor, last: FrameId | None) -> FilterState:
    """The state before a window whose only sensor got as far as a cursor."""
    return FilterState(optipmb.Density.empty(("car",)), "", last=last, sensors={"": SensorState(cursor)})


def judge_all(marks: list[FrameId], *, window: bool = False) -> tuple[list[Decision], Timeline]:
    """Judge frames; without a window none can be gone behind."""
    timeline: Timeline = StreamTimeline(LIMITS, {"": ()})
    decisions, cursor, floor = [], Cursor(), None
    for one in marks:
        decision, timeline = timeline.judge(one)
        decisions.append(decision)
        if decision.verdict.admitted and not window:
            cursor = cursor.after(one, decision.place)
            floor = floor if decision.verdict is Verdict.UNCONFIRMED else one
            timeline = timeline.settle(state_after(cursor, floor), timeline.frame_ids)
    return decisions, timeline


def verdicts(marks: list[FrameId], *, window: bool = False) -> list[Verdict]:
    return [decision.verdict for decision in judge_all(marks, window=window)[0]]


marks = st.builds(
    mark,
    st.integers(0, 40) | st.integers(0, 2**62),
    st.integers(0, 60).map(lambda tenths: tenths / 4) | st.integers(0, 4000),
    st.sampled_from([A, B, C]),
)


@settings(deadline=None)
@given(st.lists(marks, max_size=60), st.booleans())
def test_no_frame_is_admitted_twice(arrived: list[FrameId], window: bool) -> None:  # noqa: FBT001 - drawn
    """For any arrivals in any order, an (epoch, seq) is admitted at most once."""
    decisions, _ = judge_all(arrived, window=window)
    admitted = [(m.epoch, m.seq) for m, d in zip(arrived, decisions, strict=True) if d.verdict.admitted]
    assert len(admitted) == len(set(admitted))


@settings(deadline=None)
@given(st.lists(marks, max_size=60))
def test_time_never_goes_back_in_a_generation(arrived: list[FrameId]) -> None:
    """Without a window, stamps never fall in one life of a density, and (stamp, seq) rises in an era."""
    decisions, _ = judge_all(arrived)
    stamps: dict[int, int] = {}
    places: dict[int, tuple[int, int]] = {}
    for one, decision in zip(arrived, decisions, strict=True):
        if decision.verdict.admitted and decision.verdict is not Verdict.UNCONFIRMED:
            era, generation = decision.place.era, decision.place.generation
            assert one.stamp_ns >= stamps.get(generation, 0)
            assert (one.stamp_ns, one.seq) > places.get(era, (-1, -1))
            stamps[generation] = one.stamp_ns
            places[era] = (one.stamp_ns, one.seq)


@settings(deadline=None)
@given(st.lists(marks, max_size=60), st.booleans())
def test_memory_is_bounded(arrived: list[FrameId], window: bool) -> None:  # noqa: FBT001 - drawn
    """Sequence numbers may leap by 2^62 without the memory of them growing beyond its window."""
    _, timeline = judge_all(arrived, window=window)
    assert all(0 < seen.mask.bit_length() <= WINDOW for seen in timeline.seen[""])
    assert window or not timeline.frame_ids


def test_a_step_back_beyond_the_window_is_a_jump() -> None:
    """Three frames that go on from behind the window begin a new generation, also where they come back into it."""
    jumped = Verdict.UNCONFIRMED
    for back in (1.2, 2, 5):
        stepped = [mark(seq, 10 + seq / 10 - back) for seq in range(2, 6)]
        assert verdicts([mark(0, 10), mark(1, 10.1), *stepped])[2:] == [jumped, jumped, Verdict.RESTART, Verdict.NEXT]
    twice = [mark(0, 10), mark(1, 10.1), mark(2, 8), mark(3, 8.1), mark(4, 10.2)]
    assert verdicts(twice)[2:] == [jumped, jumped, Verdict.NEXT]


def test_the_gap_limit_itself_is_no_jump() -> None:
    """A step of exactly the limit continues, one nanosecond more is a jump."""
    assert verdicts([mark(0, 0), mark(1, 5)])[1] is Verdict.NEXT
    assert verdicts([mark(0, 0), FrameId(A, 1, LIMIT + 1)])[1] is Verdict.UNCONFIRMED


def test_stamps_that_do_not_agree_are_no_jump() -> None:
    """One stamp ahead, twice, or several that contradict each other: the others go on in their generation."""
    twice = [mark(0, 0), mark(1, 6.1), mark(2, 0.2), mark(3, 6.3), mark(4, 0.4)]
    jumped = Verdict.UNCONFIRMED
    assert verdicts(twice) == [Verdict.FIRST, jumped, Verdict.NEXT, jumped, Verdict.NEXT]
    wild = [mark(0, 1000), mark(1, 5000), mark(2, 100), mark(3, 9000), mark(4, 50), mark(5, 1000.5)]
    assert verdicts(wild) == [Verdict.FIRST, jumped, jumped, jumped, jumped, Verdict.NEXT]


def test_an_old_frame_is_no_jump() -> None:
    """A frame delayed by a minute is late, no reason to restart; so are frames sent before a jump."""
    after = [mark(2, 60), mark(3, 60.1), mark(4, 60.2)]
    assert verdicts([mark(0, 0), *after, mark(1, 0.1), mark(5, 60.3)])[3:] == [
        Verdict.RESTART,
        Verdict.LATE,
        Verdict.NEXT,
    ]
    arrived = [mark(seq, seq * 2) for seq in range(20) if seq != 1]
    assert verdicts([*arrived, mark(1, 2)])[-1] is Verdict.LATE
