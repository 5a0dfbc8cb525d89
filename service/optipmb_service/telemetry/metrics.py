"""Metrics of a process, in the form that Prometheus reads.

The tables are the whole list, one row for each metric: its kind, its meaning, how it is read, and its labels. A metric
is read on request: from `Metrics`, which counts events as plain numbers with one writer each, else from the streams,
the network, or an edge. Everything stands in a registry of its own, nothing is global.
All histograms and counters are totals of the process; series with the name of a stream start with `optipmb_stream_`,
and only so many streams have them.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final, Literal

import structlog
from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from optipmb_service import __version__
from optipmb_service.telemetry.logs import lines_dropped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.telemetry.problem_reporter import ProblemReporter

log = structlog.get_logger("optipmb_service")

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

NAMESPACE: Final = "optipmb_"

SECONDS: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper bounds of the histograms' buckets: from a tenth of a usual step to far beyond real time."""

STATES: Final = ("starting", "ready", "degraded", "paused", "unlinked", "draining", "stopping")
SESSION_STATES: Final = ("new", "running", "stale")
QUANTILES: Final = ("0.5", "0.99")


@dataclass(frozen=True)
class MetricFamily:
    """Declaration of a metric: its type and help text, and how its values are read.

    Attributes:
        kind: type of the metric in Prometheus.
        meaning: its help text.
        read: function of the object that the table is added with; returns the value, or the values by their labels, or
            None where there is none.
        labels: names of the labels.
    """

    kind: Literal["counter", "gauge", "histogram"]
    meaning: str
    read: Callable[[Any], Any]
    labels: tuple[str, ...] = ()

    def metric(self, name: str, source: object) -> Metric | None:
        """Return the metric with its values; None without any."""
        value = self.read(source)
        if isinstance(value, Durations):
            return HistogramMetricFamily(NAMESPACE + name, self.meaning, value.buckets(), value.sum_s)
        values = value if isinstance(value, Mapping) else {} if value is None else {(): value}
        kind = CounterMetricFamily if self.kind == "counter" else GaugeMetricFamily
        family = kind(NAMESPACE + name, self.meaning, labels=self.labels)
        for labels, number in tuple(values.items()):  # others count meanwhile
            family.add_metric((labels,) if isinstance(labels, str) else labels, number)
        return family if values else None


def _counter(meaning: str, read: Callable[[Any], Any], *labels: str) -> MetricFamily:
    return MetricFamily("counter", meaning, read, labels)


def _gauge(meaning: str, read: Callable[[Any], Any], *labels: str) -> MetricFamily:
    return MetricFamily("gauge", meaning, read, labels)


def _histogram(meaning: str, read: Callable[[Any], Any]) -> MetricFamily:
    return MetricFamily("histogram", meaning, read)


def _states(all_of_them: Sequence[str], counts: Mapping[str, int]) -> dict[str, int]:
    """Return a value for each known state, and for each other one that occurs."""
    return {state: counts.get(state, 0) for state in (*all_of_them, *sorted(counts.keys() - set(all_of_them)))}


def _each(read: Callable[[schemas.SessionSummary], float | None]) -> Callable[[StreamFigures], dict[str, float]]:
    """Return what reads a value of each listed stream that has one."""
    return lambda figures: {one.stream: value for one in figures.listed if (value := read(one)) is not None}


PROCESS_METRICS: Final = {
    "info": _gauge("Always 1; says who reports.", lambda p: {(p.instance, __version__): 1}, "instance", "version"),
    "state": _gauge("1 for the state the process is in.", lambda p: _states(STATES, {p.state(): 1}), "state"),
}
"""Metrics of every process, by their names without the prefix `optipmb_`; read from `ProcessHealth`."""

NETWORK_METRICS: Final = {
    "declared_keys_total": _counter(
        "Keys declared on the network; the process restarts at `restart_keys`.", lambda c: c.key_numbers.declared
    ),
    "linked": _gauge("1 while the process has a router, or is one.", lambda c: c.linked()),
}
"""Metrics of a process with a client of the network."""

COUNTED_METRICS: Final = {
    "received_total": _counter("Messages received, before any check.", lambda m: m.messages, "topic"),
    "received_bytes_total": _counter("Bytes of their payloads.", lambda m: m.bytes, "topic"),
    "foreign_total": _counter(
        "Messages of streams that another member tracks; not among `received`.", lambda m: m.foreign_messages, "topic"
    ),
    "foreign_bytes_total": _counter("Bytes of their payloads.", lambda m: m.foreign_bytes, "topic"),
    "sessions_restored_total": _counter("Sessions restored from a checkpoint.", lambda m: m.sessions_restored),
    "tracks_started_total": _counter("Track ids that appeared in the published tracks.", lambda m: m.tracks_started),
    "tracks_ended_total": _counter("Track ids that left them.", lambda m: m.tracks_ended),
    "latency_seconds": _histogram("From arrival of a frame to publication of its tracks.", lambda m: m.latency),
    "queue_seconds": _histogram("Its part spent waiting for the tracking thread and the cloud.", lambda m: m.queue),
    "decode_seconds": _histogram("Its part spent decoding.", lambda m: m.decode),
    "step_seconds": _histogram("Its part spent converting and tracking.", lambda m: m.step),
    "log_lines_dropped_total": _counter(
        "Log lines not written: nobody read stderr in time.", lambda _: lines_dropped()
    ),
}
"""Metrics that `Metrics` counts."""

PROBLEM_METRICS: Final = {
    "problems_total": _counter("Problems, each with its `count`.", lambda s: s.reporter.counts(), "code"),
}
"""Metrics of a process that reports problems."""

STREAM_METRICS: Final = {
    "frames_total": _counter("Frames tracked.", lambda s: s.totals.frames),
    "dropped_total": _counter(
        "Frames not tracked: `duplicate`, `late`, `shed` (queue full),"
        " `refused` (not valid, over a limit, or quarantined).",
        lambda s: {
            "duplicate": s.totals.duplicates,
            "late": s.totals.late,
            "refused": s.totals.refused,
            "shed": s.totals.shed,
        },
        "reason",
    ),
    "gaps_total": _counter("Frames that never came, by their numbers.", lambda s: s.totals.gaps),
    "inserted_total": _counter("Late frames put in their place.", lambda s: s.totals.inserted),
    "corrected_total": _counter("Frames whose tracks were published again for them.", lambda s: s.totals.corrected),
    "publishers_restarted_total": _counter(
        "Restarts of publishers and jumps of their stamps.", lambda s: s.totals.new_epochs
    ),
    "clouds_total": _counter(
        "Frames tracked with their cloud, or that waited in vain.",
        lambda s: {"used": s.totals.clouds_used, "missed": s.totals.clouds_missed},
        "result",
    ),
    "clouds_shed_total": _counter("Clouds dropped from a full queue.", lambda s: s.totals.clouds_shed),
    "clouds_refused_total": _counter(
        "Clouds not valid, or that could not be taken.", lambda s: s.totals.clouds_refused
    ),
    "repaired_total": _counter("Covariances repaired after a loss of rank by rounding.", lambda s: s.totals.repaired),
    "rejoined_total": _counter("Tracks joined with an earlier one of the same object.", lambda s: s.totals.rejoined),
    "lost_dropped_total": _counter(
        "Lost objects dropped because there were too many.", lambda s: s.totals.lost_dropped
    ),
    "lost_objects": _gauge(
        "Lost objects that may still be joined.",
        lambda s: sum(len(one.rejoining.lost) for one in s.densities if one.rejoining is not None),
    ),
    "sessions": _gauge(
        "Sessions.", lambda s: _states(SESSION_STATES, Counter(one.state for one in s.sessions)), "state"
    ),
    "streams": _gauge(
        "Streams tracked here (`owner`) or ready to be taken over (`standby`).",
        lambda s: {"owner": len(s.sessions), "standby": s.standing_by},
        "role",
    ),
    "checkpoints_total": _counter("Checkpoints written.", lambda s: s.checkpoints),
    "checkpoint_age_seconds": _gauge(
        "Age of the state that a crash now would go back to.", lambda s: s.checkpoint_age_s
    ),
    "queue_frames": _gauge("Frames waiting.", lambda s: sum(one.queue for one in s.sessions)),
    "oldest_data_seconds": _gauge(
        "Time since the last frame of the longest silent stream.",
        lambda s: max((one.age_s or 0.0 for one in s.sessions), default=0.0),
    ),
    "tracks": _gauge("Confirmed tracks in the newest frames.", lambda s: sum(one.tracks for one in s.sessions)),
    "bernoullis": _gauge("Bernoulli components.", lambda s: sum(len(one.bernoulli) for one in s.densities)),
    "poissons": _gauge("Poisson components.", lambda s: sum(len(one.poisson) for one in s.densities)),
    "stream_frames_total": _counter("Frames tracked.", _each(lambda one: one.frames), "stream"),
    "stream_shed_total": _counter("Frames dropped from a full queue.", _each(lambda one: one.shed), "stream"),
    "stream_queue_frames": _gauge("Frames waiting.", _each(lambda one: one.queue), "stream"),
    "stream_age_seconds": _gauge("Time since the last frame.", _each(lambda one: one.age_s), "stream"),
    "stream_tracks": _gauge("Confirmed tracks in the newest frame.", _each(lambda one: one.tracks), "stream"),
    "stream_latency_seconds": _gauge(
        "Median and 99th percentile of the last 512 latencies.",
        lambda s: {
            (one.stream, quantile): value / 1e3
            for one in s.listed
            for quantile, value in zip(QUANTILES, (one.latency_p50_ms, one.latency_p99_ms), strict=True)
        },
        "stream",
        "quantile",
    ),
    "streams_unlisted": _gauge(
        "Streams beyond `http_streams`, without series of their own.", lambda s: len(s.sessions) - len(s.listed)
    ),
}
"""Metrics of the streams; read from `StreamFigures`."""

GATEWAY_METRICS: Final = {
    "grpc_open_calls": _gauge("Calls under way.", lambda c: dict(c.open), "method"),
    "grpc_calls_total": _counter("Calls that have ended, by status code.", lambda c: dict(c.ended), "method", "code"),
    "grpc_requests_total": _counter("Messages from callers.", lambda c: dict(c.requests), "method"),
    "grpc_responses_total": _counter("Messages to callers.", lambda c: dict(c.responses), "method"),
    "grpc_skipped_total": _counter(
        "Messages left out for a slow caller; counted when its call ends.", lambda c: dict(c.skipped), "method"
    ),
    "grpc_refused_total": _counter("Messages of callers that were not valid.", lambda c: dict(c.refused), "code"),
    "grpc_invalid_total": _counter("Messages of the network that were not valid, so not sent on.", lambda c: c.invalid),
}
"""Metrics of a process that serves gRPC, whether or not it tracks."""

INPUT_METRICS: Final = {
    "inputs_frames_total": _counter("Frames handed to the network for senders of JSON.", lambda i: i.frames, "edge"),
    "inputs_duplicates_total": _counter("Frames of them that came again.", lambda i: i.duplicates, "edge"),
    "inputs_refused_total": _counter("Frames of them that were refused.", lambda i: i.refused, "edge", "code"),
}
"""Metrics of a process that takes frames of senders of JSON."""

LOG_METRICS: Final = {
    "message_log_written_total": _counter("Messages put into the message log.", lambda b: b.writer.written),
    "message_log_repeated_total": _counter("Messages that another bridge had put there.", lambda b: b.writer.repeated),
    "message_log_dropped_total": _counter(
        "Messages not put there: too many waited, or NATS refused them.", lambda b: b.writer.dropped
    ),
    "message_log_invalid_total": _counter("Messages that were not valid, so not put there.", lambda b: b.invalid),
    "message_log_waiting_bytes": _gauge("Bytes waiting for NATS.", lambda b: b.writer.held_bytes),
}
"""Metrics of a bridge into the message log."""

LINK_METRICS: Final = {
    "links_messages_total": _counter("Tracks taken to be linked.", lambda b: b.messages["taken"]),
    "links_left_out_total": _counter(
        "Messages and tracks that were not linked, and links withdrawn, since the beginning of the state.",
        lambda b: b.counts(),
        "reason",
    ),
    "links_objects": _gauge("Objects that are remembered.", lambda b: b.objects(linked=False), "area"),
    "links_linked": _gauge("Objects that are linked.", lambda b: b.objects(linked=True), "area"),
}
"""Metrics of a process that links tracks."""

TLS_METRICS: Final = {
    "certificate_days": _gauge("Days until a certificate ends; below 0: it has ended.", lambda c: c.days(), "use"),
}
"""Metrics of a process with certificates."""

SERVICE_METRICS: Final = PROCESS_METRICS | NETWORK_METRICS | COUNTED_METRICS | PROBLEM_METRICS | STREAM_METRICS
"""Metrics of a process that tracks."""

MQTT_METRICS: Final = {
    "mqtt_connected": _gauge("1 while there is a connection to the broker.", lambda b: b.connected),
    "mqtt_published_total": _counter(
        "Messages that the broker has taken; with QoS 0, those that were sent.", lambda b: b.published, "topic"
    ),
    "mqtt_refused_total": _counter("Messages that the broker did not take.", lambda b: b.refused, "reason"),
    "mqtt_skipped_total": _counter("Messages replaced by newer ones before the broker took them.", lambda b: b.skipped),
    "mqtt_cpm_left_out_total": _counter("Objects left out of CPM.", lambda b: b.left_out, "reason"),
    "mqtt_events_lost_total": _counter("Events lost while the broker was away, or refused.", lambda b: b.lost),
}
"""Metrics of the bridge to MQTT."""

METRICS: Final = (
    SERVICE_METRICS | GATEWAY_METRICS | INPUT_METRICS | LINK_METRICS | LOG_METRICS | MQTT_METRICS | TLS_METRICS
)
"""Every metric. The figures of the process itself start with `process_`."""


@dataclass(frozen=True)
class StreamFigures:
    """The streams of a process at one time, as `STREAM_METRICS` reads them.

    Attributes:
        reporter: of problems.
        totals: `MessageCounters` of all streams since the start.
        sessions: a line for each session.
        listed: sessions with series of their own.
        densities: of the sessions.
        standing_by: streams that are ready to be taken over.
        checkpoints: written since the start.
        checkpoint_age_s: since the store last had all that it should; None when nothing is to be kept.
    """

    reporter: ProblemReporter
    totals: Any
    sessions: Sequence[schemas.SessionSummary]
    listed: Sequence[schemas.SessionSummary]
    densities: Sequence[optipmb.Density]
    standing_by: int
    checkpoints: int
    checkpoint_age_s: float | None


class Durations:
    """A histogram with one writer: how many durations lie below each of `SECONDS`, and their sum."""

    def __init__(self) -> None:
        self._counts = [0] * (len(SECONDS) + 1)
        self.sum_s = 0.0

    def observe(self, seconds: float) -> None:
        self._counts[bisect_left(SECONDS, seconds)] += 1
        self.sum_s += seconds

    def buckets(self) -> list[tuple[str, float]]:
        """Return upper bounds and how many durations lie below each; may be called by any thread."""
        return list(zip((*map(str, SECONDS), "+Inf"), accumulate(self._counts), strict=True))


class Metrics:
    """The metrics of one process, read by any thread.

    Messages of a topic are counted one after the other, all else by the thread that tracks.

    Args:
        counts: whether it has the counters of tracking.
    """

    def __init__(self, *, counts: bool = True) -> None:
        self.workers: Callable[[], Iterable[tuple[int, bytes]]] = tuple
        """Returns the `text` of worker processes, each with its number; `text` includes them."""
        self.latency, self.queue, self.decode, self.step = Durations(), Durations(), Durations(), Durations()
        self.messages, self.bytes, self.foreign_messages, self.foreign_bytes = (
            {"detections": 0, "points": 0} for _ in range(4)
        )
        self.tracks_started = self.tracks_ended = self.sessions_restored = 0
        self._registry = CollectorRegistry()
        if counts:
            self.add(COUNTED_METRICS, lambda: self)
        ProcessCollector(registry=self._registry)

    def received(self, topic: Literal["detections", "points"], size: int) -> None:
        """Count a message that arrived."""
        self.messages[topic] += 1
        self.bytes[topic] += size

    def foreign(self, topic: Literal["detections", "points"], size: int) -> None:
        """Count a message of a stream that another member tracks."""
        self.foreign_messages[topic] += 1
        self.foreign_bytes[topic] += size

    def published(self, *, latency_s: float, queue_s: float, decode_s: float, step_s: float) -> None:
        """Count a frame whose tracks went out."""
        self.latency.observe(latency_s)
        self.queue.observe(queue_s)
        self.decode.observe(decode_s)
        self.step.observe(step_s)

    def tracks(self, *, started: int, ended: int) -> None:
        """Count ids that came and went."""
        self.tracks_started += started
        self.tracks_ended += ended

    def restored(self) -> None:
        """Count a session that went on from its checkpoint."""
        self.sessions_restored += 1

    def add(self, table: Mapping[str, MetricFamily], source: Callable[[], object]) -> None:
        """Have the metrics of a table read from what `source` returns, whenever somebody asks."""

        def collect() -> Iterable[Metric]:
            read = source()
            return [metric for name, row in table.items() if (metric := row.metric(name, read)) is not None]

        self._registry.register(Collected(collect))

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format, series of workers with a label."""
        registry = CollectorRegistry()
        registry.register(Collected(self._merged))
        return generate_latest(registry)

    def _merged(self) -> Iterable[Metric]:
        merged: dict[str, Metric] = {}
        parts: list[tuple[dict[str, str], Iterable[Metric]]] = [({}, self._registry.collect())]
        for worker, text in self.workers():
            try:
                parts.append(({"worker": str(worker)}, list(text_string_to_metric_families(text.decode()))))
            except ValueError as error:
                log.warning("metrics_unreadable", worker=worker, error=str(error))
        for labels, metrics in parts:
            for metric in metrics:
                into = merged.setdefault(metric.name, Metric(metric.name, metric.documentation, metric.type))
                into.samples += [sample._replace(labels={**sample.labels, **labels}) for sample in metric.samples]
        return merged.values()


class Collected:
    """Metrics that a function makes at every collection."""

    def __init__(self, collect: Callable[[], Iterable[Metric]]) -> None:
        self.collect = collect

    def describe(self) -> list[Metric]:
        """Return nothing: the names are checked by a test, not at every start."""
        return []
