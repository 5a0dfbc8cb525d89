"""SensorMeters: activity, silence and overload of the sensors of one session."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import structlog

from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.telemetry.stream_meter import StreamMeter
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.streams.parts import Parts
    from optipmb_service.zenoh.topics import Packet

log = structlog.get_logger("optipmb_service")

REST: Final = 9
"""Rest of a sensor after a message beyond the limit, as a multiple of its time: it gets a tenth of the time at most."""


class SensorMeters:
    """Sensors of one session: when each sent last, which fell silent, and which rest.

    Written by the tracking thread; the control loop looks for silent ones.

    Args:
        session: its name.
        meter: the figures of the session.
        parts: of the process.
    """

    def __init__(self, session: str, meter: StreamMeter, parts: Parts) -> None:
        self.limit_ns = round(parts.settings.step_limit_s * SECOND)
        """Most processor time of a message."""
        self._parts = parts
        self._fused = fused = parts.fusion.is_session(session)
        self._meter = meter
        self._meters: dict[str, StreamMeter] = {} if fused else {session: meter}
        self._stale: set[str] = set()
        self._resting: dict[str, int] = {}
        """Monotonic time until when messages of a sensor are refused."""

    def arrived(self, packet: Packet, stream: str) -> None:
        """Note a valid message of a sensor."""
        frame = packet.frame
        self._meter.arrived(packet.now_ns, frame=frame)
        if self._fused:
            if stream not in self._meters and len(self._meters) >= MAX_SENSORS:
                self._forget_stale()
            if stream in self._meters or len(self._meters) < MAX_SENSORS:
                self._meters.setdefault(stream, StreamMeter(packet.now_ns)).arrived(packet.now_ns, frame=frame)
        if stream in self._stale and frame:
            self._stale.discard(stream)
            log.info("stream_back", stream=stream)

    def refuses(self, stream: str) -> bool:
        """Report a message of a sensor that rests; False when it does not."""
        if not self._resting or time.monotonic_ns() >= self._resting.get(stream, 0):
            return False
        self._report(stream, "a stream that took more just before")
        return True

    def charge(self, stream: str, took_ns: int) -> None:
        """Let a sensor rest whose message took too much processor time: the others of the process waited."""
        if took_ns <= self.limit_ns:
            return
        now_ns = time.monotonic_ns()
        self._resting = {name: until for name, until in self._resting.items() if until > now_ns}
        self._resting[stream] = now_ns + REST * took_ns
        log.warning("stream_degraded", stream=stream, took_s=took_ns / SECOND, refused_s=REST * took_ns / SECOND)
        self._report(stream, f"{took_ns / SECOND:.3f} s")

    def look_for_silent(self, now_ns: int, stale_s: float) -> None:
        """Log the sensors that have sent no frame for longer than `stale_s`, each once."""
        for stream, meter in tuple(self._meters.items()):
            age_s = meter.age_s(now_ns)
            if age_s is not None and age_s > stale_s and stream not in self._stale:
                self._stale.add(stream)
                log.warning("stream_stale", stream=stream, age_s=round(age_s, 3))

    def silent_ns(self, now_ns: int) -> int:
        """Return the time since the last message of the sensor that is silent for longest; for any thread."""
        return now_ns - min((meter.active_ns for meter in tuple(self._meters.values())), default=self._meter.active_ns)

    def summary(self, state: schemas.SessionState, now_ns: int) -> schemas.SessionSummary:
        """Return the line of the service's status; for any thread."""
        degraded = any(now_ns < until for until in tuple(self._resting.values()))
        stale, sensors = frozenset(self._stale), sorted(self._meters)
        is_stale = bool(sensors) and stale >= set(sensors)
        summary = self._meter.summary(state, now_ns, stale=is_stale, degraded=degraded)
        if not self._fused:
            return summary
        return summary.model_copy(update={"sensors": tuple(sensors), "silent": tuple(sorted(stale))})

    def _forget_stale(self) -> None:
        oldest = min(self._meters, key=lambda name: self._meters[name].active_ns)
        if oldest in self._stale:
            self._stale.discard(oldest)
            self._meters = {name: one for name, one in self._meters.items() if name != oldest}

    def _report(self, stream: str, received: str) -> None:
        expected = f"at most {self.limit_ns / SECOND:g} s of processor time for a message"
        self._parts.report("overload", stream, expected, received)
