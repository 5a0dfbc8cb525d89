"""What a session gives that is alone in its process: the bytes that every service is to give."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb_service.stream.session import Session
from optipmb_service.stream.values import Tracked
from router import plain

import optipmb

if TYPE_CHECKING:
    from router import Sensor


def tracked_alone(sensor: Sensor, frames: int) -> list[bytes]:
    """What a session alone makes of the frames."""
    session = Session(sensor.stream, optipmb.load_profile("generic"))
    outputs = [output for seq in range(frames) for output in session.on_detections(sensor.detections(seq), 0)]
    return [plain(output.tracks) for output in outputs if isinstance(output, Tracked)]
