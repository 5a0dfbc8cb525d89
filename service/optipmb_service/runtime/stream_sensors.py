"""The streams that feed a session: when each sent last, and which of them fell silent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import structlog

from optipmb_service.session.values import MAX_SENSORS
from optipmb_service.telemetry.stream_meter import StreamMeter

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.runtime.ports import Packet

log = structlog.get_logger("optipmb_service")


class StreamSensors:
    """The streams of one session.

    Written by the tracking thread; the control loop looks for those that are silent.

    Args:
        stream: the name of the session.
        fused: whether several streams feed it, which are known when they send.
        meter: the figures of the session.
    """

    def __init__(self, stream: str, meter: StreamMeter, *, fused: bool) -> None:
        self._fused = fused
        self._meter = meter
        self._meters: dict[str, StreamMeter] = {} if fused else {stream: meter}
        self._stale: set[str] = set()

    def arrived(self, packet: Packet, stream: str, *, frame: bool) -> None:
        """Note a valid message of a stream."""
        self._meter.arrived(packet.now_ns, frame=frame)
        if self._fused and stream not in self._meters and len(self._meters) >= MAX_SENSORS:
            oldest = min(self._meters, key=lambda name: self._meters[name].active_ns)
            if oldest in self._stale:
                self._stale.discard(oldest)
                self._meters = {name: one for name, one in self._meters.items() if name != oldest}
        if self._fused and (stream in self._meters or len(self._meters) < MAX_SENSORS):
            self._meters.setdefault(stream, StreamMeter(packet.now_ns)).arrived(packet.now_ns, frame=frame)
        if stream in self._stale and frame:
            self._stale.discard(stream)
            log.info("stream_back", stream=stream)

    def look_for_silent(self, now_ns: int, stale_s: float) -> None:
        """Log the streams that have sent no frame for longer than `stale_s`, each once; called by the control loop."""
        for stream, meter in tuple(self._meters.items()):
            age_s = meter.age_s(now_ns)
            if age_s is not None and age_s > stale_s and stream not in self._stale:
                self._stale.add(stream)
                log.warning("stream_stale", stream=stream, age_s=round(age_s, 3))

    def silent_ns(self, now_ns: int) -> int:
        """Return the time since the last message of the stream that is silent for longest; called by any thread."""
        return now_ns - min((meter.active_ns for meter in tuple(self._meters.values())), default=self._meter.active_ns)

    def summary(self, state: schemas.SessionState, now_ns: int, *, degraded: bool) -> schemas.SessionSummary:
        """Return the line of the service's status; may be called by any thread."""
        stale, sensors = frozenset(self._stale), sorted(self._meters)
        is_stale = bool(sensors) and stale >= set(sensors)
        summary = self._meter.summary(state, now_ns, stale=is_stale, degraded=degraded)
        if not self._fused:
            return summary
        return summary.model_copy(update={"sensors": tuple(sensors), "silent": tuple(sorted(stale))})
