"""What a process of the service measures, in the form that Prometheus reads.

`METRICS` is the whole list: name, kind, labels, meaning. Histograms and a few counters are fed as things happen; the
rest is read from the streams when somebody asks (`figures`). Everything stands in a registry of its own, nothing is
global. All histograms and counters are totals of the process; series with the name of a stream start with
`optipmb_stream_`, and only so many streams have them.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from prometheus_client.metrics_core import Metric

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
    "frames_total": MetricFamily("counter", (), "Frames tracked."),
    "dropped_total": MetricFamily(
        "counter",
        ("reason",),
        "Frames that came and were not tracked: `duplicate`, `late`, `shed` (queue full), `refused` (not valid).",
    ),
    "gaps_total": MetricFamily("counter", (), "Frames that publishers numbered and that never came."),
    "inserted_total": MetricFamily("counter", (), "Late frames that were put in their place."),
    "corrected_total": MetricFamily("counter", (), "Frames whose tracks were published again because of them."),
    "problems_total": MetricFamily("counter", ("code",), "Problems by code, each with all that it stands for."),
    "publishers_restarted_total": MetricFamily("counter", (), "New epochs of publishers."),
    "clouds_total": MetricFamily(
        "counter", ("result",), "Frames that were tracked with their cloud, or waited in vain."
    ),
    "clouds_shed_total": MetricFamily("counter", (), "Point clouds dropped because the queue was full."),
    "clouds_refused_total": MetricFamily("counter", (), "Point clouds that were not valid."),
    "repaired_total": MetricFamily("counter", (), "Covariances that lost rank in rounding and were repaired."),
    "sessions": MetricFamily("gauge", ("state",), "Sessions, by state."),
    "streams": MetricFamily(
        "gauge", ("role",), "Streams that this instance tracks (`owner`) or stands by for (`standby`)."
    ),
    "sessions_restored_total": MetricFamily("counter", (), "Sessions that went on from a checkpoint."),
    "checkpoints_total": MetricFamily("counter", (), "Checkpoints written."),
    "checkpoint_age_seconds": MetricFamily(
        "gauge", (), "Time since the store had all that it should: what a crash now would have to recover."
    ),
    "queue_frames": MetricFamily("gauge", (), "Frames waiting, over all streams."),
    "oldest_data_seconds": MetricFamily("gauge", (), "Time since the last frame of the stream that is silent longest."),
    "tracks": MetricFamily("gauge", (), "Tracks in the newest frames of all streams."),
    "tracks_started_total": MetricFamily("counter", (), "Track ids that came into the published tracks of a stream."),
    "tracks_ended_total": MetricFamily("counter", (), "Track ids that left them."),
    "bernoullis": MetricFamily("gauge", (), "Bernoulli components of all densities."),
    "poissons": MetricFamily("gauge", (), "Poisson components of all densities."),
    "latency_seconds": MetricFamily("histogram", (), "From the arrival of a frame to the publication of its tracks."),
    "queue_seconds": MetricFamily("histogram", (), "The part of it spent waiting: for a worker and for the cloud."),
    "decode_seconds": MetricFamily("histogram", (), "The part of it spent decoding."),
    "step_seconds": MetricFamily("histogram", (), "The part of it spent converting and tracking."),
    "stream_frames_total": MetricFamily("counter", ("stream",), "Frames tracked in a stream."),
    "stream_shed_total": MetricFamily("counter", ("stream",), "Frames of a stream dropped because its queue was full."),
    "stream_queue_frames": MetricFamily("gauge", ("stream",), "Frames of a stream that wait."),
    "stream_age_seconds": MetricFamily("gauge", ("stream",), "Time since the last frame of a stream."),
    "stream_tracks": MetricFamily("gauge", ("stream",), "Tracks in the newest frame of a stream."),
    "stream_latency_seconds": MetricFamily(
        "gauge", ("stream", "quantile"), "Median and 99th percentile of a stream's last 512 latencies."
    ),
    "streams_unlisted": MetricFamily("gauge", (), "Streams without series of their own: more than `http_streams`."),
}
"""Those of a process that tracks, by their names without the prefix `optipmb_`."""

GATEWAY_METRICS: Final = {
    "grpc_open_calls": MetricFamily("gauge", ("method",), "Calls over gRPC under way."),
    "grpc_calls_total": MetricFamily("counter", ("method", "code"), "Calls over gRPC that have ended, by status code."),
    "grpc_requests_total": MetricFamily("counter", ("method",), "Messages that callers sent over gRPC."),
    "grpc_responses_total": MetricFamily("counter", ("method",), "Messages that were sent to callers over gRPC."),
    "grpc_skipped_total": MetricFamily(
        "counter", ("method",), "Messages left out because the caller read too slowly; counted when its call ends."
    ),
    "grpc_refused_total": MetricFamily("counter", ("code",), "Messages of callers over gRPC that were not valid."),
    "grpc_invalid_total": MetricFamily("counter", (), "Messages of the network that were not valid and not sent on."),
}
"""Those of a process that serves gRPC, by itself or beside tracking."""

METRICS: Final = SERVICE_METRICS | GATEWAY_METRICS
"""Every metric. The figures of the process itself start with `process_`."""

Value = tuple[str, tuple[str, ...], float]
"""One figure: name in `METRICS`, values of its labels, value."""


class Metrics:
    """The figures of one process; written and read by any thread."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._histograms = {
            name: Histogram(NAMESPACE + name, metric.meaning, buckets=SECONDS, registry=self._registry)
            for name, metric in METRICS.items()
            if metric.kind == "histogram"
        }
        self._received = self._counter("received_total")
        self._bytes = self._counter("received_bytes_total")
        self._started = self._counter("tracks_started_total")
        self._ended = self._counter("tracks_ended_total")
        self._restored = self._counter("sessions_restored_total")
        ProcessCollector(registry=self._registry)

    def received(self, topic: str, size: int) -> None:
        """Count a message that arrived."""
        self._received.labels(topic).inc()
        self._bytes.labels(topic).inc(size)

    def published(self, *, latency_s: float, queue_s: float, decode_s: float, step_s: float) -> None:
        """Count a frame whose tracks went out."""
        self._histograms["latency_seconds"].observe(latency_s)
        self._histograms["queue_seconds"].observe(queue_s)
        self._histograms["decode_seconds"].observe(decode_s)
        self._histograms["step_seconds"].observe(step_s)

    def tracks(self, *, started: int, ended: int) -> None:
        """Count ids that came and went."""
        self._started.inc(started)
        self._ended.inc(ended)

    def restored(self) -> None:
        """Count a session that went on from its checkpoint."""
        self._restored.inc()

    def add(self, figures: Callable[[], Iterable[Value]]) -> None:
        """Have figures read whenever somebody asks."""
        self._registry.register(ReadOnDemand(figures))

    def text(self) -> bytes:
        """Return all figures in Prometheus' text format."""
        return generate_latest(self._registry)

    def _counter(self, name: str) -> Counter:
        metric = METRICS[name]
        return Counter(NAMESPACE + name, metric.meaning, metric.labels, registry=self._registry)


class ReadOnDemand:
    """Asks for figures at every collection."""

    def __init__(self, figures: Callable[[], Iterable[Value]]) -> None:
        self._figures = figures

    def collect(self) -> Iterator[Metric]:
        """Read the figures now."""
        grouped: defaultdict[str, list[tuple[tuple[str, ...], float]]] = defaultdict(list)
        for name, labels, value in self._figures():
            grouped[name].append((labels, value))
        for name, values in grouped.items():
            metric = METRICS[name]
            kind = CounterMetricFamily if metric.kind == "counter" else GaugeMetricFamily
            family = kind(NAMESPACE + name, metric.meaning, labels=metric.labels)
            for labels, value in values:
                family.add_metric(labels, value)
            yield family

    def describe(self) -> list[Metric]:
        """Return nothing: the names are checked by a test, not at every start."""
        return []
