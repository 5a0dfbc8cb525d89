"""The state of the bridge as `diagnostic_msgs/DiagnosticArray`, which `rqt_robot_monitor` and Foxglove show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from optipmb_schemas.ros2.types import Types

    from optipmb_service.ros2.bridge import Counts

__all__ = ["DIAGNOSTICS", "diagnostics"]

DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = range(4)


def diagnostics(
    types: Types,
    stamp_ns: int,
    instance: str,
    counts: Mapping[str, Counts],
    mismatches: Iterable[str],
    *,
    new_problems: Mapping[str, int],
    now_s: float,
    stale_s: float,
) -> Any:
    """Return the state of all streams and of the graph.

    Args:
        types: makes the messages.
        stamp_ns: ns since 1970.
        instance: name of this process.
        counts: what became of the messages, by stream.
        mismatches: endpoints that do not fit.
        new_problems: problems since the last time, by stream.
        now_s: clock of the counts.
        stale_s: a stream without detections for so long is stale.
    """
    statuses = []
    for stream, one in counts.items():
        level, text = OK, "tracking"
        if one.newest_s is None or now_s - one.newest_s > stale_s:
            level, text = STALE, "no detections"
        elif new_problems.get(stream):
            level, text = WARN, "; ".join(filter(None, (one.problem, one.service_problem)))
        elif not one.tracks:
            level, text = WARN, "no tracks come back: is optipmb-service running, with the same prefix?"
        values = {
            "detections": one.detections,
            "points": one.points,
            "refused": one.refused,
            "tracks": one.tracks,
            "latency_ms": f"{one.latency_ms:.1f}",
            "problems": one.problems,
            "last_problem": one.problem,
            "last_service_problem": one.service_problem,
        }
        statuses.append(_status(types, level, f"optipmb: {stream}", text, instance, values))
    wrong = tuple(mismatches)
    text = wrong[0] if wrong else "all endpoints fit"
    level = ERROR if wrong else OK
    values = {f"mismatch_{number}": line for number, line in enumerate(wrong)}
    statuses.append(_status(types, level, "optipmb: topics", text, instance, values))
    stamp = types.new("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types.new("std_msgs/msg/Header", stamp=stamp, frame_id="")
    return types.new(DIAGNOSTICS, header=header, status=statuses)


def _status(types: Types, level: int, name: str, text: str, instance: str, values: Mapping[str, object]) -> Any:
    pairs = [types.new("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()]
    return types.new(
        "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=text, hardware_id=instance, values=pairs
    )
