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

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.samples import Sample

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

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
        "counter", ("topic",), "Messages received of streams that another member tracks; not among `received`."
    ),
    "foreign_bytes_total": MetricFamily("counter", ("topic",), "Bytes of their payloads."),
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

LOG_METRICS: Final = {
    "log_written_total": MetricFamily("counter", (), "Messages that this bridge has put into the log."),
    "log_repeated_total": MetricFamily("counter", (), "Messages that another bridge had put there before."),
    "log_dropped_total": MetricFamily(
        "counter", (), "Messages that are not in the log: too many waited for NATS, or it does not take them."
    ),
    "log_invalid_total": MetricFamily("counter", (), "Messages that were not valid and not put into the log."),
    "log_waiting_bytes": MetricFamily("gauge", (), "Bytes of messages that wait for NATS."),
}
"""Those of a bridge into the log."""

METRICS: Final = SERVICE_METRICS | GATEWAY_METRICS | LOG_METRICS
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

    Messages of a topic are counted by the reader of the topic, all else by the thread that tracks.
    """

    def __init__(self) -> None:
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
        """Return all figures in Prometheus' text format."""
        return generate_latest(self._registry)

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

    def _counted(self) -> Iterator[Value]:
        for topic, count in self._messages.items():
            yield "received_total", (topic,), count
            yield "received_bytes_total", (topic,), self._bytes[topic]
            yield "foreign_total", (topic,), self._foreign[topic]
            yield "foreign_bytes_total", (topic,), self._foreign_bytes[topic]
        yield "tracks_started_total", (), self._started
        yield "tracks_ended_total", (), self._ended
        yield "sessions_restored_total", (), self._restored


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
