"""Messages that come at least once, in any order of their revisions: what the user has in the end."""

from __future__ import annotations

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st
from optipmb_client.merging import Merging, Novelty
from optipmb_schemas import Delivery, Tracks
from tracks_message import tracks_message


def message(seq: int, *, content: int, revision: int = 0, run: int = 0, session: str = "0" * 32) -> Tracks:
    """Tracks of a frame, with one track whose id is the content."""
    delivery = Delivery(
        instance="test", received_ns=revision, published_ns=run, queue_ms=0, decode_ms=0, step_ms=0, run=run
    )
    return tracks_message("a/b/c", seq, [content], revision=revision, session=session, delivery=delivery)


def test_a_repetition_brings_nothing() -> None:
    """The same tracks again, also in another run and under another revision, and older ones, are repetitions."""
    merging = Merging(10)
    assert merging.take(message(0, content=1)) is Novelty.NEW
    assert merging.take(message(0, content=1)) is Novelty.REPEATED
    assert merging.take(message(0, content=1, revision=2)) is Novelty.REPEATED
    assert merging.take(message(0, content=2, revision=1)) is Novelty.REPEATED
    assert merging.take(message(0, content=1, run=1)) is Novelty.REPEATED


def test_what_is_later_holds() -> None:
    """A higher revision corrects, and a later run whatever its revision."""
    merging = Merging(10)
    merging.take(message(0, content=1, revision=3))
    assert merging.take(message(0, content=2, revision=4)) is Novelty.CORRECTION
    assert merging.take(message(0, content=3, run=1)) is Novelty.CORRECTION
    assert merging.take(message(0, content=4, revision=9)) is Novelty.REPEATED


def test_a_session_begun_anew_is_heard() -> None:
    """A service without checkpoints counts from nothing; what the session before it sent does not come back."""
    merging = Merging(10)
    merging.take(message(0, content=1, revision=3))
    assert merging.take(message(0, content=2, session="1" * 32)) is Novelty.CORRECTION
    assert merging.take(message(0, content=1, revision=2)) is Novelty.REPEATED


def test_memory_is_bounded() -> None:
    """The oldest frames are forgotten."""
    merging = Merging(4)
    for seq in range(10):
        merging.take(message(seq, content=seq))
    assert merging.take(message(9, content=9)) is Novelty.REPEATED
    assert merging.take(message(0, content=0)) is Novelty.NEW


@dataclass(frozen=True)
class Sent:
    """A message by its numbers; its content follows from them."""

    seq: int
    run: int
    revision: int

    @property
    def tracks(self) -> Tracks:
        """The message."""
        return message(self.seq, content=10 * self.run + self.revision, revision=self.revision, run=self.run)


sent = st.builds(Sent, st.integers(0, 3), st.integers(0, 2), st.integers(0, 3))


@given(st.lists(sent, max_size=40))
def test_the_end_does_not_depend_on_the_way(messages: list[Sent]) -> None:
    """In whatever order and however often they come, the latest of each frame is what was given out last."""
    merging, last = Merging(100), {}
    for one in messages:
        if merging.take(one.tracks) is not Novelty.REPEATED:
            last[one.seq] = one
    assert last == {
        seq: max((one for one in messages if one.seq == seq), key=lambda one: (one.run, one.revision))
        for seq in {one.seq for one in messages}
    }
