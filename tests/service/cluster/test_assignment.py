"""Which worker tracks which stream."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from optipmb_service.cluster.assignment import Assignment, worker_of

NAMES = st.from_regex(r"[A-Za-z0-9_.-]{1,20}/[A-Za-z0-9_.-]{1,20}/[A-Za-z0-9_.-]{1,20}", fullmatch=True)
COUNTS = st.integers(1, 16)


@given(NAMES, COUNTS)
def test_every_stream_has_one_worker(stream: str, count: int) -> None:
    """Of so many workers exactly one has a stream, and it is the one that the hash names."""
    assert [index for index in range(count) if Assignment(index, count).has(stream)] == [worker_of(stream, count)]


@given(NAMES, COUNTS)
def test_one_worker_more_takes_only_what_it_gets(stream: str, count: int) -> None:
    """With one worker more a stream stays where it was or goes to the new one."""
    assert worker_of(stream, count + 1) in {worker_of(stream, count), count}


def test_streams_are_spread() -> None:
    """Of 4,000 streams each of four workers has a quarter, give or take a tenth of it."""
    counts = [0] * 4
    for number in range(4000):
        counts[worker_of(f"site/node-{number}/lidar", 4)] += 1
    assert all(abs(count - 1000) < 100 for count in counts), counts


def test_the_hash_does_not_change() -> None:
    """The shares of a running installation stay what they were with the next version."""
    assert [worker_of(f"site/node/{name}", 3) for name in "abcdefgh"] == [1, 2, 0, 1, 0, 2, 1, 2]


@given(NAMES, st.integers(2, 8), st.data())
def test_a_moved_stream_has_one_worker(stream: str, count: int, data: st.DataObject) -> None:
    """After a move, told to workers that know the stream already, the new worker has it and no other."""
    shares = [Assignment(index, count) for index in range(count)]
    assert sum(share.has(stream) for share in shares) == 1
    target = data.draw(st.integers(0, count - 1))
    for share in shares:
        share.move(stream, target)
    assert [share.index for share in shares if share.has(stream)] == [target]
    again = [Assignment(index, count, {stream: target}) for index in range(count)]
    assert [share.index for share in again if share.has(stream)] == [target]
