"""Statistics of a subscriber: each message is counted, whatever becomes of it."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_client import Subscriber
from optipmb_client.incoming import Arrival, Inbox
from optipmb_schemas import Keys, encode, encoding_of
from tracks_message import tracks_message

STREAM = "garage/robot-1/lidar"
FIRST = tracks_message(STREAM, 1)


class Link:
    """A connection on which a test delivers."""

    def subscribe_streams(self, _pattern: str, inbox: Inbox, *_topics: str, **_: object) -> Any:
        self.inbox = inbox
        return SimpleNamespace(close=lambda: None)

    def deliver(self, payload: bytes) -> None:
        self.inbox.put(Arrival(Keys().tracks(STREAM), payload, encoding_of(FIRST), 0))


@pytest.mark.parametrize("corrections", [True, False])
@pytest.mark.parametrize(
    ("payload", "counts"),
    [
        (encode(tracks_message(STREAM, 2)), {"delivered": 1}),
        (encode(tracks_message(STREAM, 2, predicted_to_ns=5)), {"delivered": 1}),
        (encode(FIRST), {"repeated": 1}),
        (encode(tracks_message(STREAM, 1, revision=1, gap=1)), {"corrected": 1, "delivered": 1}),
        (b"", {"invalid": 1}),
    ],
)
def test_a_message_is_counted_once(payload: bytes, counts: dict[str, int], *, corrections: bool) -> None:
    """Given out, repeated, corrected or invalid: after the first one, a second message adds to these counts alone."""
    link: Any = Link()
    with Subscriber(STREAM, connection=link, corrections=corrections) as subscriber:
        link.deliver(encode(FIRST))
        assert subscriber.receive(0.0)
        before = dataclasses.asdict(subscriber.statistics)
        link.deliver(payload)
        received = subscriber.receive(0.0)
        after = dataclasses.asdict(subscriber.statistics)
    if "corrected" in counts and not corrections:
        counts = {"corrected": 1}
    assert {name: after[name] - before[name] for name in after if after[name] != before[name]} == counts
    assert (received is not None) == ("delivered" in counts)
