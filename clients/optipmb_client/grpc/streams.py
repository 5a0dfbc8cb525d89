"""A stream on its way to a gateway, and the tracks of a pattern on their way back: resumed at the next when it goes."""

import collections
import itertools
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from optipmb_schemas import Keys, Message, Topic
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_client.errors import ConnectionFailed
from optipmb_client.grpc.channels import CLOSE_S, Channels, ResumedCall
from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.trace_context import attached

__all__ = ["GrpcSender", "GrpcSubscription", "Publishing"]

T = TypeVar("T", bound=Message)

CLOUDS: Final = 4
"""Clouds that may wait for a gateway in any case."""
WAITING_BYTES: Final = 64 * 2**20
"""Bytes of a topic that may wait for a gateway beyond that: some seconds of a sensor's clouds."""

_Numbered = tuple[int, bytes]


class Publishing(ResumedCall):
    """The detections and clouds of one stream in a `Publish` call, opened again at the next gateway when it fails.

    The newest messages are kept and sent again then, as the old gateway may not have passed them on. Receivers drop
    repetitions.

    Args:
        channels: to gateways.
        stream: its name.
        cache: detections that are kept.
        cache_clouds: clouds that are kept; without any they are sent only while somebody subscribes.
        timeout: seconds to wait until the stream is open.

    Raises:
        ConnectionFailed: it is not open in time.
        ServiceRefused: the gateway does not take it.
    """

    def __init__(self, channels: Channels, stream: str, cache: int, cache_clouds: int, timeout: float) -> None:
        super().__init__(channels, "Publish", f"publish {stream}")
        options = pb.PublishOptions(stream=stream, cache=cache, cache_clouds=cache_clouds)
        self._options = pb.PublishRequest(options=options).SerializeToString()
        self._waiting = {"detections": _Waiting(max(cache, 1)), "points": _Waiting(CLOUDS)}
        self._kept: dict[str, collections.deque[_Numbered]] = {
            "detections": collections.deque(maxlen=max(cache, 1)),
            "points": collections.deque(maxlen=cache_clouds),
        }
        self._keeps_clouds = cache_clouds > 0
        self._number = itertools.count()
        self._calls = 0
        self._changed = threading.Condition()
        self._senders = 2
        self.points_wanted = self._keeps_clouds
        self._open(f"stream {stream}", timeout)

    def put(self, topic: str, payload: bytes) -> None:
        """Send a message without waiting.

        Raises:
            ConnectionFailed: after the end.
            ServiceRefused: the gateway does not take the stream any more.
        """
        with self._changed:
            if self.error is not None:
                raise self.error
            if self._is_last:
                raise ConnectionFailed("this publisher has been closed")
            self._waiting[topic].append((next(self._number), payload))
            self._changed.notify_all()

    def release(self) -> None:
        """Send what waits, and end, when all senders are closed."""
        with self._changed:
            self._senders -= 1
            if self._senders > 0:
                return
            self._is_last = True
            self._changed.notify_all()
        self._thread.join(CLOSE_S)
        self._end()

    def _take(self, response: bytes) -> None:
        said = pb.PublishResponse.FromString(response)
        if said.WhichOneof("response") == "acknowledgement":
            self.points_wanted = self._keeps_clouds or said.acknowledgement.points_wanted
            self._settle()

    def _began(self) -> None:
        """Wait for the first acknowledgement."""

    def _ended(self) -> None:
        with self._changed:  # for the thread that waits for requests
            self._calls += 1
            self._changed.notify_all()

    def _requests(self) -> Iterator[bytes]:
        """Yield the options, kept messages and new ones, until the next call; run by a thread of gRPC."""
        with self._changed:
            self._calls += 1
            call = self._calls
            self._changed.notify_all()
            for topic, kept in self._kept.items():
                self._waiting[topic].prepend(kept)
                kept.clear()
        yield self._options
        while (payload := self._next(call)) is not None:
            yield payload

    def _next(self, call: int) -> bytes | None:
        """Return the oldest message that waits, detections and clouds in their order; None when the call is over."""
        with self._changed:
            self._changed.wait_for(lambda: any(self._waiting.values()) or self._is_last or self._calls != call)
            waiting = [topic for topic, queue in self._waiting.items() if queue]
            if self._calls != call or not waiting:
                return None
            topic = min(waiting, key=lambda one: self._waiting[one].number)
            message = self._waiting[topic].popleft()
            self._kept[topic].append(message)
            return message[1]


class _Waiting:
    """Messages that no call was given yet: so many, or so many bytes, of the newest."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._messages: collections.deque[_Numbered] = collections.deque()
        self._bytes = 0

    def __bool__(self) -> bool:
        return bool(self._messages)

    @property
    def number(self) -> int:
        return self._messages[0][0]

    def append(self, message: _Numbered) -> None:
        """Add the newest; the oldest go when there are too many."""
        self._messages.append(message)
        self._bytes += len(message[1])
        while len(self._messages) > self._most and self._bytes > WAITING_BYTES:
            self.popleft()

    def prepend(self, messages: Sequence[_Numbered]) -> None:
        """Add the messages of a call that failed."""
        self._messages.extendleft(reversed(messages))
        self._bytes += sum(len(payload) for _, payload in messages)

    def popleft(self) -> _Numbered:
        """Take the oldest."""
        message = self._messages.popleft()
        self._bytes -= len(message[1])
        return message


class GrpcSender:
    """Sends the messages of one topic of a stream."""

    def __init__(self, publishing: Publishing, topic: str) -> None:
        self._publishing = publishing
        self._topic = topic
        self._closed = False

    @property
    def wanted(self) -> bool:
        """Whether anybody takes the messages."""
        return self._topic == "detections" or self._publishing.points_wanted

    def pack(self, message: Message) -> bytes:
        """Return a message as it is sent."""
        request = pb.PublishRequest(**{self._topic: convert.to_proto(message)})
        return request.SerializeToString()

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Send a packed message, with the trace context of an attachment."""
        if attachment is not None:  # protobuf merges messages that stand one after the other
            payload += pb.PublishRequest(traceparent=attached(attachment)).SerializeToString()
        self._publishing.put(self._topic, payload)

    def close(self) -> None:
        """Withdraw; earlier messages still go out."""
        if not self._closed:
            self._closed = True
            self._publishing.release()


QUEUE: Final = 1024
"""Messages of a stream that may wait in the gateway: the most that it allows."""


@dataclass(frozen=True)
class _ProtoArrival(Arrival):
    """A message that came in protobuf."""

    proto: Any = field(kw_only=True)

    def read(self, kind: type[T]) -> T:
        """Return the message, checked.

        Raises:
            MessageError: it is not valid.
        """
        return convert.from_proto(self.proto, kind)


class GrpcSubscription(ResumedCall):
    """A `Subscribe` or `SubscribeEvents` call, made again when it ends; kept messages come first each time.

    Args:
        channels: to gateways.
        pattern: of streams.
        inbox: for the messages.
        keys: of the network, for the names of arrivals.
        topics: tracks or tracks predicted to now, perhaps with problems, or events.
        history: whether kept messages come at the first call, too.
        timeout: seconds to wait until it is in force.

    Raises:
        ConnectionFailed: it is not in force in time.
        ServiceRefused: the gateway does not allow it.
    """

    def __init__(
        self,
        channels: Channels,
        pattern: str,
        inbox: Inbox,
        keys: Keys,
        *,
        topics: Sequence[Topic],
        history: bool,
        timeout: float,
    ) -> None:
        self._events = "events" in topics
        super().__init__(channels, "SubscribeEvents" if self._events else "Subscribe", f"subscribe {pattern}")
        request: Any = pb.SubscribeRequest(
            pattern=pattern, queue=QUEUE, problems="problems" in topics, predict="now" in topics
        )
        if self._events:
            request = pb.SubscribeEventsRequest(pattern=pattern, final=False)
        self._request = request
        self._request.history = history
        self._inbox = inbox
        self._keys = keys
        self._open("subscription", timeout)

    def close(self) -> None:
        """End it; the inbox stays readable."""
        self._end()

    def _requests(self) -> Iterator[bytes]:
        return iter((self._request.SerializeToString(),))

    def _began(self) -> None:
        self._call.initial_metadata()  # it is in force
        if self._settled.is_set():
            self._inbox.lose()  # messages since the call before that are kept no longer
        if self._call.is_active():
            self._settle()

    def _settle(self) -> None:
        super()._settle()
        self._request.history = True  # the next call recovers the losses in between

    def _ended(self) -> None:
        if not self._over.is_set():  # nothing will come any more; who reads learns why, unless it closed the connection
            self._inbox.close(None if isinstance(self.error, ConnectionFailed) else self.error)

    def _take(self, response: bytes) -> None:
        if not self._in_force:  # the call has ended since
            self._settle()
        said = (pb.SubscribeEventsResponse if self._events else pb.SubscribeResponse).FromString(response)
        if said.skipped:
            self._inbox.lose(said.skipped)
        kinds = {one.name for one, _ in said.ListFields()} - {"skipped"}
        for name in kinds:  # none, where this release does not know it
            proto = getattr(said, name)
            key = getattr(self._keys, "problems" if name == "problem" else name)(proto.stream)
            self._inbox.put(_ProtoArrival(key, b"", "application/protobuf", time.monotonic_ns(), proto=proto))
