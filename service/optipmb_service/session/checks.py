"""Checks that report doubtful messages of a session, and change nothing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

import optipmb
from optipmb.learning.doubts import EXPECTED as SIZES
from optipmb.learning.doubts import SizeCheck
from optipmb.learning.velocity_check import EXPECTED, VelocityCheck
from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.session.policy import Policy
    from optipmb_service.session.timeline import FrameId

CHECKED_FRAMES: Final = 20
"""Frames after which the advance of their stamps is looked at."""

SHORTEST_STEP_NS: Final = SECOND // 1000
"""Frames that are further apart by their stamps have a clock in nanoseconds."""

SHORTEST_ARRIVAL_NS: Final = SECOND // 10
"""Frames that all came within less time are from a cache: their arrival tells nothing."""

UNITS: Final = {"microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}

STEADY: Final = (1.0, 5.0, math.radians(1.0), 0.5)
"""How far a pose may be from where the motion of a sensor leads: m, m/s^2, rad and rad/s^2."""

CERTAIN: Final = 3.0
"""Factor by which the ratio of arrival and stamps may differ from the ratio of a unit."""

SCORED: Final = 100
"""Detections of a class after which its share below the score filter is reported."""

SCORED_EVERY: Final = 8
"""Frames of which one is looked at for that: in each it would take a tenth of the session's time."""


class CheckFinding(NamedTuple):
    """Doubt about a frame; the fields of its problem."""

    code: str
    path: str
    expected: str
    received: str


class SensorChecks:
    """Checks of the frames of one sensor."""

    def __init__(self) -> None:
        self._stamps = StampCheck()
        self._poses = PoseCheck()
        self._is_blind = False
        self._is_ignored = False
        self._velocities = VelocityCheck()
        self._sizes = SizeCheck()

    def add(
        self, message: schemas.Detections, frame: optipmb.Frame, arrived_ns: int, policy: Policy, *, estimated: bool
    ) -> list[CheckFinding]:
        """Return problems of a frame that arrived (monotonic).

        Args:
            message: the frame.
            frame: its detections.
            arrived_ns: when it arrived.
            policy: what the session follows.
            estimated: whether the motion of the sensor is.
        """
        findings = []
        if found := self._stamps.add(message.stamp_ns, arrived_ns):
            findings.append(CheckFinding("clock", "stamp_ns", "stamps in nanoseconds that advance with time", found))
        if policy.jumps == "report" and (found := self._poses.add(message, policy)):
            expected = "a pose where the motion of the sensor leads, or a `relocation`"
            findings.append(CheckFinding("world_jump", "pose", expected, found))
        if policy.needs_view and message.field_of_view is None and not self._is_blind:
            self._is_blind = True
            findings.append(CheckFinding("no_view", "field_of_view", "where the sensor sees", "nothing"))
        compared = policy.rejoin.embedding_model if policy.rejoin is not None else None
        if compared is not None and message.embedding_model not in {None, compared} and not self._is_ignored:
            self._is_ignored = True
            found = f"{message.embedding_model!r}: the vectors are ignored"
            findings.append(CheckFinding("embedding", "embedding_model", f"{compared!r}, as of `rejoin`", found))
        if message.size is not None and self._sizes.add(frame):
            findings.append(CheckFinding("size", "size", SIZES, self._sizes.contradiction))
        if message.velocity is not None and self._velocities.add(frame, estimated=estimated):
            findings.append(CheckFinding("velocity", "velocity", EXPECTED, self._velocities.contradiction))
        return findings


class ScoreChecks:
    """Checks of the scores of a session: one for its profile, and one for each sensor with parameters of its own.

    Args:
        parameters: the profile of the session.
    """

    def __init__(self, parameters: optipmb.Parameters) -> None:
        self._parameters = parameters
        self._checks: dict[str, ScoreCheck] = {}
        """By sensor; the check of the profile has an empty name."""

    def add(self, frame_id: FrameId, frame: optipmb.Frame, parameters: optipmb.Parameters) -> list[CheckFinding]:
        """Return the classes that lose most of their detections, looking at one frame of some.

        Args:
            frame_id: identity of the frame.
            frame: its detections.
            parameters: of its sensor.
        """
        if frame_id.seq % SCORED_EVERY or parameters.self_calibration:  # which filters the lower half of none
            return []
        sensor = "" if parameters is self._parameters else frame_id.sensor
        if sensor not in self._checks:
            if len(self._checks) > MAX_SENSORS:
                self._checks.clear()
            self._checks[sensor] = ScoreCheck(parameters)
        return self._checks[sensor].add(frame)


class ScoreCheck:
    """Check that the score filter of a profile leaves most detections of each class.

    Args:
        parameters: the profile.
    """

    def __init__(self, parameters: optipmb.Parameters) -> None:
        self._parameters = parameters
        self._filters = np.array([one.score_filter for one in parameters.classes.values()])
        self._given = np.zeros(len(self._filters), np.int64)
        self._removed = np.zeros(len(self._filters), np.int64)

    def add(self, frame: optipmb.Frame) -> list[CheckFinding]:
        """Count the detections below the filter; return each class that loses most of them, once."""
        filters, size = self._filters, len(self._filters)
        self._given += np.bincount(frame.label, minlength=size)
        low = frame.score < filters[frame.label]
        if not low.any():
            return []
        self._removed += np.bincount(frame.label[low], minlength=size)
        findings = []
        for index in np.flatnonzero((self._given >= SCORED) & (2 * self._removed > self._given)).tolist():
            label = self._parameters.labels[index]
            received = f"{self._removed[index]} of {self._given[index]} below {filters[index]:g}"
            expected = f"most scores of {label} above the filter of the profile {self._parameters.name}"
            findings.append(CheckFinding("score_filter", f"{label}.score", expected, received))
            filters[index] = 0.0  # reported
        return findings


class StampCheck:
    """Check that the stamps of a sensor advance as a clock in nanoseconds does; it decides about nothing but a report.

    Frames of a detector are more than a millisecond apart. Stamps that advance by less are constant or have another
    unit, at any speed of a replayed recording; the times of arrival tell which unit, where the ratio is certain.
    """

    def __init__(self) -> None:
        self._count = 0
        self._first = 0, 0
        self._constant = True

    def add(self, stamp_ns: int, arrived_ns: int) -> str:
        """Return the fault of the stamps up to a frame; empty without one, or when too few came.

        Args:
            stamp_ns: stamp of the frame.
            arrived_ns: when it arrived, monotonic.
        """
        if not self._count:
            self._first, self._constant = (stamp_ns, arrived_ns), True
        self._count += 1
        first_ns, first_arrived_ns = self._first
        self._constant &= stamp_ns == first_ns
        if self._count < CHECKED_FRAMES:
            return ""
        self._count = 0
        if self._constant:
            return f"{CHECKED_FRAMES} frames with the stamp {stamp_ns}: the clock does not advance"
        advance_ns, took_ns = stamp_ns - first_ns, arrived_ns - first_arrived_ns
        if not 0 < advance_ns < (CHECKED_FRAMES - 1) * SHORTEST_STEP_NS or took_ns < SHORTEST_ARRIVAL_NS:
            return ""
        for unit, factor in UNITS.items():
            if 1 / CERTAIN < advance_ns * factor / took_ns < CERTAIN:
                return (
                    f"{CHECKED_FRAMES} frames in {took_ns / SECOND:.1f} s, {advance_ns} apart: stamps look like {unit}"
                )
        return ""


class PoseCheck:
    """Check that the poses of a sensor go on as it moves; it decides about nothing but a report.

    A sensor moves with the velocity and turn rate of its last two poses, and may change them within `STEADY`.
    """

    def __init__(self) -> None:
        self._world = self._astray = 0
        self._last: tuple[int, optipmb.Relocation] | None = None
        self._rate: optipmb.Relocation | None = None

    def add(self, message: schemas.Detections, policy: Policy) -> str:
        """Return the jump of the pose of a frame that was not announced; empty without one.

        Poses that the sensor cannot have reached are refused elsewhere.
        """
        if message.pose is None:
            return ""
        x, y, height = message.pose.translation.tolist()
        w, _, _, z = message.pose.quaternion.tolist()
        here = optipmb.Relocation(x, y, height, 2.0 * math.atan2(z, w))
        world = self._world if message.relocation is None else message.relocation.world
        if self._last is None or world != self._world or self._astray >= policy.astray_frames:
            self._world, self._astray, self._last, self._rate = world, 0, (message.stamp_ns, here), None
            return ""
        then_ns, there = self._last
        dt = (message.stamp_ns - then_ns) / SECOND
        if dt <= 0.0:
            return ""
        if policy.max_speed and math.dist(here[:3], there[:3]) > policy.pose_margin + policy.max_speed * dt:
            self._astray += 1
            return ""
        self._astray, self._last = 0, (message.stamp_ns, here)
        seen = _difference(here, there, 1.0 / dt)
        rate = self._rate or seen
        expected = optipmb.Relocation(*(one + dt * change for one, change in zip(there, rate, strict=True)))
        error = _difference(here, expected)
        distance, turn = math.hypot(*error[:3]), error.theta
        metres, acceleration, angle, angular_acceleration = STEADY
        if distance <= metres + acceleration * dt * dt and abs(turn) <= angle + angular_acceleration * dt * dt:
            self._rate = seen
            return ""
        # The sensor keeps its motion, which has turned with the world.
        motion = optipmb.Relocation(0.0, 0.0, 0.0, turn)
        self._rate = optipmb.Relocation(*motion.place(rate[:3]), rate.theta)
        shift = [f"{one - other:.3f}" for one, other in zip(here, motion.place(expected[:3]), strict=False)]
        jump = f"{distance:.2f} m and {math.degrees(turn):.2f} degrees"
        return f"a jump by {jump}, as of a motion by [{', '.join(shift)}] m and {turn:.5f} rad"


def _difference(one: optipmb.Relocation, other: optipmb.Relocation, factor: float = 1.0) -> optipmb.Relocation:
    x, y, z, theta = (factor * (a - b) for a, b in zip(one, other, strict=True))
    return optipmb.Relocation(x, y, z, factor * math.remainder(theta / factor, 2.0 * math.pi))
