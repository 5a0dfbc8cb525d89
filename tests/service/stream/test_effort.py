"""Frames that need too much computing: refused as a function of the frames, and never for ever."""

from functools import partial

import numpy as np
from optipmb_service.session.session import Session
from router import Sensor
from sessions import begun, feed, problems, tracks

import optipmb

SENSOR = Sensor(objects=40)
TRACKER = partial(optipmb.Tracker, max_pairs=500)


def test_a_density_that_is_too_much_for_every_frame_is_given_up() -> None:
    """Frames that pass alone, and with the density do not, are refused for a second; then a new life begins."""
    one = Session(SENSOR.stream, optipmb.load_profile("nuscenes"), tracker=TRACKER)
    close = {"center": np.c_[np.linspace(0, 1, 20), np.zeros(20), np.ones(20)], "size": np.full((20, 3), 0.01)}
    assert len(tracks(feed(one, range(1), SENSOR, objects=20, **close))) == 1
    refused = feed(one, range(1, 11), SENSOR, objects=20, **close)
    assert [problem.code for problem in problems(refused)].count("overload") == 10
    outputs = feed(one, range(11, 13), SENSOR, objects=20, **close)
    assert begun(outputs)[:1] == ["effort"]
    assert one.counters.refused >= 10
    assert feed(one, range(13, 14), SENSOR, objects=3)
