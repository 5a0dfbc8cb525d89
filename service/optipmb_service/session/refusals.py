"""What a session has to say about frames that it does not take, as the messages that are published for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb_service.session.problems import problem_of
from optipmb_service.session.timeline import JUMP_FRAMES
from optipmb_service.session.values import MAX_SENSORS, SECOND

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    import optipmb
    from optipmb_service.session.state import Entry
    from optipmb_service.session.timeline import FrameId
    from optipmb_service.session.values import Begun, Policy


class Refusals:
    """Makes the problems of one session, on the stream of the sensor that is concerned.

    Args:
        stream: `site/node/sensor`; that of the tracks, where several sensors feed the session.
        instance: name of the service.
    """

    def __init__(self, stream: str, instance: str) -> None:
        self._stream = stream
        self._instance = instance

    def invalid(self, frame_id: FrameId, error: optipmb.OptipmbError) -> schemas.Problem:
        """A value that the tracker does not take."""
        return self._problem("invalid_value", frame_id, error.path, error.expected, error.received)

    def late(self, frame_id: FrameId, jump_ns: int) -> schemas.Problem:
        """A frame that can no longer be put in its place."""
        return self._problem("late", frame_id, "stamp_ns", "a frame inside the window", f"{jump_ns / SECOND:+.3f} s")

    def clock(self, frame_id: FrameId, found: str) -> schemas.Problem:
        """Stamps that do not advance as time does."""
        return self._problem("clock", frame_id, "stamp_ns", "stamps in nanoseconds that advance with time", found)

    def reused(self, frame_id: FrameId, jump_ns: int) -> schemas.Problem:
        """A frame with the number of another one."""
        expected = "a number that no other frame of the epoch has, or a new epoch"
        received = f"{frame_id.seq} again, in another frame, {jump_ns / SECOND:+.3f} s from the newest"
        return self._problem("duplicate_seq", frame_id, "seq", expected, received)

    def retired(self, frame_id: FrameId, gap_limit_ns: int) -> schemas.Problem:
        """A publisher that was succeeded and still sends."""
        silent = f"when the other has been silent for {gap_limit_ns / SECOND:g} s"
        expected = f"the publisher that began last; stop one of the two, this one is tracked again {silent}"
        return self._problem("duplicate_epoch", frame_id, "epoch", expected, frame_id.epoch.hex())

    def astray(self, entry: Entry, policy: Policy) -> schemas.Problem:
        """A pose where the sensor cannot be."""
        pose = entry.message.pose
        received = "nothing" if pose is None else ", ".join(f"{value:.1f}" for value in pose.translation)
        expected = f"a position within reach of the last one at {policy.max_speed:g} m/s"
        return self._problem("astray", entry.frame_id, "pose.translation", expected, received)

    def unconfirmed(self, entry: Entry) -> schemas.Problem:
        """A stamp far from the others."""
        received = f"{entry.place.jump_ns / SECOND:+.3f} s"
        expected = f"a stamp near the one before, or {JUMP_FRAMES} frames in a row that agree on the jump"
        return self._problem("time_jump", entry.frame_id, "stamp_ns", expected, received)

    def other_clock(self, frame_id: FrameId, jump_ns: int) -> schemas.Problem:
        """A stamp far from those of the other sensors of the session."""
        expected = "a stamp near those of the session's other sensors, or all of them on another clock"
        return self._problem("time_jump", frame_id, "stamp_ns", expected, f"{jump_ns / SECOND:+.3f} s")

    def restarted(self, entry: Entry, begun: Begun) -> schemas.Problem:
        """A session that began anew: all its tracks have ended."""
        received = f"{begun.reason}, {begun.jump_ns / SECOND:+.3f} s"
        return self._problem("restarted", entry.frame_id, "", "a stream that goes on", received)

    def effort(self, frame_id: FrameId, error: optipmb.EffortError) -> schemas.Problem:
        """A frame that needs too much computing."""
        return self._problem("overload", frame_id, error.path, error.expected, error.received)

    def too_slow(self, first: FrameId, count: int, most_ns: int) -> schemas.Problem:
        """Frames from one on for which there was no time when all had to be processed at once."""
        expected = f"at most {most_ns / SECOND:g} s for all frames that waited"
        return self._problem("overload", first, "", expected, "more").model_copy(update={"count": count})

    def too_many(self, frame_id: FrameId) -> schemas.Problem:
        """A sensor too many for the session."""
        return self._problem("refused", frame_id, "stream", f"at most {MAX_SENSORS} sensors in a session", "another")

    def failed(self, frame_id: FrameId, error: str) -> schemas.Problem:
        """A step that raised."""
        return self._problem("internal", frame_id, "", "a step of the tracker without an error", error)

    def quarantined(self, frame_id: FrameId, error: str) -> schemas.Problem:
        """A frame of a session that takes none."""
        expected = "a reset or a restarted publisher: the session is quarantined"
        return self._problem("quarantined", frame_id, "", expected, error)

    def unknown(
        self, frame_id: FrameId, found: dict[str, int], parameters: optipmb.Parameters
    ) -> list[schemas.Problem]:
        """Classes that the profile lacks, with the number of objects of each."""
        if not found:
            return []
        expected = f"one of {', '.join(parameters.classes)} (profile {parameters.name})"
        return [
            self._problem("unknown_class", frame_id, "labels", expected, repr(label)).model_copy(
                update={"count": count}
            )
            for label, count in found.items()
        ]

    def _problem(self, code: str, frame_id: FrameId, path: str, expected: str, received: str) -> schemas.Problem:
        return problem_of(
            code,
            stream=frame_id.sensor or self._stream,
            instance=self._instance,
            path=path,
            expected=expected,
            received=received,
            message=f"Frame {frame_id.seq}: {path or 'tracker'}: expected {expected}, received {received}.",
            seq=frame_id.seq,
            stamp_ns=frame_id.stamp_ns,
        )
