"""Subscriptions of viewers: shared by the viewers of a stream, kept for a while, and bounded in rate.

Each subscription takes a number for its key that Zenoh never gives back. A browser that connects again and again takes
none while its subscriptions are kept, and a viewer of ever new streams soon has to wait.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

from optipmb_client.errors import ConnectionFailed as TransportError

from optipmb_service.zenoh.client import IdlePool, Turns

if TYPE_CHECKING:
    from optipmb_client.zenoh.handles import Reading
    from optipmb_client.zenoh.session import Sample, Session

Receive = Callable[[str, bytes, str], None]
"""Takes topic, payload and encoding."""

KEPT: Final = 16
"""Streams without viewers whose subscriptions are kept."""

BURST: Final = 100
"""Streams that are subscribed to at once."""

PERIOD_S: Final = 15.0
"""Time after which a further one is, in the long run: 5,760 a day, with two numbers each."""


class Taps:
    """The subscriptions of the viewers of a process; may be used by any threads."""

    def __init__(self, session: Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._lock = threading.Lock()
        self._taps: dict[tuple[str, str], _Tap] = {}
        self._idle: IdlePool[_Tap] = IdlePool(KEPT)
        self._turns = Turns(BURST, PERIOD_S)

    def join(self, names: tuple[str, str], receive: Receive) -> Callable[[], None]:
        """Hand over the newest tracks and detections of streams, until the result is called, which may be twice.

        The names are key expressions of the streams of the tracks and of the detections.

        Raises:
            TransportError: the session is closed, or too many streams were subscribed to.
        """
        with self._lock:
            tap = self._taps.get(names) or self._idle.take(names)
            if tap is None:
                self._turns.take()
                tap = _Tap(self._session, self._prefix, *names)
            self._taps[names] = tap
            listener = object()
            tap.listeners = tap.listeners | {listener: receive}
        return partial(self._leave, names, tap, listener)

    def _leave(self, names: tuple[str, str], tap: _Tap, listener: object) -> None:
        with self._lock:
            if listener in tap.listeners:
                tap.listeners = {one: receive for one, receive in tap.listeners.items() if one is not listener}
                if not tap.listeners:
                    self._idle.keep(names, self._taps.pop(names))


class _Tap:
    """The subscriptions to one stream, each with a thread of its own."""

    def __init__(self, session: Session, prefix: str, tracks: str, detections: str) -> None:
        self.listeners: dict[object, Receive] = {}
        self._readings: list[Reading] = []
        try:
            for topic, names in (("tracks", tracks), ("detections", detections)):
                hand_over = partial(self._hand_over, topic)
                self._readings.append(session.read_newest(f"{prefix}/{names}/{topic}", hand_over))
        except TransportError:
            self.close()
            raise

    def close(self) -> None:
        for one in self._readings:
            one.close(0.0)

    def _hand_over(self, topic: str, sample: Sample) -> None:
        if receivers := tuple(self.listeners.values()):
            payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
            for receive in receivers:
                receive(topic, payload, encoding)
