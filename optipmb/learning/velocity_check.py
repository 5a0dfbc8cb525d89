"""Comparison of the velocities of a sensor's detections with the motion of their boxes; no track depends on it.

Velocities along other axes, in another unit or relative to a sensor that moves pass every check of a single frame, and
break tracks. So nothing here asks the tracks: a second later, a box is either near the place to which its velocity
takes it, or it is elsewhere within reach.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from optipmb.model.frame import Frame
    from optipmb.model.rows import Array

EXPECTED: Final = "metres per second over ground along the axes of the boxes, not relative to the sensor"
APART_NS: Final = 900_000_000, 2_000_000_000
"""Time between two frames that are compared, least and most."""
LEAST_M: Final = 5.0
"""Way by a velocity from which it is compared: shorter ones are within the errors of boxes and velocities."""
REST_NS: Final = 60_000_000_000
"""Time after which velocities that were right are compared again."""
BOXES: Final = 32
"""Most velocities of a frame that are compared; bounds the work."""
COMPARED: Final = 30
"""Velocities after which they are judged, if they are of `FRAMES`."""
FRAMES: Final = 5
MOST: Final = 0.5
"""Share of contradictions that is reported: true velocities with errors of 1 m/s along each axis stay below .4."""


class VelocityCheck:
    """Check of the velocities of one sensor.

    Attributes:
        contradiction: the share of velocities that contradict their boxes, in words; empty until most do.
    """

    def __init__(self) -> None:
        self.contradiction = ""
        self._stamp_ns = self._next_ns = -1
        self._then: tuple[Array, Array] = np.empty((0, 2)), np.empty((0, 2))
        """Places and velocities (K, 2) of the detections of the frame with this stamp that move."""
        self._sums = np.zeros(4)
        """Compared frames, compared velocities, contradicting velocities, and the sum of their speeds, m/s."""

    def add(self, frame: Frame, *, estimated: bool) -> bool:
        """Compare the velocities of a frame, about once a second; return whether a contradiction has been found now.

        Args:
            frame: detections.
            estimated: whether the motion of the sensor is, so that places move with it: nothing is compared then.
        """
        stamp_ns = frame.stamp_ns
        if self.contradiction or self._stamp_ns <= stamp_ns < self._next_ns:
            return False
        elapsed_ns, (before, velocity) = stamp_ns - self._stamp_ns, self._then
        (x, y), (vx, vy) = frame.center[:, :2].T, frame.velocity.T
        moving = np.flatnonzero((vx * vx + vy * vy) * (APART_NS[1] * 1e-9) ** 2 > LEAST_M**2)[:BOXES]
        self._stamp_ns, self._next_ns = stamp_ns, stamp_ns + APART_NS[0]
        self._then = frame.center[moving, :2], frame.velocity[moving]
        if estimated:
            self._sums[:] = 0.0
            return False
        if not 0 < elapsed_ns <= APART_NS[1] or not len(before) or not len(x):
            return False
        way = velocity * (elapsed_ns * 1e-9)
        stayed, went = (((one[:, :1] - x) ** 2 + (one[:, 1:] - y) ** 2).min(axis=1) for one in (before, before + way))
        length = (way**2).sum(axis=1)
        follows = (went < 0.25 * length) & (went <= stayed)
        told = (length > LEAST_M**2) & (follows | (stayed < 1.2 * length))
        against = told & ~follows
        speeds = np.hypot(*velocity[against].T)
        self._sums += np.array([1.0, np.count_nonzero(told), len(speeds), speeds.sum()])
        return bool(self._sums[0] >= FRAMES and self._sums[1] >= COMPARED) and self._judged()

    def _judged(self) -> bool:
        """Judge the velocities so far, and restart the counts, after a rest where they are right."""
        _, compared, against, speeds = self._sums.tolist()
        self._sums[:] = 0.0
        if against < MOST * compared:
            self._next_ns = self._stamp_ns + REST_NS
            return False
        boxes = f"that boxes do not follow in the next second: {speeds / against:.1f} m/s on average"
        self.contradiction = f"{against:.0f} of {compared:.0f} {boxes}"
        return True
