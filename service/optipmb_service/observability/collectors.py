"""Reads the figures of `metrics` from the streams, the problems and the state of a process, when somebody asks."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from optipmb_service import __version__
from optipmb_service.session.values import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.observability.metrics import Value
    from optipmb_service.session.values import MessageCounters

STATES: Final = ("starting", "ready", "degraded", "paused", "unlinked", "draining", "stopping")
SESSION_STATES: Final = ("new", "running", "stale")
QUANTILES: Final = ("0.5", "0.99")


def of_process(instance: str, state: str) -> Iterator[Value]:
    """Give who reports and how the process is."""
    yield "info", (instance, __version__), 1
    for name in (*STATES, *({state} - set(STATES))):
        yield "state", (name,), state == name


def of_network(declared: int, *, linked: bool) -> Iterator[Value]:
    """Give how a process is connected: the keys that it has declared, and whether it has a router."""
    yield "declared_keys_total", (), declared
    yield "linked", (), linked


def of_problems(counts: dict[str, int]) -> Iterator[Value]:
    """Give the problems by code."""
    for code, count in counts.items():
        yield "problems_total", (code,), count


def of_totals(counters: MessageCounters) -> Iterator[Value]:
    """Give what happened to the messages of all streams since the start."""
    yield "frames_total", (), counters.frames
    yield "dropped_total", ("duplicate",), counters.duplicates
    yield "dropped_total", ("late",), counters.late
    yield "dropped_total", ("refused",), counters.refused
    yield "dropped_total", ("shed",), counters.shed
    yield "gaps_total", (), counters.gaps
    yield "inserted_total", (), counters.inserted
    yield "corrected_total", (), counters.corrected
    yield "publishers_restarted_total", (), counters.new_epochs
    yield "clouds_total", ("used",), counters.clouds_used
    yield "clouds_total", ("missed",), counters.clouds_missed
    yield "clouds_shed_total", (), counters.clouds_shed
    yield "clouds_refused_total", (), counters.clouds_refused
    yield "repaired_total", (), counters.repaired


def of_durability(
    written: int, complete_ns: int | None, *, owned: int, standing_by: int, now_ns: int
) -> Iterator[Value]:
    """Give what would be lost if the process died now, and what it would take over if another did.

    Args:
        written: checkpoints since the start.
        complete_ns: when the store last had all that it should, monotonic; None when nothing is to be kept.
        owned: streams tracked here.
        standing_by: streams that are ready to be taken over.
        now_ns: monotonic time.
    """
    if complete_ns is not None:
        yield "checkpoint_age_seconds", (), max(0, now_ns - complete_ns) / SECOND
    yield "checkpoints_total", (), written
    yield "streams", ("owner",), owned
    yield "streams", ("standby",), standing_by


def of_sessions(sessions: Sequence[schemas.SessionSummary]) -> Iterator[Value]:
    """Give how the streams are now, all together."""
    states = Counter(session.state for session in sessions)
    for state in (*SESSION_STATES, *sorted(states.keys() - set(SESSION_STATES))):
        yield "sessions", (state,), states[state]
    yield "queue_frames", (), sum(session.queue for session in sessions)
    yield "oldest_data_seconds", (), max((session.age_s or 0.0 for session in sessions), default=0.0)
    yield "tracks", (), sum(session.tracks for session in sessions)


def of_densities(densities: Sequence[optipmb.Density]) -> Iterator[Value]:
    """Give how much the densities hold."""
    yield "bernoullis", (), sum(len(density.bernoulli) for density in densities)
    yield "poissons", (), sum(len(density.poisson) for density in densities)


def of_streams(sessions: Sequence[schemas.SessionSummary], most: int) -> Iterator[Value]:
    """Give how single streams are now: the first `most` by name, so that the same ones are listed every time."""
    for session in sessions[:most]:
        name = session.stream
        yield "stream_frames_total", (name,), session.frames
        yield "stream_shed_total", (name,), session.shed
        yield "stream_queue_frames", (name,), session.queue
        if session.age_s is not None:
            yield "stream_age_seconds", (name,), session.age_s
        yield "stream_tracks", (name,), session.tracks
        for quantile, value in zip(QUANTILES, (session.latency_p50_ms, session.latency_p99_ms), strict=True):
            yield "stream_latency_seconds", (name, quantile), value / 1e3
    yield "streams_unlisted", (), max(0, len(sessions) - most)
