"""Clocks and identities of publishers over real Zenoh: what is wrong with them is said, and nothing is lost by it."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from optipmb_schemas import Keys, Problem, SessionState, decode
from router import DEADLINE_S, SECOND, Node, Sensor, plain

if TYPE_CHECKING:
    from collections.abc import Iterable

KEYS = Keys()
SENSOR = Sensor()


def said(node: Node, code: str, stream: str = SENSOR.stream) -> list[Problem]:
    """The problems of a kind that came so far."""
    key = KEYS.problems(stream)
    found = [decode(payload, Problem) for at, payload, _ in node.problems_seen.items if at == key]
    return [one for one in found if one.code == code]


def state(node: Node) -> SessionState:
    """The state of the sensor's session."""
    return node.ask(KEYS.query(SENSOR.stream, "state"), SessionState)


def send(node: Node, stamps: Iterable[int], sensor: Sensor = SENSOR, first: int = 0) -> None:
    """Publish frames with these stamps; the objects move as if nothing was wrong with them."""
    for seq, stamp_ns in enumerate(stamps, first):
        node.send(sensor.detections(seq, stamp_ns=stamp_ns))


@pytest.mark.parametrize("stamp_ns", [0, 1_700_000_000 * SECOND])
def test_a_clock_that_stands_still_is_reported(node: Node, stamp_ns: int) -> None:
    """Twenty frames with one stamp are a problem of their stream, and are tracked nevertheless."""
    send(node, [stamp_ns] * 20)
    problem = node.problem(SENSOR.stream, "clock")
    assert f"20 frames with the stamp {stamp_ns}: the clock does not advance" in problem.message
    assert problem.path == "stamp_ns"
    assert len(node.tracks(SENSOR.stream, 20)) == 20


@pytest.mark.parametrize(("unit", "per_second"), [("milliseconds", 10**3), ("microseconds", 10**6)])
def test_stamps_in_another_unit_are_reported(node: Node, unit: str, per_second: int) -> None:
    """Stamps that advance by thousands for a second that passes are called by their unit."""
    seq, ends = 0, time.monotonic() + DEADLINE_S
    while not said(node, "clock") and time.monotonic() < ends:
        node.send(SENSOR.detections(seq, stamp_ns=time.time_ns() * per_second // SECOND))
        seq += 1
        time.sleep(0.02)  # the stamps are those of the true time
    assert {one.received.rpartition(": ")[2] for one in said(node, "clock")} == {f"stamps look like {unit}"}


@pytest.mark.parametrize("rate_hz", [0.25, 10, 200])
def test_a_recording_at_any_speed_is_not_reported(node: Node, rate_hz: float) -> None:
    """Stamps in nanoseconds that come as fast as they can be sent are no problem, however far apart they are."""
    send(node, (round(SECOND * (1000 + seq / rate_hz)) for seq in range(60)))
    node.tracks(SENSOR.stream, 60)
    assert said(node, "clock") == []
