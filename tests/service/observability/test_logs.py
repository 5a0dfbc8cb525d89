"""Log lines: not too many of one event, and none lost without a word."""

from __future__ import annotations

import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st
from optipmb_service.observability.logs import BURST, LINES_PER_SECOND, Limiter


@given(st.lists(st.tuples(st.sampled_from(["problem", "peer_lost"]), st.floats(0, 0.5)), max_size=300))
def test_lines_are_limited_and_counted(lines: list[tuple[str, float]]) -> None:
    """Of each event at most a burst and then so many a second pass; every line dropped is in a later `suppressed`."""
    now = 0.0
    limiter = Limiter(lambda: now)
    passed: dict[str, int] = {}
    told: dict[str, int] = {}
    for event, pause in lines:
        now += pause
        try:
            line = limiter(None, "info", {"event": event})
        except structlog.DropEvent:
            continue
        passed[event] = passed.get(event, 0) + 1
        told[event] = told.get(event, 0) + line.get("suppressed", 0)
        assert passed[event] <= BURST + now * LINES_PER_SECOND + 1e-6
    now += BURST / LINES_PER_SECOND
    for event in {event for event, _ in lines}:
        line = limiter(None, "info", {"event": event})
        sent = sum(name == event for name, _ in lines)
        assert passed.get(event, 0) + told.get(event, 0) + line.get("suppressed", 0) == sent


def test_one_event_does_not_hide_another() -> None:
    """When one event is cut, the others are written as ever."""
    limiter = Limiter(lambda: 0.0)
    for _ in range(BURST):
        limiter(None, "info", {"event": "stream_stale"})
    with pytest.raises(structlog.DropEvent):
        limiter(None, "info", {"event": "stream_stale"})
    assert limiter(None, "info", {"event": "stop_asked"}) == {"event": "stop_asked"}
