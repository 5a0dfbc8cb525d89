"""Births that an object forbids."""

from __future__ import annotations

from scenes import boxes, steps

import optipmb


def follow(profile: str, aside: list[float]) -> list[list[int]]:
    """Ids of a standing car whose box is so far off to the side, m, frame by frame."""
    parameters = optipmb.load_profile(profile)
    frames = [boxes(parameters, 0.1 * k, (10.0, off)) for k, off in enumerate(aside)]
    return [result.tracks.id.tolist() for result in steps(parameters, frames)]


def test_a_box_beside_its_car_starts_no_second_track() -> None:
    """One box of a settled car lies 1.4 m to the side: the car keeps its id and stays alone; not so by the paper."""
    beside = [0.0] * 20 + [1.4] + [0.0] * 10
    assert follow("kitti", beside) == [[1]] * 31
    assert any(len(ids) > 1 for ids in follow("kitti-paper", beside))


def test_beside_a_short_track_what_is_there_is_born_a_frame_later() -> None:
    """A box next to a missed car of half a second is a track from the next frame on."""
    ids = follow("kitti", [0.0] * 5 + [1.4] * 4)
    assert ids[5] == [1]
    assert 2 in ids[6]


def test_a_lasting_track_stays_alone_as_long_as_it_is_extracted() -> None:
    """Next to a car of two seconds it starts none while the car is extracted: `extract_misses` less one."""
    assert optipmb.load_profile("kitti").classes["Car"].extract_misses == 5
    ids = follow("kitti", [0.0] * 20 + [1.4] * 12)
    assert not any(2 in now for now in ids[:24])
    assert 2 in ids[24]
