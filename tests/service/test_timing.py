"""What becomes of frames in time: order, duplicates, late ones, gaps, jumps, restarted publishers, waiting."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.timing import WINDOW, Decision, Mark, Timeline, Verdict, hold_until

SECOND = 1_000_000_000
LIMIT = 5 * SECOND
A, B, C = (bytes([letter]) * 16 for letter in b"abc")


def mark(seq: int, seconds: float, epoch: bytes = A) -> Mark:
    """A frame by number and seconds."""
    return Mark(epoch, seq, round(seconds * SECOND))


def judge_all(marks: list[Mark]) -> tuple[list[Decision], list[int], Timeline]:
    """Judge frames and process each admitted one at once; returns decisions, gaps of the admitted ones, timeline."""
    timeline, decisions, gaps = Timeline(LIMIT), [], []
    for one in marks:
        decision, timeline = timeline.judge(one)
        decisions.append(decision)
        if decision.verdict.admitted:
            gap, timeline = timeline.release(one, decision.era)
            gaps.append(gap)
    return decisions, gaps, timeline


def verdicts(marks: list[Mark]) -> list[Verdict]:
    """The verdicts on frames."""
    return [decision.verdict for decision in judge_all(marks)[0]]


marks = st.builds(
    mark,
    st.integers(0, 40) | st.integers(0, 2**62),
    st.integers(0, 60).map(lambda tenths: tenths / 4) | st.integers(0, 4000),
    st.sampled_from([A, B, C]),
)


@settings(deadline=None)
@given(st.lists(marks, max_size=60))
def test_no_frame_is_admitted_twice(arrived: list[Mark]) -> None:
    """Whatever arrives in whatever order, an (epoch, seq) is admitted at most once."""
    decisions, _, _ = judge_all(arrived)
    admitted = [(m.epoch, m.seq) for m, d in zip(arrived, decisions, strict=True) if d.verdict.admitted]
    assert len(admitted) == len(set(admitted))


@settings(deadline=None)
@given(st.lists(marks, max_size=60))
def test_time_never_goes_back_in_a_generation(arrived: list[Mark]) -> None:
    """Within one life of a density stamps never fall, and (stamp, seq) rises within one era."""
    decisions, _, _ = judge_all(arrived)
    stamps: dict[int, int] = {}
    places: dict[int, tuple[int, int]] = {}
    for one, decision in zip(arrived, decisions, strict=True):
        if decision.verdict.admitted:
            assert one.stamp_ns >= stamps.get(decision.generation, 0)
            assert (one.stamp_ns, one.seq) > places.get(decision.era, (-1, -1))
            stamps[decision.generation] = one.stamp_ns
            places[decision.era] = (one.stamp_ns, one.seq)


@settings(deadline=None)
@given(st.lists(marks, max_size=60))
def test_memory_is_bounded(arrived: list[Mark]) -> None:
    """Sequence numbers may leap by 2^62 without the memory of them growing beyond its window."""
    _, _, timeline = judge_all(arrived)
    assert timeline.seen.bit_length() <= WINDOW


@settings(deadline=None)
@given(st.sets(st.integers(0, 300), min_size=1), st.data())
def test_repeats_change_nothing(seqs: set[int], data: st.DataObject) -> None:
    """Frames sent again, as recovery does, leave the verdicts on the others as they were."""
    stream = [mark(seq, seq / 10) for seq in sorted(seqs)]
    repeated = []
    for index, one in enumerate(stream):
        repeated += [one, *data.draw(st.lists(st.sampled_from(stream[: index + 1]), max_size=3))]
    decisions, gaps, _ = judge_all(repeated)
    kept = [d for d in decisions if d.verdict is not Verdict.DUPLICATE]
    assert (kept, gaps) == judge_all(stream)[:2]


@settings(deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=300))
def test_gaps_add_up(lost: list[bool]) -> None:
    """Of a stream that loses frames, those admitted and the gaps before them make the whole again."""
    stream = [mark(seq, seq / 100) for seq, gone in enumerate(lost) if not gone]
    _, gaps, _ = judge_all(stream)
    assert sum(gaps) + len(stream) == (stream[-1].seq - stream[0].seq + 1 if stream else 0)


@settings(deadline=None)
@given(st.permutations(range(12)))
def test_frames_held_together_come_out_in_order(order: list[int]) -> None:
    """Frames that overtook each other before any was processed are all admitted and put in order without gaps."""
    timeline, held = Timeline(LIMIT), []
    for seq in order:
        one = mark(seq, seq / 10)
        decision, timeline = timeline.judge(one)
        held.append((decision.era, one.stamp_ns, one.seq, one))
    gaps = []
    for era, _, _, one in sorted(held):
        gap, timeline = timeline.release(one, era)
        gaps.append(gap)
    assert [place[2] for place in sorted(held)] == list(range(12))
    assert gaps == [0] * 12


def test_equal_stamps_are_ordered_by_sequence() -> None:
    """Of two frames of one stamp the one with the lower number goes first; after the other it is late."""
    assert verdicts([mark(5, 1), mark(6, 1)]) == [Verdict.FIRST, Verdict.NEXT]
    assert verdicts([mark(4, 0.9), mark(6, 1), mark(5, 1)]) == [Verdict.FIRST, Verdict.NEXT, Verdict.LATE]


def test_a_frame_behind_a_processed_one_is_late() -> None:
    """A frame that was overtaken is refused, once and again, and does not disturb the stream."""
    arrived = [mark(0, 0), mark(2, 0.2), mark(1, 0.1), mark(1, 0.1), mark(3, 0.3)]
    assert verdicts(arrived) == [Verdict.FIRST, Verdict.NEXT, Verdict.LATE, Verdict.LATE, Verdict.NEXT]


def test_a_jump_restarts_the_session() -> None:
    """A clock set by an hour, ahead or back, begins a new generation; small steps back are late frames."""
    for to in (3600, -3600):
        decisions, _, _ = judge_all([mark(0, 7200), mark(1, 7200.1), mark(2, 7200.2 + to), mark(3, 7200.3 + to)])
        assert [d.verdict for d in decisions] == [Verdict.FIRST, Verdict.NEXT, Verdict.RESTART, Verdict.NEXT]
        assert [d.generation for d in decisions] == [0, 0, 1, 1]
    assert verdicts([mark(0, 10), mark(1, 10.1), mark(2, 9), mark(3, 10.2)])[2:] == [Verdict.LATE, Verdict.NEXT]


def test_the_gap_limit_itself_is_no_jump() -> None:
    """A step of exactly the limit continues, one nanosecond more restarts."""
    assert verdicts([mark(0, 0), mark(1, 5)])[1] is Verdict.NEXT
    assert verdicts([mark(0, 0), Mark(A, 1, LIMIT + 1)])[1] is Verdict.RESTART


def test_an_old_frame_is_no_jump() -> None:
    """A frame held up for a minute somewhere is late, not a reason to begin anew; so is what was sent before a jump."""
    assert verdicts([mark(0, 0), mark(2, 60), mark(1, 0.1), mark(3, 60.1)])[1:] == [
        Verdict.RESTART,
        Verdict.LATE,
        Verdict.NEXT,
    ]
    arrived = [mark(seq, seq * 2) for seq in range(20) if seq != 1]
    assert verdicts([*arrived, mark(1, 2)])[-1] is Verdict.LATE


def test_what_was_sent_before_a_jump_does_not_come_after_it() -> None:
    """A straggler from before a jump is late even while nothing of the new era is processed."""
    timeline, found = Timeline(LIMIT), []
    for one in (mark(0, 0), mark(5, 6), mark(4, 1.5)):
        decision, timeline = timeline.judge(one)
        found.append(decision.verdict)
    assert found == [Verdict.FIRST, Verdict.RESTART, Verdict.LATE]


def test_a_restarted_publisher_continues_the_density() -> None:
    """A new epoch whose stamps go on keeps the generation and begins its numbers anew."""
    decisions, gaps, _ = judge_all([mark(0, 0), mark(7, 0.7), mark(0, 2, B), mark(1, 2.1, B)])
    assert [d.verdict for d in decisions][2:] == [Verdict.NEW_EPOCH, Verdict.NEXT]
    assert {d.generation for d in decisions} == {0}
    assert gaps == [0, 6, 0, 0]


def test_a_replay_restarts_the_session() -> None:
    """A new epoch whose stamps go back or far ahead begins a new generation."""
    for seconds in (0, 1, 100):
        decisions, _, _ = judge_all([mark(0, 0), mark(1, 1), mark(0, seconds, B)])
        assert decisions[-1].verdict is Verdict.RESTART
        assert decisions[-1].generation == 1


def test_a_succeeded_publisher_does_not_come_back() -> None:
    """Two publishers of one stream do not take turns in restarting it: the older one is refused."""
    assert verdicts([mark(0, 0), mark(0, 0.1, B), mark(1, 0.2), mark(1, 0.3, B)])[2:] == [
        Verdict.RETIRED,
        Verdict.NEXT,
    ]


def test_a_continuing_epoch_does_not_reach_back() -> None:
    """After a publisher's restart, frames stamped before its predecessor's last are late, released or not."""
    timeline = Timeline(LIMIT)
    for one in (mark(0, 0), mark(1, 1)):
        _, timeline = timeline.judge(one)
    first, timeline = timeline.judge(mark(1, 1.5, B))
    second, timeline = timeline.judge(mark(0, 0.9, B))
    assert (first.verdict, second.verdict) == (Verdict.NEW_EPOCH, Verdict.LATE)


@settings(deadline=None)
@given(
    has_points=st.sampled_from([True, False, None]),
    newest=st.none() | st.integers(0, 10 * SECOND),
    stamp=st.integers(0, 10 * SECOND),
    wait=st.integers(0, SECOND),
)
def test_waiting_for_a_cloud(has_points: bool | None, newest: int | None, stamp: int, wait: int) -> None:  # noqa: FBT001 - drawn
    """A frame waits if it says so, or says nothing and a cloud came lately; never longer than allowed."""
    until = hold_until(
        has_points=has_points,
        stamp_ns=stamp,
        arrived_ns=7,
        newest_cloud_ns=newest,
        cloud_wait_ns=wait,
        cloud_memory_ns=2 * SECOND,
    )
    lately = newest is not None and abs(stamp - newest) <= 2 * SECOND
    waits = wait > 0 and (has_points or (has_points is None and lately))
    assert until == (7 + wait if waits else None)
