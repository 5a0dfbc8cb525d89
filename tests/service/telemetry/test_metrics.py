"""What a process measures: as Prometheus' own client would count it, and the same for the parent of workers."""

import re
from collections.abc import Iterator
from types import SimpleNamespace

from optipmb_service.telemetry.metrics import METRICS, SECONDS, Metrics
from prometheus_client import CollectorRegistry, Histogram, generate_latest
from structlog.testing import capture_logs

DURATIONS = (0.0, 1e-9, 0.0005, 0.00051, 0.001, 0.0999, 0.1, 1.0, 5.0, 5.1, 1e9)


def filled() -> Metrics:
    metrics = Metrics()
    for number, seconds in enumerate(DURATIONS):
        metrics.received("detections", 100 + number)
        metrics.published(latency_s=seconds, queue_s=seconds / 2, decode_s=0.0, step_s=2 * seconds)
        metrics.tracks(started=2, ended=1)
    metrics.received("points", 10_000)
    metrics.restored()
    stream = SimpleNamespace(stream='a/b/"c\\\n', frames=3, queue=float("inf"))
    table = {name: METRICS[name] for name in ("stream_frames_total", "queue_frames")}
    metrics.add(table, lambda: SimpleNamespace(sessions=[stream], listed=[stream]))
    return metrics


def own(text: bytes) -> list[str]:
    """Return the lines that are not about the process itself, whose figures change while they are read."""
    return [line for line in text.decode().splitlines() if not re.match(r"(# \w+ )?process_", line)]


def without_worker(line: str) -> str:
    """Return a line without the label that the parent adds."""
    return re.sub(r'[,{]worker="3"(})?', lambda found: "}" if found[0].startswith(",") else "", line)


def test_durations_are_counted_as_prometheus_counts_them() -> None:
    """Buckets, their ends, counts and sums equal the client's own histogram."""
    registry = CollectorRegistry()
    histogram = Histogram("optipmb_latency_seconds", "x", buckets=SECONDS, registry=registry)
    for seconds in DURATIONS:
        histogram.observe(seconds)
    expected = [one for one in generate_latest(registry).decode().splitlines() if one.startswith("optipmb_latency_se")]
    seen = [one for one in own(filled().text()) if one.startswith("optipmb_latency_seconds_")]
    assert seen == [line for line in expected if "_created" not in line]


def test_counts_are_there_from_the_start() -> None:
    """A counter that has not counted is 0, not absent."""
    lines = own(Metrics().text())
    for name in ('received_total{topic="points"}', "tracks_started_total", "step_seconds_count"):
        assert f"optipmb_{name} 0.0" in lines


def test_what_is_counted_for_the_first_time_meanwhile_ends_no_answer() -> None:
    """Another thread counts a reason that was not there while the metrics are made."""
    counts: dict[object, int] = {}

    class Reason(tuple[str, ...]):
        __slots__ = ()

        def __iter__(self) -> Iterator[str]:
            counts["another",] = 1
            return super().__iter__()

    counts[Reason(("first",))] = 1
    metrics = Metrics()
    metrics.add({"mqtt_refused_total": METRICS["mqtt_refused_total"]}, lambda: SimpleNamespace(refused=counts))
    assert 'optipmb_mqtt_refused_total{reason="first"} 1.0' in own(metrics.text())


def test_the_parent_shows_what_its_workers_show() -> None:
    """The series of a worker have its number; of an answer that is no metrics nothing is shown but a warning."""
    worker, parent = filled(), Metrics(counts=False)
    parent.workers = lambda: [(3, worker.text()), (4, b"\xff"), (5, b"{")]
    with capture_logs() as logs:
        shown = own(parent.text())
    values = [line for line in own(worker.text()) if not line.startswith("#")]
    assert sorted(without_worker(line) for line in shown if not line.startswith("#")) == sorted(values)
    assert [line for line in shown if line.startswith("#")] == [
        line for line in own(worker.text()) if line.startswith("#")
    ]
    assert all('worker="3"' in line for line in shown if not line.startswith("#"))
    assert [(one["event"], one["worker"]) for one in logs] == [("metrics_unreadable", one) for one in (4, 5)]
