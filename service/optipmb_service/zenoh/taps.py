"""Subscriptions of viewers: shared by those of one stream, kept for a while for who comes back, and bounded in rate.

Each subscription takes a number for its key that Zenoh never gives back. A browser that connects again and again takes
none while its subscriptions are kept, and whoever asks for ever new streams soon has to wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

from optipmb_service.stream.ports import TransportError
from optipmb_service.zenoh.client import Turns

if TYPE_CHECKING:
    from optipmb_client.zenoh.handles import Reading
    from optipmb_client.zenoh.session import Sample, Session

Receive = Callable[[str, bytes, str], None]
"""Takes topic, payload and encoding."""

KEPT_S: Final = 60.0
"""How long subscriptions without viewers are kept."""

KEPT: Final = 16
"""Streams of which they are."""

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
        self._timed = False
        self._turns = Turns(BURST, PERIOD_S)

    def join(self, names: tuple[str, str], receive: Receive) -> Callable[[], None]:
        """Hand over the newest tracks and detections of streams, until the result is called, which may be twice.

        The names are key expressions of the streams of the tracks and of the detections.

        Raises:
            TransportError: the session is closed, or too many streams were subscribed to.
        """
        with self._lock:
            tap = self._taps.get(names)
            if tap is None:
                self._turns.take()
                tap = self._taps[names] = _Tap(self._session, self._prefix, *names)
            listener = object()
            tap.listeners = tap.listeners | {listener: receive}
        return partial(self._leave, names, tap, listener)

    def _leave(self, names: tuple[str, str], tap: _Tap, listener: object) -> None:
        with self._lock:
            if listener not in tap.listeners:
                return
            tap.listeners = {one: receive for one, receive in tap.listeners.items() if one is not listener}
            if tap.listeners:
                return
            tap.left_s = time.monotonic()
            self._taps[names] = self._taps.pop(names)  # behind those that were left before
        self._close_left()

    def _on_timer(self) -> None:
        self._timed = False
        self._close_left()

    def _close_left(self) -> None:
        """Withdraw subscriptions that were left for long, or are too many; look again later where others are left."""
        latest = time.monotonic() - KEPT_S
        with self._lock:
            left = [(names, tap) for names, tap in self._taps.items() if not tap.listeners]
            ended = [one for number, one in enumerate(left) if number < len(left) - KEPT or one[1].left_s <= latest]
            for names, _ in ended:
                del self._taps[names]
            starts = not self._timed and len(ended) < len(left)
            self._timed |= starts
        if starts:
            timer = threading.Timer(KEPT_S, self._on_timer)
            timer.daemon = True
            timer.start()
        for _, tap in ended:
            tap.close()


class _Tap:
    """The subscriptions to one stream, each with a thread of its own."""

    def __init__(self, session: Session, prefix: str, tracks: str, detections: str) -> None:
        self.listeners: dict[object, Receive] = {}
        self.left_s = 0.0
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
