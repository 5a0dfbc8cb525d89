"""What a session holds is free when it ends, and not when a garbage collection comes by."""

from __future__ import annotations

import gc
import weakref

from optipmb_service.session import Session
from router import Sensor

import optipmb

SENSOR = Sensor()


def test_a_session_is_freed_at_its_end() -> None:
    """Nothing inside a session points back at it: its clouds go with the last reference to it."""
    session = Session(SENSOR.stream, optipmb.load_profile("nuscenes"))
    for seq in range(5):
        session.on_points(SENSOR.points(seq), 0)
        assert session.on_detections(SENSOR.detections(seq, has_points=True), 0)
    session.reset()
    gone = weakref.ref(session)
    gc.disable()
    try:
        del session
        assert gone() is None
    finally:
        gc.enable()
