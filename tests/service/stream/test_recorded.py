"""Recorded sequences, disturbed: state and tracks equal the recording in order, byte for byte."""

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optipmb_schemas import Detections, Points, Pose, encode
from optipmb_service.session.checkpoint import state_bytes
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from real_data import kitti_root, nuscenes_root
from recorded import Recording, recording
from router import SECOND
from sessions import Merged

import optipmb

STREAM = "site/node/lidar"
LATE = 4
"""How many frames a message is late at most: inside the window at the rate of both datasets."""
CASES = [
    ("kitti", kitti_root, "pointrcnn", 120, Policy(rewind_ns=SECOND, late_clouds=True)),
    ("nuscenes", nuscenes_root, "centerpoint", 38, Policy(rewind_ns=3 * SECOND, late_clouds=True)),
]


def clouded(original: Recording, chance: random.Random) -> Recording:
    """The recording with a made-up cloud, points about the detections, for every other frame that has none."""
    made = []
    for seq, (detections, cloud) in enumerate(original.frames):
        points = cloud
        if points is None and seq % 2 == 0 and len(detections.center):
            spread = np.random.default_rng(chance.randrange(2**32)).normal(0, 1.0, (20, len(detections.center), 3))
            xyz = (detections.center + spread).reshape(-1, 3).astype(np.float32)
            points = Points(
                stream=STREAM,
                epoch=detections.epoch,
                seq=10_000 + seq,
                stamp_ns=detections.stamp_ns,
                frame="sensor",
                pose=detections.pose or Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0])),
                xyz=xyz,
            )
        made.append((detections.model_copy(update={"has_points": points is not None}), points))
    return Recording(STREAM, made)


def disturbed(original: Recording, chance: random.Random, lost: set[int]) -> list[Detections | Points]:
    """The messages in an order of arrival: shuffled inside the window, three of ten twice, clouds late too."""
    arrivals: list[tuple[float, int, Detections | Points]] = []
    for seq, (detections, points) in enumerate(original.frames):
        for message in (detections, points):
            if message is None or (message is points and seq in lost):
                continue
            for _ in range(1 + (chance.random() < 0.3)):
                arrivals.append((seq + chance.uniform(0, LATE), len(arrivals), message))
    return [message for _, _, message in sorted(arrivals, key=lambda one: one[:2])]


@pytest.mark.parametrize(("name", "root", "detector", "frames", "policy"), CASES, ids=[case[0] for case in CASES])
@pytest.mark.parametrize("seed", [1, 2])
def test_shuffled_repeated_and_late_is_the_same(
    name: str, root: Callable[[], Path], detector: str, frames: int, policy: Policy, seed: int
) -> None:
    """Frames shuffled in the window, 30 % of them twice, clouds late or missing: byte-equal to the run in order."""
    where, chance = root(), random.Random(seed)
    original = clouded(recording(name, where, detector, "all", STREAM, frames), chance)
    lost = set(range(4, frames, 6))
    parameters = optipmb.load_profile(name)
    one, merged = Session(STREAM, parameters, policy), Merged()
    two, expected = Session(STREAM, parameters, replace(policy)), Merged()
    for seq, (detections, points) in enumerate(original.frames):
        if points is not None and seq not in lost:
            expected.take(two.on_points(points, 0))
        expected.take([*two.on_detections(detections, 0), *two.flush()])
    now_ns = 0
    for message in disturbed(original, chance, lost):
        now_ns += SECOND // 25
        merged.take(one.on_tick(now_ns))
        give = one.on_points if isinstance(message, Points) else one.on_detections
        merged.take(give(message, now_ns))  # type: ignore[operator]  # each gets its own kind
    merged.take(one.flush())
    counters = one.counters
    assert counters.late == 0
    assert counters.inserted > frames / 8
    assert counters.duplicates > frames / 5
    assert (counters.clouds_used, counters.clouds_missed) == (two.counters.clouds_used, two.counters.clouds_missed)
    assert counters.clouds_missed > 0
    assert state_bytes(one.snapshot()) == state_bytes(two.snapshot())
    assert merged.plain() == expected.plain()
    assert sum(len(encode(message)) for _, message in merged.newest.values()) > 10_000
