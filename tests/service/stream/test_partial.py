"""Sessions of detections without heading, size or height: tracks carry the known part."""

from typing import Any

import numpy as np
import optipmb_schemas as schemas
import pytest
from optipmb_service.session.checkpoint import decode_checkpoint, encode_checkpoint
from optipmb_service.session.session import Session
from router import Sensor
from sessions import Merged, feed, tracks

import optipmb

SENSOR = Sensor()
POINTS: dict[str, Any] = {"size": None, "yaw": None, "velocity": None}
PROFILES = ("nuscenes", "generic")


@pytest.mark.parametrize("profile", PROFILES)
def test_tracks_say_what_is_known(profile: str) -> None:
    """Nothing at the first point; after a few the heading; with a box everything, and then the field is absent."""
    one = Session(SENSOR.stream, optipmb.load_profile(profile))
    found = tracks(feed(one, range(12), SENSOR, **POINTS))
    first, last = found[1], found[-1]
    assert first.measured is not None
    assert first.measured.tolist() == [4] * len(first.id)
    assert last.measured is not None
    assert last.measured.tolist() == [5] * SENSOR.objects
    np.testing.assert_allclose(last.yaw, 0.0, atol=0.1)
    assert (last.size[:, 0] > last.size[:, 1]).all()
    whole = tracks(feed(one, [12], SENSOR))[0]
    assert whole.measured is None
    np.testing.assert_allclose(whole.size, [[4.5, 1.9, 1.6]] * SENSOR.objects)
    for message in found:
        payload = schemas.encode(message)
        assert schemas.decode(payload, schemas.Tracks) == message
        assert schemas.decode(schemas.encode_json(message), schemas.Tracks) == message


@pytest.mark.parametrize("profile", PROFILES)
def test_a_late_point_and_a_takeover_change_nothing(profile: str) -> None:
    """A frame that comes late, and a checkpoint between any two frames, end in the tracks of frames in order."""
    parameters = optipmb.load_profile(profile)
    orderly, disturbed = Merged(), Merged()
    orderly.take(feed(Session(SENSOR.stream, parameters), range(10), SENSOR, **POINTS))
    one = Session(SENSOR.stream, parameters)
    for run, seqs in enumerate(([0, 1], [3, 2], [5, 6, 4], [7, 9, 8])):
        disturbed.take(feed(one, seqs, SENSOR, **POINTS), run)
        one = Session.restore(decode_checkpoint(encode_checkpoint(one.snapshot())), 0)
    assert disturbed.plain() == orderly.plain()


def test_a_point_that_is_none_is_refused_with_its_path() -> None:
    """Half a position is no position."""
    center = SENSOR.detections(0).center.copy()
    center[1, 1] = np.nan
    with pytest.raises(schemas.MessageError, match=r"center\[1\]\[1\]: expected a number in"):
        SENSOR.detections(0, center=center, **POINTS)
