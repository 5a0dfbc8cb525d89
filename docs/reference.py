"""The tables of `docs/reference.md`, made from the code that they describe.

python docs/reference.py docs/reference.md            write them
python docs/reference.py --check docs/reference.md    status 1 when they are not current
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args, get_origin

from optipmb_service.session.problems import CODES
from optipmb_service.settings import (
    CpmSensor,
    CpmSettings,
    FusedSettings,
    InputSettings,
    LimitSettings,
    LinkFrame,
    LinkPassage,
    LinkRegion,
    LinkSettings,
    MappingSettings,
    MqttInput,
    MqttSettings,
    OutputSettings,
    PassageSettings,
    RejoinSettings,
    Ros2Settings,
    Ros2Stream,
    SensorSettings,
    Settings,
    SiteSettings,
    ZoneSettings,
)
from optipmb_service.telemetry.logs import EVENTS
from optipmb_service.telemetry.metrics import METRICS, NAMESPACE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

MOST_ALLOWED: Final = 60
"""Characters of allowed values beyond which they are in the column of the meaning, which is wider."""

TASKS: Final = (
    ("port, address, network interface, IP", "`listen`, `connect`, `http`, `grpc`, `router`"),
    ("TLS, certificates", "`zenoh_config`, `grpc_tls`, `http_tls`, `cluster_tls`"),
    ("password, token, user", "`grpc_names`, `grpc_tokens`, `http_tokens`, `cluster_credentials`"),
    ("detector, KITTI, nuScenes, classes, score threshold", "`profile`, `profiles`; see [Tuning](tuning.md)"),
    (
        "latency, delay, waiting for LiDAR clouds",
        "`cloud_wait_s`, `cloud_memory_s`, `has_points` in [Messages](messages.md#detections)",
    ),
    ("late frames, out of order, clock jumps, timestamps", "`rewind_s`, `gap_limit_s`, `late_clouds`, `stale_s`"),
    ("several sensors, fusion", "`fuse`, `fused`, `sensors`; see [Several sensors](fusion.md)"),
    ("RAM, memory limit, out of memory", "`memory_mb`, `stream_mb`, `standby_mb`, `queue_frames`, `queue_clouds`"),
    ("CPU, cores, processes, overload", "`workers`, `max_pairs`, `step_limit_s`, `stuck_s`"),
    (
        "quotas, rate limit, number of streams",
        "`max_sessions`, `node_sessions`, `node_rate`, `node_mb_s`, `site_sessions`, `site_rate`, `site_mb_s`",
    ),
    ("sessions that nobody uses", "`idle_s`, `keep_days`"),
    ("message too large, maximum size", "`limits.max_bytes`, `limits.max_points`, `limits.max_detections`"),
    (
        "save state, disk, checkpoint, crash, restart",
        "`store`, `checkpoint_s`, `keep_days`, `recovery_wait_s`, `restart_keys`",
    ),
    (
        "high availability, failover, cluster, NATS",
        "`cluster`, `lease_s`, `standby_s`, `log_s`, `log_tracks_s`, `log_mb`, `log_tracks_mb`",
    ),
    ("shutdown, Docker stop, Kubernetes", "`grace_s`, `http` (`/healthz`, `/readyz`)"),
    ("log level, JSON logs", "`log_level`, `log_format`"),
    ("Prometheus, Grafana, monitoring", "`http`, `http_streams`"),
    ("OpenTelemetry, Jaeger, tracing, spans", "`traces`; see [Traces](operation.md#traces)"),
    ("ROS, ROS 2, topics, tf", "`ros2`; see [ROS 2](ros2.md)"),
    ("name of the service, several services on one network", "`instance`, `prefix`"),
    (
        "browser, web page, JSON, WebSocket, readers",
        "`http`, `http_hosts`, `http_origins`, `http_clients`; see [JSON](json.md)",
    ),
    (
        "curl, POST, sensors without a client",
        "`http_senders`, `sender_idle_s`, `inputs`; see [JSON](json.md#send-detections)",
    ),
    ("gRPC clients", "`grpc`, `grpc_calls`, `grpc_connections`; see [gRPC](grpc.md)"),
    ("MQTT broker", "`mqtt`; see [MQTT](json.md#mqtt)"),
    ("C-ITS, V2X, CPM", "`cpm`; see [Standards](standards.md#collective-perception-messages)"),
    ("zones, lines, counting, alarms", "`zones`; see [Zones](zones.md)"),
    ("latitude, longitude, map", "`sites`; see [Latitude and longitude](operation.md#latitude-and-longitude)"),
    ("output at a fixed rate, prediction to now", "`outputs`; see [Fixed rate](fixed-rate.md)"),
    ("the same object after a gap", "`rejoin`; see [Gaps](gaps.md)"),
    ("localisation, poses, jumps of the pose", "`max_speed`, `jumps`"),
    ("one id for one object over streams and sites", "`links`; see [Links](links.md)"),
    ("clouds on one host", "`shared_memory`"),
)
"""Settings by what somebody looks for; each setting is in one row at least."""

SETTINGS: Final = {
    "Name and network": "instance",
    "Tracking": "profile",
    "Time": "cloud_wait_s",
    "Load and quotas": "queue_frames",
    "State and other instances": "keep_days",
    "Health and end": "stale_s",
    "HTTP and gRPC": "http",
    "Logs and traces": "log_format",
}
EVENTS_OF: Final = {
    "Start and network": "log_lines_dropped",
    "Sessions and their state": "leases_gone",
    "Leases, links and the message log": "partitions_held",
    "Streams, traces and bridges": "traces_lost",
    "Workers": "worker_started",
    "End": "stop_asked",
}
METRICS_OF: Final = {
    "Process and network": "info",
    "Frames and problems": "log_lines_dropped_total",
    "Sessions and streams": "sessions",
    "gRPC": "grpc_open_calls",
    "Senders of JSON": "inputs_frames_total",
    "Links": "links_messages_total",
    "Message log, MQTT and certificates": "message_log_written_total",
}
"""Sections of the long tables, each by its first row."""

_TABLE: Final = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """Return a page with its tables made anew."""
    tables = {
        "tasks": tasks(),
        "settings": settings(),
        "problems": problems(),
        "events": events(),
        "metrics": metrics(),
    }
    return _TABLE.sub(lambda match: f"{match[1]}{tables[match[2]]}{match[3]}", text)


def tasks() -> str:
    """Return the table of settings by task.

    Raises:
        ValueError: a setting is in no row, or a row has another name.
    """
    named = {name.partition(".")[0] for _, text in TASKS for name in re.findall(r"`([a-z0-9_.]+)`", text)}
    wrong = named - {"has_points"} ^ Settings.model_fields.keys()
    if wrong:
        raise ValueError(f"rows of tasks and settings differ: {', '.join(sorted(wrong))}")
    return _table(("task", "settings"), TASKS)


def settings() -> str:
    """Return the table of all settings."""
    tables: tuple[tuple[str, type[BaseModel]], ...] = (
        *(("", Settings), ("limits.", LimitSettings), ("sites.NAME.", SiteSettings)),
        *(("fused.NAME.", FusedSettings), ("sensors.PATTERN.", SensorSettings)),
        *(("zones.NAME.", ZoneSettings), ("outputs.PATTERN.", OutputSettings), ("rejoin.PATTERN.", RejoinSettings)),
        ("rejoin.PATTERN.passages.", PassageSettings),
        *(("links.AREA.", LinkSettings), ("links.AREA.frames.SITE.", LinkFrame)),
        *(("links.AREA.passages.", LinkPassage), ("links.AREA.exits.", LinkRegion)),
        *(("cpm.PATTERN.", CpmSettings), ("cpm.PATTERN.sensors.", CpmSensor)),
        *(("ros2.", Ros2Settings), ("ros2.streams.NAME.", Ros2Stream), ("mqtt.", MqttSettings)),
        *(("inputs.PATTERN.", InputSettings), ("mqtt.inputs.STREAM.", MqttInput)),
        ("inputs.PATTERN.mapping.", MappingSettings),
    )
    rows = {}
    for prefix, table in tables:
        meanings = docstrings(table)
        rows |= {
            f"{prefix}{name}": _setting(f"{prefix}{field.alias or name}", field, meanings[name])
            for name, field in table.model_fields.items()
            if f"{prefix}{name}" not in {"limits", "mqtt", "ros2"}
        }
    nested = {prefix.strip("."): f"{prefix}{next(iter(table.model_fields))}" for prefix, table in tables if prefix}
    return _sections(SETTINGS | nested, ("setting", "default; allowed", "meaning"), rows)


def docstrings(table: type) -> dict[str, str]:
    """Return the docstrings of the attributes of a class, each as one line."""
    body = next(one.body for one in ast.parse(inspect.getsource(table)).body if isinstance(one, ast.ClassDef))
    return {
        field.target.id: " ".join(doc.value.value.split())
        for field, doc in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(doc, ast.Expr)
        and isinstance(doc.value, ast.Constant)
        and isinstance(doc.value.value, str)
    }


def problems() -> str:
    """Return the table of the codes of problems."""
    return _table(("code", "meaning", "what to do"), [(f"`{code}`", *texts) for code, texts in CODES.items()])


def events() -> str:
    """Return the table of the log events."""
    rows = {event: (f"`{event}`", text) for event, text in EVENTS.items()}
    return _sections(EVENTS_OF, ("event", "meaning"), rows)


def metrics() -> str:
    """Return the table of the metrics."""
    rows = {
        name: (f"`{NAMESPACE}{name}{'{' + ','.join(metric.labels) + '}' if metric.labels else ''}`", metric.meaning)
        for name, metric in METRICS.items()
    }
    return _sections(METRICS_OF, ("metric", "meaning"), rows)


def _setting(name: str, field: FieldInfo, meaning: str) -> tuple[str, str, str]:
    default = field.get_default(call_default_factory=False) if field.default_factory is None else None
    shown = "required" if field.is_required() else "" if default in (None, (), "") else f"`{_plain(default)}`"
    bounds = {
        kind: value
        for rule in field.metadata
        for kind in ("ge", "gt", "le")
        if (value := getattr(rule, kind, None)) is not None
    }
    allowed = _interval(bounds)
    if get_origin(field.annotation) is Literal:
        allowed = ", ".join(f"`{choice}`" for choice in get_args(field.annotation) if choice != default)
    if len(allowed) > MOST_ALLOWED:
        return f"`{name}`", shown, f"{meaning}: {allowed}"
    return f"`{name}`", "; ".join(filter(None, (shown, allowed))), meaning


def _interval(bounds: dict[str, Any]) -> str:
    low = f"[{_plain(bounds['ge'])}" if "ge" in bounds else f"({_plain(bounds['gt'])}" if "gt" in bounds else ""
    if "le" in bounds:
        return f"{low}, {_plain(bounds['le'])}]"
    return low.replace("[", "≥ ").replace("(", "> ")


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _sections(first: Mapping[str, str], head: Sequence[str], rows: Mapping[str, Sequence[str]]) -> str:
    """Return a table in sections, each from its first row on.

    Raises:
        ValueError: a first row does not exist, or is not in the order of the rows.
    """
    order = list(rows)
    places = [order.index(name) for name in first.values()]
    if places != sorted({0, *places}):
        raise ValueError(f"sections are not in the order of the rows: {', '.join(first)}")
    parts = zip(first, pairwise([*places, len(order)]), strict=True)
    return "\n".join(
        f"### {title}\n\n{_table(head, [rows[name] for name in order[low:high]])}" for title, (low, high) in parts
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def main(arguments: Sequence[str]) -> int:
    """Write or check the page; returns the exit status."""
    check = "--check" in arguments
    (file,) = (Path(argument) for argument in arguments if argument != "--check")
    old = file.read_text(encoding="utf-8")
    new = page(old)
    if not check:
        file.write_text(new, encoding="utf-8")
    elif new != old:
        print(f"{file} is not current: python docs/reference.py {file}", file=sys.stderr)  # noqa: T201 - a command
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
