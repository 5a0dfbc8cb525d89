"""What a process of the service measures, in the form that Prometheus reads.

`METRICS` is the whole list: name, kind, labels, meaning. Durations and a few counts are noted as things happen, as
plain numbers with one writer each; they become metrics, and the rest is read from the streams, when somebody asks.
Everything stands in a registry of its own, nothing is global. All histograms and counters are totals of the process;
series with the name of a stream start with `optipmb_stream_`, and only so many streams have them.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from collections import defaultdict
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Final, Literal

import structlog
from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.samples import Sample

from optipmb_service.observability.logs import lines_dropped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

log = structlog.get_logger("optipmb_service")

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

NAMESPACE: Final = "optipmb_"

SECONDS: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper bounds of the histograms' buckets: from a tenth of a usual step to what nobody would call real time."""


@dataclass(frozen=True)
class MetricFamily:
    """A metric of the list: its kind, the names of its labels, and what it means."""

    kind: Literal["counter", "gauge", "histogram"]
    labels: tuple[str, ...]
    meaning: str


SERVICE_METRICS: Final = {
    "info": MetricFamily("gauge", ("instance", "version"), "Always 1; says who reports."),
    "state": MetricFamily("gauge", ("state",), "1 for the state the process is in."),
    "received_total": MetricFamily("counter", ("topic",), "Messages received, before any check."),
    "received_bytes_total": MetricFamily("counter", ("topic",), "Bytes of their payloads."),
    "foreign_total": MetricFamily(
        "counter", ("topic",), "Messages of streams that another member tracks; not among `received`."
    ),
    "foreign_bytes_total": MetricFamily("counter", ("topic",), "Bytes of their payloads."),
    "frames_total": MetricFamily("counter", (), "Frames tracked."),
    "dropped_total": MetricFamily(
        "counter",
        ("reason",),
        "Frames not tracked: `duplicate`, `late`, `shed` (queue full),"
        " `refused` (not valid, over a limit, or quarantined).",
    ),
    "gaps_total": MetricFamily("counter", (), "Frames that never came, by their numbers."),
    "inserted_total": MetricFamily("counter", (), "Late frames put in their place."),
    "corrected_total": MetricFamily("counter", (), "Frames whose tracks were published again for them."),
    "problems_total": MetricFamily("counter", ("code",), "Problems, each with its `count`."),
    "publishers_restarted_total": MetricFamily("counter", (), "Restarts of publishers and jumps of their stamps."),
    "clouds_total": MetricFamily("counter", ("result",), "Frames tracked with their cloud, or that waited in vain."),
    "clouds_shed_total": MetricFamily("counter", (), "Clouds dropped from a full queue."),
    "clouds_refused_total": MetricFamily("counter", (), "Clouds not valid, or that could not be taken."),
    "repaired_total": MetricFamily("counter", (), "Covariances repaired after a loss of rank by rounding."),
    "sessions": MetricFamily("gauge", ("state",), "Sessions."),
    "streams": MetricFamily(
        "gauge", ("role",), "Streams tracked here (`owner`) or ready to be taken over (`standby`)."
    ),
    "sessions_restored_total": MetricFamily("counter", (), "Sessions restored from a checkpoint."),
    "checkpoints_total": MetricFamily("counter", (), "Checkpoints written."),
    "checkpoint_age_seconds": MetricFamily("gauge", (), "Age of the state that a crash now would go back to."),
    "declared_keys_total": MetricFamily(
        "counter", (), "Keys declared on the network; the process restarts at `restart_keys`."
    ),
    "linked": MetricFamily("gauge", (), "1 while the process has a router, or is one."),
    "queue_frames": MetricFamily("gauge", (), "Frames waiting."),
    "oldest_data_seconds": MetricFamily("gauge", (), "Time since the last frame of the longest silent stream."),
    "tracks": MetricFamily("gauge", (), "Tracks in the newest frames."),
    "tracks_started_total": MetricFamily("counter", (), "Track ids that appeared in the published tracks."),
    "tracks_ended_total": MetricFamily("counter", (), "Track ids that left them."),
    "bernoullis": MetricFamily("gauge", (), "Bernoulli components."),
    "poissons": MetricFamily("gauge", (), "Poisson components."),
    "latency_seconds": MetricFamily("histogram", (), "From arrival of a frame to publication of its tracks."),
    "queue_seconds": MetricFamily("histogram", (), "Its part spent waiting for the tracking thread and the cloud."),
    "decode_seconds": MetricFamily("histogram", (), "Its part spent decoding."),
    "step_seconds": MetricFamily("histogram", (), "Its part spent converting and tracking."),
    "stream_frames_total": MetricFamily("counter", ("stream",), "Frames tracked."),
    "stream_shed_total": MetricFamily("counter", ("stream",), "Frames dropped from a full queue."),
    "stream_queue_frames": MetricFamily("gauge", ("stream",), "Frames waiting."),
    "stream_age_seconds": MetricFamily("gauge", ("stream",), "Time since the last frame."),
    "stream_tracks": MetricFamily("gauge", ("stream",), "Tracks in the newest frame."),
    "stream_latency_seconds": MetricFamily(
        "gauge", ("stream", "quantile"), "Median and 99th percentile of the last 512 latencies."
    ),
    "log_lines_dropped_total": MetricFamily("counter", (), "Log lines not written: nobody read stderr in time."),
    "streams_unlisted": MetricFamily("gauge", (), "Streams beyond `http_streams`, without series of their own."),
}
"""Those of a process that tracks, by their names without the prefix `optipmb_`."""

GATEWAY_METRICS: Final = {
    "grpc_open_calls": MetricFamily("gauge", ("method",), "Calls under way."),
    "grpc_calls_total": MetricFamily("counter", ("method", "code"), "Calls that have ended, by status code."),
    "grpc_requests_total": MetricFamily("counter", ("method",), "Messages from callers."),
    "grpc_responses_total": MetricFamily("counter", ("method",), "Messages to callers."),
    "grpc_skipped_total": MetricFamily(
        "counter", ("method",), "Messages left out for a slow caller; counted when its call ends."
    ),
    "grpc_refused_total": MetricFamily("counter", ("code",), "Messages of callers that were not valid."),
    "grpc_invalid_total": MetricFamily("counter", (), "Messages of the network that were not valid, so not sent on."),
}
"""Those of a process that serves gRPC, by itself or beside tracking."""

LOG_METRICS: Final = {
    "log_written_total": MetricFamily("counter", (), "Messages put into the log."),
    "log_repeated_total": MetricFamily("counter", (), "Messages that another bridge had put there."),
    "log_dropped_total": MetricFamily("counter", (), "Messages not put there: too many waited, or NATS refused them."),
    "log_invalid_total": MetricFamily("counter", (), "Messages that were not valid, so not put there."),
    "log_waiting_bytes": MetricFamily("gauge", (), "Bytes waiting for NATS."),
}
"""Those of a bridge into the log."""

TLS_METRICS: Final = {
    "certificate_days": MetricFamily("gauge", ("use",), "Days until a certificate ends; below 0: it has ended."),
}
"""Those of a process with certificates."""

METRICS: Final = SERVICE_METRICS | GATEWAY_METRICS | LOG_METRICS | TLS_METRICS
"""Every metric. The figures of the process itself start with `process_`."""

Value = tuple[str, tuple[str, ...], float]
"""One figure: name in `METRICS`, values of its labels, value."""


class Durations:
    """A histogram with one writer: how many durations lie below each of `SECONDS`, and their sum."""

    def __init__(self) -> None:
        self._counts = [0] * (len(SECONDS) + 1)
        self._sum_s = 0.0

    def observe(self, seconds: float) -> None:
        """Count a duration."""
        self._counts[bisect_left(SECONDS, seconds)] += 1
        self._sum_s += seconds

    def family(self, name: str) -> Metric:
        """Return the metric of the list with what was counted so far; may be called by any thread."""
        counts = accumulate(self._counts)
        buckets = list(zip((*map(str, SECONDS), "+Inf"), counts, strict=True))
        return HistogramMetricFamily(NAMESPACE + name, METRICS[name].meaning, buckets, self._sum_s)


class Metrics:
    """The figures of one process, read by any thread.

    Messages of a topic are counted one after the other, all else by the thread that tracks.

    Args:
        counts: whether it has the counters of tracking.
    """

    def __init__(self, *, counts: bool = True) -> None:
        self.workers: Callable[[], Iterable[tuple[int, bytes]]] = tuple
        """Returns the `samples` of worker processes, each with its number; `text` has them too."""
        self._registry = CollectorRegistry()
        self._durations = {name: Durations() for name, metric in METRICS.items() if metric.kind == "histogram"}
        self._latency, self._queue, self._decode, self._step = (
            self._durations[f"{name}_seconds"] for name in ("latency", "queue", "decode", "step")
        )
        self._messages = {"detections": 0, "points": 0}
        self._bytes = {"detections": 0, "points": 0}
        self._foreign = {"detections": 0, "points": 0}
        self._foreign_bytes = {"detections": 0, "points": 0}
        self._started = self._ended = self._restored = 0
        if counts:
            self._registry.register(Collected(lambda: [one.family(name) for name, one in self._durations.items()]))
            self.add(self._counted)
        ProcessCollector(registry=self._registry)

    def received(self, topic: Literal["detections", "points"], size: int) -> None:
        """Count a message that arrived."""
        self._messages[topic] += 1
        self._bytes[topic] += size

    def foreign(self, topic: Literal["detections", "points"], size: int) -> None:
        """Count a message of a stream that another member tracks."""
        self._foreign[topic] += 1
        self._foreign_bytes[topic] += size

    def published(self, *, latency_s: float, queue_s: float, decode_s: float, step_s: float) -> None:
        """Count a frame whose tracks went out."""
        self._latency.observe(latency_s)
        self._queue.observe(queue_s)
        self._decode.observe(decode_s)
        self._step.observe(step_s)

    def tracks(self, *, started: int, ended: int) -> None:
        """Count ids that came and went."""
        self._started += started
        self._ended += ended

    def restored(self) -> None:
        """Count a session that went on from its checkpoint."""
        self._restored += 1

    def add(self, figures: Callable[[], Iterable[Value]]) -> None:
        """Have figures read whenever somebody asks."""
        self._registry.register(ReadOnDemand(figures))

    def text(self) -> bytes:
        """Return all figures in Prometheus' text format, those of workers with a label."""
        registry = CollectorRegistry()
        registry.register(Collected(self._merged))
        return generate_latest(registry)

    def samples(self) -> bytes:
        """Return all figures as `families` reads them."""
        return json.dumps(
            [
                [
                    one.name,
                    one.documentation,
                    one.type,
                    [[sample.name, sample.labels, sample.value] for sample in one.samples],
                ]
                for one in self._registry.collect()
            ]
        ).encode()

    def _merged(self) -> Iterable[Metric]:
        merged: dict[str, Metric] = {}
        parts: list[tuple[dict[str, str], Iterable[Metric]]] = [({}, self._registry.collect())]
        for worker, data in self.workers():
            try:
                parts.append(({"worker": str(worker)}, families(data)))
            except ValueError as error:
                log.warning("metrics_unreadable", worker=worker, error=str(error))
        for labels, metrics in parts:
            for metric in metrics:
                into = merged.setdefault(metric.name, Metric(metric.name, metric.documentation, metric.type))
                into.samples += [sample._replace(labels={**sample.labels, **labels}) for sample in metric.samples]
        return merged.values()

    def _counted(self) -> Iterator[Value]:
        for topic, count in self._messages.items():
            yield "received_total", (topic,), count
            yield "received_bytes_total", (topic,), self._bytes[topic]
            yield "foreign_total", (topic,), self._foreign[topic]
            yield "foreign_bytes_total", (topic,), self._foreign_bytes[topic]
        yield "tracks_started_total", (), self._started
        yield "tracks_ended_total", (), self._ended
        yield "sessions_restored_total", (), self._restored
        yield "log_lines_dropped_total", (), lines_dropped()


def families(data: bytes) -> list[Metric]:
    """Return the metrics that `Metrics.samples` of another process gave.

    Raises:
        ValueError: they are none.
    """
    made = []
    try:
        for name, meaning, kind, samples in json.loads(data):
            one = Metric(str(name), str(meaning), kind)
            for sample, labels, value in samples:
                one.samples.append(Sample(str(sample), {str(key): str(labels[key]) for key in labels}, float(value)))
            made.append(one)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise ValueError(f"expected the metrics of a worker as JSON: {error}") from error
    return made


class Collected:
    """Metrics that a function makes at every collection."""

    def __init__(self, collect: Callable[[], Iterable[Metric]]) -> None:
        self.collect = collect

    def describe(self) -> list[Metric]:
        """Return nothing: the names are checked by a test, not at every start."""
        return []


class ReadOnDemand(Collected):
    """Asks for figures at every collection."""

    def __init__(self, figures: Callable[[], Iterable[Value]]) -> None:
        super().__init__(lambda: _families_of(figures()))


def _families_of(figures: Iterable[Value]) -> Iterator[Metric]:
    """Yield the metrics of figures."""
    grouped: defaultdict[str, list[tuple[tuple[str, ...], float]]] = defaultdict(list)
    for name, labels, value in figures:
        grouped[name].append((labels, value))
    for name, values in grouped.items():
        metric = METRICS[name]
        kind = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
        family = kind(NAMESPACE + name, metric.meaning, labels=metric.labels)
        for labels, value in values:
            family.add_metric(labels, value)
        yield family
