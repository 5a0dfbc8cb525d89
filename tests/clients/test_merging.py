"""Messages that come at least once, in any order of their revisions: what the user has in the end."""

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st
from optipmb_client import merging
from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.merging import FinalEvents, FinalEventsOfStreams, Merging, Novelty
from optipmb_schemas import Delivery, Events, Tracks, ZoneEvent
from tracks_message import tracks_message

LABELS = ("car",)


def message(seq: int, *, content: int, revision: int = 0, run: int = 0, session: str = "0" * 32) -> Tracks:
    """Tracks of a frame, with one track whose id is the content."""
    delivery = Delivery(
        instance="test", received_ns=revision, published_ns=run, queue_ms=0, decode_ms=0, step_ms=0, run=run
    )
    return tracks_message("a/b/c", seq, [content], revision=revision, session=session, delivery=delivery)


def test_a_repetition_brings_nothing() -> None:
    """The same tracks again, also in another run and under another revision, and older ones, are repetitions."""
    merged = Merging(10)
    assert merged.take(message(0, content=1)) is Novelty.NEW
    assert merged.take(message(0, content=1)) is Novelty.REPEATED
    assert merged.take(message(0, content=1, revision=2)) is Novelty.REPEATED
    assert merged.take(message(0, content=2, revision=1)) is Novelty.REPEATED
    assert merged.take(message(0, content=1, run=1)) is Novelty.REPEATED


def test_what_is_later_holds() -> None:
    """A higher revision replaces, and a later run at any revision."""
    merged = Merging(10)
    merged.take(message(0, content=1, revision=3))
    assert merged.take(message(0, content=2, revision=4)) is Novelty.CORRECTION
    assert merged.take(message(0, content=3, run=1)) is Novelty.CORRECTION
    assert merged.take(message(0, content=4, revision=9)) is Novelty.REPEATED


def test_a_session_begun_anew_is_heard() -> None:
    """A service without checkpoints counts from nothing; what the session before it sent does not come back."""
    merged = Merging(10)
    merged.take(message(0, content=1, revision=3))
    assert merged.take(message(0, content=2, session="1" * 32)) is Novelty.CORRECTION
    assert merged.take(message(0, content=1, revision=2)) is Novelty.REPEATED


def test_memory_is_bounded() -> None:
    """The oldest frames are forgotten."""
    merged = Merging(4)
    for seq in range(10):
        merged.take(message(seq, content=seq))
    assert merged.take(message(9, content=9)) is Novelty.REPEATED
    assert merged.take(message(0, content=0)) is Novelty.NEW


@dataclass(frozen=True)
class Sent:
    """A message by its numbers; its content follows from them."""

    seq: int
    run: int
    revision: int

    @property
    def tracks(self) -> Tracks:
        return message(self.seq, content=10 * self.run + self.revision, revision=self.revision, run=self.run)


sent = st.builds(Sent, st.integers(0, 3), st.integers(0, 2), st.integers(0, 3))


@given(st.lists(sent, max_size=40))
def test_the_end_does_not_depend_on_the_way(messages: list[Sent]) -> None:
    """In any order and number of messages, the latest of each frame is given out last."""
    merged, last = Merging(100), {}
    for one in messages:
        if merged.take(one.tracks) is not Novelty.REPEATED:
            last[one.seq] = one
    assert last == {
        seq: max((one for one in messages if one.seq == seq), key=lambda one: (one.run, one.revision))
        for seq in {one.seq for one in messages}
    }


A, B = "a" * 32, "b" * 32


def events(seq: int, n: int, *, run: int = 1, revision: int = 0, session: str = A, final: tuple[str, int]) -> Events:
    """The event `n` of a frame, and up to where events are final."""
    delivery = Delivery(
        instance="test",
        received_ns=0,
        published_ns=0,
        queue_ms=0,
        decode_ms=0,
        step_ms=0,
        run=run,
        final_session=final[0],
        final_ns=final[1],
    )
    where = {"label": 0, "at_ns": seq, "position": (0.0, 0.0, 0.0), "speed": 0.0, "yaw": 0.0, "direction": "left"}
    event = ZoneEvent(zone="gate", kind="crossed", n=n, id=1, **where)
    place = {"stream": "a/b/c", "epoch": bytes(16), "seq": seq, "stamp_ns": seq, "session": session}
    return Events(**place, revision=revision, labels=LABELS, events=(event,) if n else (), delivery=delivery)


@pytest.mark.parametrize(
    ("messages", "released"),
    [
        ([events(1, 1, final=(A, 0)), events(3, 2, final=(A, 3)), events(9, 3, final=(A, 9))], [1, 2]),
        # A correction, one without events, and repetitions, before and after the frame is final.
        (
            [
                events(1, 1, final=(A, 0)),
                events(2, 7, final=(A, 0)),
                events(3, 8, final=(A, 0)),
                events(2, 2, revision=1, final=(A, 0)),
                events(3, 0, revision=1, final=(A, 0)),
                events(2, 7, final=(A, 0)),
                events(5, 3, final=(A, 5)),
                events(1, 1, final=(A, 0)),
                events(9, 4, final=(A, 9)),
            ],
            [1, 2, 3],
        ),
        # A later run goes on behind frame 2: later frames of the earlier one are void at any position.
        (
            [
                events(2, 1, final=(A, 2)),
                events(4, 7, final=(A, 2)),
                events(5, 2, run=2, final=(A, 2)),
                events(6, 8, final=(A, 9)),
                events(9, 3, run=2, final=(A, 9)),
            ],
            [1, 2],
        ),
        # All of earlier sessions is final, also if a session is received late.
        (
            [events(5, 1, final=(A, 0)), events(2, 2, session=B, final=(B, 0)), events(4, 3, session=B, final=(B, 3))],
            [1, 2],
        ),
        (
            [
                events(5, 1, session=B, run=2, final=(B, 0)),
                events(8, 7, final=(A, 0)),
                events(6, 2, session=B, run=2, final=(B, 6)),
            ],
            [1],
        ),
        # A service without checkpoints counts runs and events from the beginning.
        (
            [
                events(5, 1, run=2, final=(A, 0)),
                events(9, 1, session=B, final=(B, 0)),
                events(12, 2, session=B, final=(B, 12)),
            ],
            [1, 1],
        ),
    ],
)
def test_events_come_once_when_they_are_final(messages: list[Events], released: list[int]) -> None:
    """In the order of the frames, as the last run and revision says."""
    merged = FinalEvents()
    assert [event.n for one in messages for final in merged.take(one) for event in final.events] == released


def test_events_of_streams_that_are_silent_the_longest_are_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers of all streams hold events of a bounded number of streams: names are arbitrary."""
    monkeypatch.setattr(merging, "MOST_STREAMS", 2)
    streams = FinalEventsOfStreams()
    for name in ("a/b/ended", "a/b/one", "a/b/other"):
        assert streams.take(events(1, 1, final=(A, 0)).model_copy(update={"stream": name})) == []
    settled = events(2, 2, final=(A, 2))
    assert streams.take(settled.model_copy(update={"stream": "a/b/ended"})) == []
    (released,) = streams.take(settled.model_copy(update={"stream": "a/b/other"}))
    assert released.stream == "a/b/other"


def test_keys_of_dropped_messages_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A full inbox marks the next message of a key after a loss, for the keys that lost last."""
    monkeypatch.setattr(merging, "MOST_STREAMS", 1)
    inbox = Inbox(1)
    found = []
    for keys in ("abc", "a", "b"):
        for key in keys:
            inbox.put(Arrival(key, b"", "", 0))
        found.append(inbox.get())
    assert [(one.key, one.after_loss) for one in found if one] == [("c", False), ("a", False), ("b", True)]
