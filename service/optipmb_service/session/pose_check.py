"""Whether a sensor can be where a frame says it is.

A pose that jumps by a hundred metres (a lost localisation, poses of another vehicle) would leave every track behind and
give birth to as many. Such a frame is refused. When several frames in a row agree with each other about the new place,
the sensor is there, whatever brought it: the next of them begins a new life of the session.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from optipmb_service.session.state import PoseHistory

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.session.values import Policy

Position = tuple[float, float, float]


def judge(
    before: PoseHistory, message: schemas.Detections, policy: Policy
) -> tuple[PoseHistory, Literal["near", "astray", "moved"]]:
    """Decide on the pose of a frame.

    Args:
        before: what is known from the frames before it.
        message: the frame.
        policy: what a sensor can do.

    Returns:
        What is known with this frame, and whether the sensor is near where it was, astray (the frame is to be refused),
        or taken to have moved.
    """
    if message.pose is None or policy.max_speed <= 0:
        return before, "near"
    x, y, z = message.pose.translation.tolist()
    position, stamp_ns = (x, y, z), message.stamp_ns
    there = PoseHistory(stamp_ns, position)
    if before.stamp_ns is None or _near(before.stamp_ns, before.position, stamp_ns, position, policy):
        return there, "near"
    agrees = before.astray > 0 and _near(before.astray_ns, before.astray_position, stamp_ns, position, policy)
    astray = before.astray + 1 if agrees else 1
    if astray >= policy.astray_frames:
        return there, "moved"
    return replace(before, astray=astray, astray_ns=stamp_ns, astray_position=position), "astray"


def _near(stamp_ns: int, position: Position, then_ns: int, then: Position, policy: Policy) -> bool:
    reach = policy.pose_margin + policy.max_speed * abs(then_ns - stamp_ns) * 1e-9
    return math.dist(position, then) <= reach
