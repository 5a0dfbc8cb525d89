"""What a message may cost: a stream with one that took longer is degraded, for the others of the process waited.

A degraded stream rests: its messages are refused for `REST` times as long as the one took. In a session of several
streams each is degraded for its own messages.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import structlog

if TYPE_CHECKING:
    from optipmb_service.runtime.stream_outputs import StreamOutputs

log = structlog.get_logger("optipmb_service")

REST: Final = 9
"""How many times as long as a message took beyond its limit a stream rests: it has a tenth of the time at most."""


class StepLimit:
    """The streams of a session that rest, and until when.

    Args:
        limit_ns: processor time that one message may take.
        outputs: where it is reported.
    """

    def __init__(self, limit_ns: int, outputs: StreamOutputs) -> None:
        self.limit_ns = limit_ns
        """Processor time that one message may take."""
        self._outputs = outputs
        self.until_ns: dict[str, int] = {}
        """By stream, until when its messages are refused (monotonic); looked up for every message."""

    def charge(self, stream: str, took_ns: int) -> None:
        """Degrade a stream if a message of it took too long.

        Args:
            stream: that of the message.
            took_ns: processor time that the message took.
        """
        if took_ns <= self.limit_ns:
            return
        now_ns = time.monotonic_ns()
        self.until_ns = {name: until for name, until in self.until_ns.items() if until > now_ns}
        self.until_ns[stream] = now_ns + REST * took_ns
        log.warning("stream_degraded", stream=stream, took_s=took_ns / 1e9, refused_s=REST * took_ns / 1e9)
        self._report(stream, f"{took_ns / 1e9:.3f} s")

    def refuse(self, stream: str) -> None:
        """Report that a message of a degraded stream is refused."""
        self._report(stream, "a stream that took more just before")

    def is_exceeded(self, now_ns: int) -> bool:
        """Whether any stream is degraded; may be called by any thread."""
        return any(now_ns < until for until in tuple(self.until_ns.values()))

    def _report(self, stream: str, received: str) -> None:
        expected = f"at most {self.limit_ns / 1e9:g} s of processor time for a message"
        self._outputs.report("overload", "", expected, received, stream=stream)
