"""Problems of the frames of a session: their fields and texts. Nothing is counted or decided here."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.session.problems import problem_of, sentence
from optipmb_service.session.timeline import JUMP_FRAMES, Verdict
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    import numpy as np
    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.session.outputs import Begun
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.timeline import Decision, FrameId
    from optipmb_service.session.transition import Outcome


class FrameProblems:
    """Makes problems of frames, each on the stream of its sensor.

    Args:
        stream: of the session.
        instance: name of the service.
        policy: limits that the texts name.
    """

    def __init__(self, stream: str, instance: str, policy: Policy) -> None:
        self._stream = stream
        self._instance = instance
        self._policy = policy

    def of(
        self, code: str, frame_id: FrameId, path: str, expected: str, received: str, count: int = 1, **message: str
    ) -> schemas.Problem:
        """Return a problem of a frame."""
        texts = {"path": path, "expected": expected, "received": received} | message
        frame = {"seq": frame_id.seq, "stamp_ns": frame_id.stamp_ns, "count": count}
        stream, subject = frame_id.sensor or self._stream, f"Frame {frame_id.seq}"
        return problem_of(code, stream=stream, instance=self._instance, subject=subject, **texts, **frame)

    def jumped(self, code: str, frame_id: FrameId, expected: str, jump_ns: int, reason: str = "") -> schemas.Problem:
        """Return a problem of a frame that is so far from the newest one, for a restart with its reason."""
        apart = _seconds(jump_ns)
        message = sentence(reason or code, f"Frame {frame_id.seq}", jump_ns, expected)
        path, received = ("", f"{reason}, {apart}") if reason else ("stamp_ns", apart)
        return self.of(code, frame_id, path, expected, received, message=message)

    def invalid(self, frame_id: FrameId, error: optipmb.FrameError) -> schemas.Problem:
        """Return the problem of a frame or cloud with a wrong value."""
        return self.of("invalid_value", frame_id, error.path, error.expected, error.received)

    def no_pose(self, frame_id: FrameId, motion: np.ndarray) -> schemas.Problem:
        """Return the problem of a sensor without poses that moves, by (3,) its estimated velocity."""
        x, y, _ = motion.tolist()
        received = f"none, and what stands moves by {math.hypot(x, y):.1f} m/s: the motion is estimated"
        return self.of("no_pose", frame_id, "pose", "the pose of a sensor that moves", received)

    def restarted(self, frame_id: FrameId, begun: Begun) -> schemas.Problem:
        """Return the problem of a frame that started a session id."""
        return self.jumped("restarted", frame_id, "frames that continue the stream", begun.jump_ns, begun.reason)

    def refused(self, frame_id: FrameId, decision: Decision) -> schemas.Problem:
        """Return the problem of a frame that has no place."""
        if decision.verdict is Verdict.RETIRED:
            silent = f"when the other has been silent for {self._policy.gap_limit_ns / SECOND:g} s"
            expected = f"the publisher that began last; stop one of the two, this one is tracked again {silent}"
            return self.of("duplicate_epoch", frame_id, "epoch", expected, frame_id.epoch.hex())
        if decision.verdict is Verdict.JUMPED:
            expected = "a stamp near those of the session's other sensors, or most of them on another clock"
            return self.jumped("time_jump", frame_id, expected, decision.place.jump_ns)
        return self.jumped("late", frame_id, "a frame inside the window", decision.place.jump_ns)

    def reused_number(self, frame_id: FrameId, jump_ns: int) -> schemas.Problem:
        """Return the problem of a frame with the number of another one."""
        expected = "a number that no other frame of the epoch has, or a new epoch"
        received = f"{frame_id.seq} again, in another frame, {_seconds(jump_ns)} from the newest"
        return self.of("duplicate_seq", frame_id, "seq", expected, received)

    def too_many_sensors(self, frame_id: FrameId) -> schemas.Problem:
        return self.of("refused", frame_id, "stream", f"at most {MAX_SENSORS} sensors in a session", "another")

    def left_out(self, outcome: Outcome, parameters: optipmb.Parameters) -> list[schemas.Problem]:
        """Return the problems of objects of unknown classes, and of a frame that was refused when its turn came."""
        frame_id, place = outcome.frame.frame_id, outcome.frame.place
        expected = f"one of {', '.join(parameters.classes)} (profile {parameters.name})"
        problems = [
            self.of("unknown_class", frame_id, "labels", expected, repr(label), count)
            for label, count in (outcome.unknown or {}).items()
        ]
        if (fault := outcome.fault) is not None:
            problems.append(self.invalid(frame_id, fault))
        if outcome.tracks is not None or fault is not None:
            return problems
        if place.opens is Verdict.UNCONFIRMED:
            expected = f"a stamp near the one before, or {JUMP_FRAMES} frames in a row that agree on the jump"
            return [self.jumped("time_jump", frame_id, expected, place.jump_ns)]
        if (effort := outcome.effort) is not None:
            return [self.of("overload", frame_id, effort.path, effort.expected, effort.received)]
        pose = outcome.frame.message.pose
        received = "nothing" if pose is None else ", ".join(f"{value:.1f}" for value in pose.translation)
        expected = f"a position within reach of the last one at {self._policy.max_speed:g} m/s"
        return [self.of("astray", frame_id, "pose.translation", expected, received)]


def _seconds(jump_ns: int) -> str:
    return f"{jump_ns / SECOND:+.3f} s"
