"""Values and protocols between streams and the network; `transport` implements them over Zenoh."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Protocol

from optipmb_client.errors import ConnectionFailed

if TYPE_CHECKING:
    import optipmb_schemas as schemas


PACKET_BYTES: Final = 512
"""Bytes of a message beside its payload, nearly."""


@dataclass(slots=True)
class Packet:
    """A message as it arrived, not decoded.

    Attributes:
        key: where it was published.
        payload: its bytes; None when they are more than the limit and were not taken over.
        size: number of bytes.
        encoding: the Zenoh encoding, as a text.
        wall_ns: arrival by the wall clock, ns since 1970; only reported, never decided by.
        now_ns: arrival by the monotonic clock, ns.
        origin: what tells the stream: the key without its topic.
        frame: whether it holds detections.
        held: bytes that it takes while it waits.
    """

    key: str
    payload: bytes | None
    size: int
    encoding: str
    wall_ns: int
    now_ns: int
    origin: str = field(init=False)
    frame: bool = field(init=False)
    held: int = field(init=False)

    def __post_init__(self) -> None:
        self.origin, _, topic = self.key.rpartition("/")
        self.frame = topic == "detections"
        self.held = PACKET_BYTES + (0 if self.payload is None else self.size)


class Publisher(Protocol):
    """The publisher of a stream's tracks."""

    def publish(self, payload: bytes) -> None:
        """Send encoded tracks; never waits for a receiver."""

    def release(self) -> None:
        """Withdraw the publisher."""


class Request(Protocol):
    """A query that waits for its replies; every request must be finished, on any thread."""

    @property
    def key(self) -> str:
        """The key, or key expression, that was asked."""

    @property
    def payload(self) -> bytes | None:
        """The payload of the query."""

    @property
    def encoding(self) -> str:
        """The encoding of the payload."""

    def matches(self, key: str) -> bool:
        """Return whether the key expression that was asked includes a key."""

    def answer(self, key: str, message: schemas.Message) -> None:
        """Reply."""

    def answer_text(self, key: str, text: bytes, encoding: str, *, about: str = "") -> None:
        """Reply with bytes as they are, and with the key that they are about."""

    def refuse(self, problem: schemas.Problem) -> None:
        """Reply with an error."""

    def finish(self) -> None:
        """End the replies."""


TransportError = ConnectionFailed
"""The network cannot be used; the text is one clear line."""


class EdgeError(Exception):
    """An edge beside Zenoh cannot be opened; the text is one clear line."""


class HttpError(EdgeError):
    """The address of the HTTP endpoint cannot be listened on; the text is one clear line."""
