"""Sensors of unequal kind on one density: measurement side, births, sizes and headings that are not believed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import optipmb
from optipmb import FieldOfView, Parameters, Sensor, Sensors, Tracker

Pictures = list[tuple[int, str, np.ndarray]]
"""Stamp, sensor, and x, y, yaw, score of each detection (M, 4)."""

KITTI = optipmb.load_profile("kitti")
LIDAR_RANGE, RADAR_RANGE, RADAR_HALF = 40.0, 70.0, 0.35
VIEWS = {
    "lidar": FieldOfView((-math.pi, math.pi), (-1.5, 1.5), (0.0, LIDAR_RANGE)),
    "radar": FieldOfView((-RADAR_HALF, RADAR_HALF), (-1.5, 1.5), (0.0, RADAR_RANGE)),
}
SIZES = {"lidar": (4.5, 1.9, 1.6), "radar": (2.0, 2.0, 1.0)}
STILL = optipmb.Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def changed(base: Parameters, **values: Any) -> Parameters:
    """A profile with other values in all classes."""
    document = base.model_dump(mode="json") | {"name": "radar"}
    for one in document["classes"].values():
        one |= {name: one[name] | value if isinstance(value, dict) else value for name, value in values.items()}
    return optipmb.parse_parameters(document)


RADAR = changed(
    KITTI,
    measurement_noise={"position": 1.5, "heading": 1.0},
    reported_noise=None,
    detection=0.5,
    clutter_rate=8.0,
    gate=5.0,
    score_filter=0.1,
)


def traffic(seed: int, frames: int = 150) -> list[np.ndarray]:
    """Number, x, y and yaw of the cars of each frame: they come from four sides of a crossing."""
    rng = np.random.default_rng(seed)
    cars = [
        (rng.integers(0, 90), rng.uniform(2, 6) * rng.choice((-1, 1)), rng.uniform(5, 10), k % 4 * math.pi / 2)
        for k in range(14)
    ]
    found = []
    for k in range(frames):
        rows = []
        for number, (begins, aside, speed, yaw) in enumerate(cars):
            along = speed * (k - begins) * 0.1 - 60.0
            if k >= begins and along < 60.0:
                c, s = math.cos(yaw), math.sin(yaw)
                rows.append((number, along * c - aside * s, along * s + aside * c, yaw))
        found.append(np.array(rows).reshape(-1, 4))
    return found


def visible(xy: np.ndarray, sensor: str) -> np.ndarray:
    """Which places (N, 2) a sensor sees."""
    away, angle = np.hypot(*xy.T), np.abs(np.arctan2(xy[:, 1], xy[:, 0]))
    return away < LIDAR_RANGE if sensor == "lidar" else (away < RADAR_RANGE) & (angle < RADAR_HALF)


def seen(world: list[np.ndarray], sensor: str, seed: int) -> Pictures:
    """What a sensor sees: a lidar all around, or a radar that is noisy and narrow, between the frames of the lidar."""
    rng, is_radar = np.random.default_rng(seed), sensor == "radar"
    share, noise, turn, clutter = (0.6, 1.2, 0.8, 1.0) if is_radar else (0.9, 0.12, 0.05, 0.3)
    found = []
    for k, cars in enumerate(world):
        hit = cars[visible(cars[:, 1:3], sensor)]
        hit = hit[rng.random(len(hit)) < share]
        true = np.c_[hit[:, 1:] + rng.normal(0, (noise, noise, turn), (len(hit), 3)), rng.uniform(0.55, 0.95, len(hit))]
        many = rng.poisson(clutter)
        angle = rng.uniform(-RADAR_HALF, RADAR_HALF, many) if is_radar else rng.uniform(-math.pi, math.pi, many)
        away = rng.uniform(5, RADAR_RANGE if is_radar else LIDAR_RANGE, many)
        scores = rng.uniform(0.1, 0.75 if is_radar else 0.5, many)
        false = np.c_[away * np.cos(angle), away * np.sin(angle), rng.uniform(-3, 3, many), scores]
        found.append((k * 10**8 + is_radar * 5 * 10**7, sensor, np.r_[true, false]))
    return found


def followed(pictures: Pictures, use: Sensor | None = None, base: Parameters = KITTI) -> list[Any]:
    """The stamp, the sensor and the result of each frame, by stamp; `use` is that of the radar."""
    sensors = Sensors(()) if use is None else Sensors((("*/radar", use),))
    trackers = {name: Tracker(sensors.parameters(base, name)) for name in VIEWS}
    density, found = Tracker(base).initial(), []
    for stamp_ns, sensor, rows in sorted(pictures, key=lambda one: one[:2]):
        frame, _ = optipmb.make_frame(
            trackers[sensor].parameters,
            stamp_ns=stamp_ns,
            labels=("Car",),
            label=np.zeros(len(rows), np.int64),
            center=np.c_[rows[:, :2], np.full(len(rows), 0.8)],
            size=np.tile(SIZES[sensor], (len(rows), 1)),
            yaw=np.remainder(rows[:, 2], 2.0 * math.pi),
            score=rows[:, 3],
            pose=STILL,
            field_of_view=VIEWS[sensor],
        )
        result = trackers[sensor].step(density, frame)
        density = result.density
        found.append((stamp_ns, sensor, result))
    return found


def mota(world: list[np.ndarray], found: list[Any]) -> float:
    """MOTA of confirmed tracks in frames of the lidar: cars that a sensor sees, within 2 m."""
    errors = count = 0
    last: dict[int, int] = {}
    by_stamp = {stamp_ns: result.tracks for stamp_ns, sensor, result in found if sensor == "lidar"}
    for k, cars in enumerate(world):
        tracks = by_stamp[k * 10**8]
        rows = cars[visible(cars[:, 1:3], "lidar") | visible(cars[:, 1:3], "radar")]
        near = tracks.confirmed & (visible(tracks.center[:, :2], "lidar") | visible(tracks.center[:, :2], "radar"))
        ids, places = tracks.id[near].tolist(), tracks.center[near, :2]
        for number, x, y, _ in rows:
            count += 1
            away = np.hypot(*(places - (x, y)).T) if ids else np.array([math.inf])
            if away.min() > 2.0:
                errors += 1
                continue
            at = int(away.argmin())
            errors += last.get(number, ids[at]) != ids[at]
            last[number] = ids.pop(at)
            places = np.delete(places, at, axis=0)
        errors += len(ids)
    return 1.0 - errors / count


def test_the_right_profile_makes_a_second_sensor_no_harm() -> None:
    """A noisy, narrow radar helps the lidar with a profile of its own, and harms it with that of the lidar."""
    alone, fused, alike = [], [], []
    for seed in range(4):
        world = traffic(seed)
        lidar, radar = seen(world, "lidar", seed), seen(world, "radar", seed)
        alone.append(mota(world, followed(lidar)))
        fused.append(mota(world, followed(lidar + radar, Sensor(RADAR, trust_size=False, trust_heading=False))))
        alike.append(mota(world, followed(lidar + radar)))
    assert sum(fused) >= sum(alone)
    assert sum(alike) < sum(alone) - 0.05 * len(alone)


@pytest.mark.parametrize("profile", ["kitti", "nuscenes"])
def test_a_sensor_that_detects_nothing_changes_nothing(profile: str) -> None:
    """Empty frames of a detection probability near zero leave ids and existence as they are without."""
    base, world = optipmb.load_profile(profile), traffic(3)
    lidar = seen(world, "lidar", 3)
    blind = [(stamp_ns + 5 * 10**7, "radar", np.zeros((0, 4))) for stamp_ns, _, _ in lidar]
    use = Sensor(changed(base, detection=1e-15))
    ours = [result for _, sensor, result in followed(lidar + blind, use, base) if sensor == "lidar"]
    assert sum(len(one.tracks) for one in ours) > 500
    for one, (_, _, other) in zip(ours, followed(lidar, base=base), strict=True):
        assert one.tracks.id.tolist() == other.tracks.id.tolist()
        np.testing.assert_allclose(one.tracks.existence, other.tracks.existence, rtol=0, atol=1e-9)


@pytest.mark.parametrize("profile", ["kitti", "generic"])
@pytest.mark.parametrize("own", [None, RADAR])
def test_ids_never_begin_in_frames_of_a_sensor_that_starts_no_tracks(profile: str, own: Parameters | None) -> None:
    """Neither objects nor Poisson components; with self-calibration too, which lowers thresholds."""
    base, world = optipmb.load_profile(profile), traffic(5)
    pictures = seen(world, "lidar", 5) + seen(world, "radar", 5)
    begun = {"lidar": 0, "radar": 0}
    before = Tracker(base).initial()
    for _, sensor, result in followed(pictures, Sensor(own, starts_tracks=False), base):
        begun[sensor] += result.density.next_id - before.next_id
        if sensor == "radar":
            assert len(result.density.poisson) <= len(before.poisson)
        before = result.density
    assert begun["lidar"] > 10
    assert begun["radar"] == 0


def test_sizes_that_are_not_trusted_leave_boxes_alone() -> None:
    """What the lidar measured stays to the last bit; an object of the radar alone has the size of its class."""
    world = traffic(7)
    pictures = seen(world, "lidar", 7) + seen(world, "radar", 7)
    boxes: dict[int, bytes] = {}
    sizes = set()
    for _, sensor, result in followed(pictures, Sensor(trust_size=False)):
        objects = result.density.bernoulli
        for number, box in zip(objects.id.tolist(), objects.auxiliary, strict=True):
            if sensor == "radar":
                assert box.tobytes() == boxes.get(number, box.tobytes())
            boxes[number] = box.tobytes()
        sizes |= set(np.round(result.tracks.size[:, 1], 6).tolist())
    assert sizes == {1.9}


def test_headings_that_are_not_trusted_are_as_unknown_ones() -> None:
    """The tracks are those of detections without headings."""
    world = traffic(9)
    lidar, radar = seen(world, "lidar", 9), seen(world, "radar", 9)
    without = [(stamp_ns, sensor, rows + np.array([0.0, 0.0, np.nan, 0.0])) for stamp_ns, sensor, rows in radar]
    ours, theirs = followed(lidar + radar, Sensor(trust_heading=False)), followed(lidar + without)
    assert [one.tracks.words.tobytes() for _, _, one in ours] == [one.tracks.words.tobytes() for _, _, one in theirs]


@pytest.mark.parametrize("detection", [0.02, 0.5, 0.95])
def test_a_miss_says_as_much_as_the_detection_probability_of_its_sensor(detection: float) -> None:
    """With odds of existence times 1 - q at a miss, (1 - p)^a = 1 - q; a better sensor's miss counts as one."""
    own = Sensor(changed(KITTI, detection=detection)).parameters(KITTI)
    for name, session in KITTI.classes.items():
        naive = 1.0 - min(detection, session.detection)
        assert (1.0 - session.detection) ** own.classes[name].attention == pytest.approx(naive, rel=1e-12)


def test_a_class_that_the_profile_of_a_sensor_lacks_is_neither_detected_nor_missed() -> None:
    """Its detections are left out, and existence and scores of others' objects stay."""
    without = KITTI.model_copy(update={"classes": {name: KITTI.classes[name] for name in ("Pedestrian", "Cyclist")}})
    world = traffic(11)
    ours = followed(seen(world, "lidar", 11) + seen(world, "radar", 11), Sensor(without))
    theirs = followed(seen(world, "lidar", 11))
    assert {sensor for _, sensor, one in ours if one.diagnostics.associated} == {"lidar"}
    for (_, _, one), (_, _, other) in zip((one for one in ours if one[1] == "lidar"), theirs, strict=True):
        assert one.tracks.id.tolist() == other.tracks.id.tolist()
        np.testing.assert_allclose(one.tracks.existence, other.tracks.existence, rtol=0, atol=1e-9)


def test_an_ordinary_sensor_has_the_parameters_of_the_session() -> None:
    """Of sensors the first pattern that matches holds; a name without a slash stands for the last part."""
    sensors = Sensors.read({"a/b/radar": {}, "a/*/r*": {"trust_size": False, "profile": "nuscenes"}})
    assert sensors.parameters(KITTI, "a/b/radar") is sensors.parameters(KITTI, "a/b/lidar") is KITTI
    other = sensors.parameters(KITTI, "a/c/radar")
    assert other == sensors.parameters(KITTI, "rear") != KITTI
    assert not other.trust_size
    assert (other.name, other.labels, other.nominal_period) == (KITTI.name, KITTI.labels, KITTI.nominal_period)
    assert optipmb.parse_parameters(other.model_dump(mode="json")) == other
    assert sensors.shown() == {"a/b/radar": {}, "a/*/r*": {"profile": "nuscenes", "trust_size": False}}
    assert Sensors.read({"a/b/radar": {}}).shown() == {}


@pytest.mark.parametrize(
    ("tables", "error"),
    [
        ({"a/b/c": {"starts": True}}, r"sensors\.a/b/c\.starts: expected one of profile, starts_tracks"),
        ({"a/b/c": {"trust_size": 1}}, r"sensors\.a/b/c\.trust_size: expected true or false, received 1"),
        ({"a/b/c": {"profile": 3}}, r"sensors\.a/b/c\.profile: expected the name of a profile"),
        ({"a/b/c": {"profile": "radra"}}, r"sensors\.a/b/c\.profile: expected one of"),
        ({"a/b/c": 1}, r"sensors\.a/b/c: expected a table"),
        (1, "sensors: expected a table"),
    ],
)
def test_errors_name_the_path(tables: Any, error: str) -> None:
    """One line says where and what."""
    with pytest.raises(optipmb.ParameterError, match=error):
        Sensors.read(tables)
