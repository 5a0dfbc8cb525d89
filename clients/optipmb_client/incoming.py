"""Messages and answers that arrive over Zenoh or gRPC, and the queue from which a program reads them.

Payloads are bytes, keys are text, times are `time.monotonic_ns()`.
"""

import collections
import threading
from dataclasses import dataclass, field, replace
from typing import TypeVar

from optipmb_schemas import Message, decode

from optipmb_client.errors import ClientError
from optipmb_client.merging import remember

__all__ = ["Answer", "Arrival", "Inbox"]

_Message = TypeVar("_Message", bound=Message)


@dataclass(frozen=True)
class Arrival:
    """A message as it came in: key, payload, Zenoh encoding, and the monotonic time of its arrival in nanoseconds.

    `after_loss` says whether messages of this key before it are lost. `traceparent` is the trace context that came
    along, unchecked.
    """

    key: str
    payload: bytes
    encoding: str
    monotonic_ns: int
    after_loss: bool = field(default=False, kw_only=True)
    traceparent: str = field(default="", kw_only=True)

    def read(self, kind: type[_Message]) -> _Message:
        """Return the message, checked.

        Raises:
            MessageError: it is not valid.
        """
        return decode(self.payload, kind, encoding=self.encoding)


@dataclass(frozen=True)
class Answer:
    """A reply to a query; `ok` is False for an error reply, whose payload then says why.

    `about` is a key that the answer is about, where it says one.
    """

    key: str
    payload: bytes
    encoding: str
    ok: bool
    about: str = ""


class Inbox:
    """A bounded queue from the draining thread to one reader; when it is full the oldest entry goes, and is counted."""

    def __init__(self, capacity: int) -> None:
        self._entries: collections.deque[Arrival] = collections.deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closed = False
        self._error: ClientError | None = None
        self._dropped_keys: collections.OrderedDict[str, None] = collections.OrderedDict()
        self._since_loss: collections.OrderedDict[str, None] | None = None
        """Keys with an entry since messages of unknown keys were lost; None: none were."""
        self.dropped = 0

    @property
    def pending(self) -> int:
        """Entries waiting to be read."""
        return len(self._entries)

    def put(self, arrival: Arrival) -> None:
        """Append an entry; never waits. After `close` it does nothing."""
        with self._changed:
            if self._closed:
                return
            if self._since_loss is not None and arrival.key not in self._since_loss:
                remember(self._since_loss, arrival.key, None)
                arrival = replace(arrival, after_loss=True)
            if len(self._entries) >= self._capacity:
                remember(self._dropped_keys, self._entries.popleft().key, None)
                self.dropped += 1
            self._entries.append(arrival)
            self._changed.notify()

    def lose(self, count: int = 0) -> None:
        """Note that messages are lost before the next entry, of any keys; `count`: how many are known to be."""
        with self._changed:
            self.dropped += count
            self._since_loss = collections.OrderedDict()

    def get(self, timeout: float | None = None) -> Arrival | None:
        """Take the oldest entry, waiting up to `timeout` seconds (None: for ever); None when there is none.

        Raises:
            ClientError: with which it was closed; once, after the last entry.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._entries or self._closed, timeout)
            if not self._entries:
                error, self._error = self._error, None
                if error is not None:
                    raise error
                return None
            arrival = self._entries.popleft()
            if arrival.key in self._dropped_keys:
                del self._dropped_keys[arrival.key]
                arrival = replace(arrival, after_loss=True)
            return arrival

    @property
    def closed(self) -> bool:
        """Whether no further entries will come; waiting ones can still be read."""
        return self._closed

    def close(self, error: ClientError | None = None) -> None:
        """Wake the reader for good, to whom the error is raised that has ended it."""
        with self._changed:
            if not self._closed:
                self._error = error
            self._closed = True
            self._changed.notify_all()
