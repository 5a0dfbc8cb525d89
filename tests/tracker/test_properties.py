"""What holds for every scene: invariants of the density, symmetries of the world, purity and reproducibility."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compare import TRACKS, density_bytes, digest, tracks_bytes
from oracle_formulas import Measurement, confidence, report
from scenes import Options, SceneCloud, SceneFrame, SensorPose, frame_of, partial, random_parameters, scene

import optipmb
from optipmb.model.parameters import parse_parameters

SEEDS = range(4)
SUPPORT = Path(__file__).resolve().parents[1] / "support"


def run(
    parameters: optipmb.Parameters, frames: list[SceneFrame], modules: optipmb.Modules | None = None
) -> list[optipmb.StepResult]:
    """The results of all frames of a scene."""
    tracker = optipmb.Tracker(parameters, modules or optipmb.Modules())
    density, results = tracker.initial(), []
    for given in frames:
        result = tracker.step(density, frame_of(parameters, given))
        density = result.density
        results.append(result)
    return results


def assert_valid(density: optipmb.Density) -> None:
    """The density is one: proper covariances, probabilities and weights, headings in (-pi, pi], ids ascending."""
    for rows in (density.bernoulli, density.poisson):
        assert all(np.isfinite(getattr(rows, name)).all() for name in ("mean", "covariance", "auxiliary"))
        np.testing.assert_array_equal(rows.covariance, np.swapaxes(rows.covariance, 1, 2))
        if len(rows.covariance):
            assert np.linalg.eigvalsh(rows.covariance).min() > 0
        assert np.all((rows.mean[:, 3] > -np.pi) & (rows.mean[:, 3] <= np.pi))
        assert np.all(rows.born_ns <= density.stamp_ns)
        assert np.all(rows.auxiliary[:, :3] > 0)
    bernoulli = density.bernoulli
    assert np.all((bernoulli.existence > 0) & (bernoulli.existence <= 1))
    assert np.all(density.poisson.weight > 0)
    assert np.all(np.diff(bernoulli.id) > 0)
    assert np.all(bernoulli.id < density.next_id)
    assert np.all(bernoulli.seen_ns >= bernoulli.born_ns)


@pytest.mark.parametrize("seed", range(6))
def test_every_density_is_valid(seed: int) -> None:
    """Covariances stay symmetric positive definite, 0 < r <= 1, weights positive, headings in (-pi, pi]."""
    parameters = parse_parameters(random_parameters(seed))
    modules = optipmb.Modules(*(bool(seed & bit) for bit in (1, 2, 4, 8)))
    for result in run(parameters, list(scene(seed, Options(frames=60))), modules):
        assert_valid(result.density)


@pytest.mark.parametrize("seed", range(12))
def test_extreme_frames_leave_a_valid_density(seed: int) -> None:
    """Positions as far as the limit, boxes from specks to mountains, gaps of minutes, clouds of huge numbers."""
    rng = np.random.default_rng(seed)
    parameters = optipmb.load_profile(("kitti", "nuscenes")[seed % 2])
    tracker = optipmb.Tracker(parameters)
    density, stamp = tracker.initial(), int(rng.integers(0, 2**62))
    for _ in range(10):
        count = int(rng.integers(0, 8))
        near = rng.normal(0, 10 ** rng.choice([0, 4, 8]), 3) + rng.normal(0, 3, (count, 3))
        frame, _ = optipmb.make_frame(
            parameters,
            stamp_ns=stamp,
            labels=parameters.labels,
            label=rng.integers(0, len(parameters.labels), count),
            center=np.clip(near, -1e8, 1e8),
            size=10 ** rng.uniform(-8, 8, (count, 3)) if rng.random() < 0.5 else rng.uniform(1, 5, (count, 3)),
            yaw=np.clip(rng.normal(0, 10 ** rng.choice([0, 8]), count), -6.4, 6.4),
            score=rng.uniform(0.2, 1, count),
            velocity=np.clip(rng.normal(0, 10 ** rng.choice([0, 2, 3]), (count, 2)), -1e3, 1e3),
            cloud=optipmb.PointCloud(
                (rng.normal(0, 10, (50, 3)) * 10.0 ** rng.choice([0, 8, 30])).astype(np.float32),
                optipmb.Pose(translation=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0])),
            ),
        )
        density = tracker.step(density, frame).density
        assert_valid(density)
        stamp += int(10 ** rng.uniform(0, 11))


def test_a_density_stays_valid_for_thousands_of_frames() -> None:
    """Nothing degenerates over a long stream of repeated, jittered and interrupted frames."""
    parameters = optipmb.load_profile("kitti")
    options = Options(labels=parameters.labels, frames=2000, objects=4, clouds=0.1)
    results = run(parameters, list(scene(3, options)))
    for result in results[::10]:
        assert_valid(result.density)


@pytest.mark.parametrize("seed", SEEDS)
def test_an_id_is_never_reused(seed: int) -> None:
    """Within a frame ids are unique; an id that is gone never returns; new ids are the next numbers."""
    gone: set[int] = set()
    before: set[int] = set()
    next_id = 1
    for result in run(parse_parameters(random_parameters(seed)), list(scene(seed, Options(frames=80)))):
        ids = [int(i) for i in result.density.bernoulli.id]
        assert len(set(ids)) == len(ids)
        new = set(ids) - before
        assert new == set(range(next_id, result.density.next_id))
        next_id = result.density.next_id
        gone |= before - set(ids)
        before = set(ids)
        assert not gone & before
        assert set(result.tracks.id.tolist()) <= before
    assert gone


def test_a_density_may_start_with_a_later_id() -> None:
    """A restarted session goes on with fresh ids."""
    parameters = optipmb.load_profile("kitti")
    given = next(scene(1, Options(labels=parameters.labels)))
    tracker = optipmb.Tracker(parameters)
    first = tracker.step(tracker.initial(), frame_of(parameters, given)).density
    later = tracker.step(replace(tracker.initial(), next_id=100), frame_of(parameters, given)).density
    np.testing.assert_array_equal(later.bernoulli.id, first.bernoulli.id + 99)
    assert later.next_id == first.next_id + 99


def assert_same_known(one: optipmb.StepResult, other: optipmb.StepResult) -> None:
    """The known parts of the tracks are the same."""
    assert (one.measured is None) == (other.measured is None)
    if one.measured is not None and other.measured is not None:
        np.testing.assert_array_equal(one.measured, other.measured)


def moved(given: SceneFrame, angle: float, shift: np.ndarray) -> SceneFrame:
    """The frame in a world that was rotated about z and shifted."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    cloud = given.cloud
    if cloud is not None:
        w, x, y, z = cloud.pose.quaternion
        ch, sh = np.cos(angle / 2), np.sin(angle / 2)
        quaternion = np.array([ch * w - sh * z, ch * x - sh * y, ch * y + sh * x, ch * z + sh * w])
        cloud = SceneCloud(cloud.xyz, SensorPose(rotation @ cloud.pose.translation + shift, quaternion))
    velocity = None if given.velocity is None else given.velocity @ rotation[:2, :2].T
    center = given.center @ rotation.T + shift
    return replace(given, center=center, yaw=np.angle(np.exp(1j * (given.yaw + angle))), velocity=velocity, cloud=cloud)


@pytest.mark.parametrize("unknown", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_world_frame_does_not_matter(seed: int, unknown: float) -> None:
    """Rotate and shift the world: the same tracks, rotated and shifted, to 1e-6, also with unknown headings."""
    rng = np.random.default_rng(seed)
    angle, shift = rng.uniform(-3, 3), rng.uniform(-500, 500, 3)
    frames = list(scene(seed, Options(frames=60, ties=False)))  # ties are broken by coordinates, which turn too
    turned_frames = [moved(given, angle, shift) for given in frames]
    if unknown:
        absent = [rng.random((3, len(given.score))) < unknown for given in frames]
        frames = [partial(given, *rows) for given, rows in zip(frames, absent, strict=True)]
        turned_frames = [partial(given, *rows) for given, rows in zip(turned_frames, absent, strict=True)]
    parameters = parse_parameters(random_parameters(seed + 20))
    turned = run(parameters, turned_frames)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    full = np.eye(6)
    full[:2, :2] = rotation
    for one, other in zip(run(parameters, frames), turned, strict=True):
        a, b = one.tracks, other.tracks
        for name in ("id", "label", "detection"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        for name in ("size", "yaw_rate", "acceleration", "existence", "score", "age", "time_since_detection"):
            np.testing.assert_allclose(getattr(b, name), getattr(a, name), atol=1e-6, rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(b.center[:, :2], a.center[:, :2] @ rotation.T + shift[:2], atol=1e-6)
        raised = shift[2] * (1.0 if one.measured is None else one.measured >= 4)  # of known height
        np.testing.assert_allclose(b.center[:, 2], a.center[:, 2] + raised, atol=1e-6)
        assert_same_known(one, other)
        unknown_yet = (a.velocity == 0.0).all(axis=1) & (a.heading_confidence == 0.5)  # detected once
        faces = np.where(unknown_yet, 0.0, 1.0)
        np.testing.assert_allclose(faces * np.exp(1j * b.yaw), faces * np.exp(1j * (a.yaw + angle)), atol=1e-6)
        np.testing.assert_allclose(b.velocity, a.velocity @ rotation.T, atol=1e-6)
        scale = 1e-6 * max(1.0, float(np.abs(a.covariance).max(initial=0)))
        shown = np.ones((len(a), 6, 6))
        shown[faces == 0.0, :2, 2:] = shown[faces == 0.0, 2:, :2] = 0.0  # along a direction that says nothing
        np.testing.assert_allclose(b.covariance * shown, full @ a.covariance @ full.T * shown, atol=scale)
        assert len(one.density.poisson) == len(other.density.poisson)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_detections_does_not_matter(seed: int) -> None:
    """Shuffled detections give the same bytes; only the index of the associated detection follows them."""
    rng = np.random.default_rng(seed)
    frames = list(scene(seed, Options(frames=60)))
    orders = [rng.permutation(len(given.score)) for given in frames]
    parameters = parse_parameters(random_parameters(seed + 40))
    shuffled = run(parameters, [given.taken(order) for given, order in zip(frames, orders, strict=True)])
    for one, other, order in zip(run(parameters, frames), shuffled, orders, strict=True):
        assert density_bytes(one.density) == density_bytes(other.density)
        assert tracks_bytes(one.tracks, without=("detection",)) == tracks_bytes(other.tracks, without=("detection",))
        found = other.tracks.detection
        back = np.where(found >= 0, order[found] if len(order) else -1, -1)
        np.testing.assert_array_equal(back, one.tracks.detection)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_classes_does_not_matter(seed: int) -> None:
    """Reorder the classes of the profile and of the labels: the same tracks under permuted labels."""
    document = random_parameters(seed + 60)
    names = list(document["classes"])
    order = [2, 0, 1]
    reordered = document | {"classes": {names[i]: document["classes"][names[i]] for i in order}}
    frames = list(scene(seed, Options(frames=60)))
    renamed = []
    for given in frames:
        labels = given.labels[::-1]
        renamed.append(replace(given, labels=labels, label=len(labels) - 1 - given.label))
    first = run(parse_parameters(document), frames)
    second = run(parse_parameters(reordered), renamed)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(np.array(order, dtype=np.int64)[other.tracks.label], one.tracks.label)
        assert tracks_bytes(one.tracks, without=("label",)) == tracks_bytes(other.tracks, without=("label",))


def test_a_step_is_pure() -> None:
    """The density and the frame that a step is given stay as they are, and the same call gives the same bytes."""
    parameters = parse_parameters(random_parameters(1))
    tracker = optipmb.Tracker(parameters)
    density = tracker.initial()
    for given in scene(1, Options(frames=40)):
        frame = frame_of(parameters, given)
        arrays = (frame.center, frame.size, frame.yaw, frame.velocity, frame.score, frame.label, frame.source)
        before, copies = density_bytes(density), [copy.copy(array) for array in arrays]
        first, second = tracker.step(density, frame), tracker.step(density, frame)
        assert density_bytes(density) == before
        for array, was in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, was)
        assert density_bytes(first.density) == density_bytes(second.density)
        assert tracks_bytes(first.tracks) == tracks_bytes(second.tracks)
        density = first.density


def test_two_trackers_share_nothing() -> None:
    """Interleaved streams give what each gives alone: no counter and no cache is common to two trackers."""
    parameters = optipmb.load_profile("kitti")
    options = Options(labels=parameters.labels, frames=30)
    streams = [list(scene(seed, options)) for seed in (1, 2)]
    alone = [digest([result.density for result in run(parameters, frames)]) for frames in streams]
    trackers = [optipmb.Tracker(parameters), optipmb.Tracker(parameters)]
    densities = [[trackers[0].initial()], [trackers[1].initial()]]
    for pair in zip(*streams, strict=True):
        for i, given in enumerate(pair):
            densities[i].append(trackers[i].step(densities[i][-1], frame_of(parameters, given)).density)
    assert [digest(chain[1:]) for chain in densities] == alone


SCRIPT = """
import optipmb
from compare import digest
from optipmb.model.parameters import parse_parameters
from scenes import Options, frame_of, random_parameters, scene
parameters = parse_parameters(random_parameters(5))
tracker = optipmb.Tracker(parameters)
densities = [tracker.initial()]
for given in scene(5, Options(frames=60)):
    densities.append(tracker.step(densities[-1], frame_of(parameters, given)).density)
print(digest(densities))
"""


def test_two_processes_give_the_same_bytes() -> None:
    """The density of every frame is the same to the byte in processes with other hash seeds."""
    found = set()
    for seed in ("1", "2"):
        environment = os.environ | {"PYTHONPATH": str(SUPPORT), "PYTHONHASHSEED": seed}
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, timeout=120, check=True
        )
        found.add(done.stdout.strip())
    assert len(found) == 1
    assert len(found.pop()) == 64


@pytest.mark.parametrize("seed", SEEDS)
def test_tracks_are_the_extracted_bernoullis(seed: int) -> None:
    """Tracks say what the density holds of the same ids, but for two things.

    With `reported_noise` the box of a detected object is updated once more; the doubt about the sign of a heading is
    added to its variance.
    """
    parameters = parse_parameters(random_parameters(seed))
    frames, classes, boxes_updated = list(scene(seed, Options(frames=40))), list(parameters.classes.values()), []
    for given, result in zip(frames, run(parameters, frames), strict=True):
        frame, tracks, rows = frame_of(parameters, given), result.tracks, result.density.bernoulli
        now, index = result.density.stamp_ns, np.searchsorted(rows.id, tracks.id)
        for name in ("id", "label", "existence", "score", "confirmed"):
            np.testing.assert_array_equal(getattr(rows, name)[index], getattr(tracks, name))
        np.testing.assert_array_equal(np.c_[tracks.size, tracks.center[:, 2]], rows.auxiliary[index])
        np.testing.assert_allclose(tracks.age, (now - rows.born_ns[index]) * 1e-9, atol=1e-12)
        np.testing.assert_allclose(tracks.time_since_detection, (now - rows.seen_ns[index]) * 1e-9, atol=1e-12)
        assert rows.extracted[index].all()
        assert {len(getattr(tracks, name)) for name in TRACKS} == {len(tracks.id)}
        v, phi = rows.mean[index, 2], tracks.yaw
        np.testing.assert_allclose(tracks.velocity, np.c_[v * np.cos(phi), v * np.sin(phi)], atol=1e-12)
        shown = np.c_[tracks.center[:, :2], v, tracks.yaw, tracks.yaw_rate, tracks.acceleration]
        for k, n in enumerate(index):
            c, mean, covariance = classes[tracks.label[k]], rows.mean[n], rows.covariance[n].copy()
            detected = tracks.detection[k] >= 0 and c.reported_noise is not None
            if detected:
                m = int(np.flatnonzero(frame.source == tracks.detection[k])[0])
                z = Measurement(frame.center[m, :2], None, float(frame.yaw[m]), frame.size[m], 0, 1.0, 0)
                mean, covariance = report(c, z, mean, covariance)
            covariance[3, 3] += confidence(c, float(rows.heading_odds[n]))[1]
            tolerance = 1e-9 if detected else 0.0  # but for rounding, or to the bit
            np.testing.assert_allclose(shown[k], mean, rtol=tolerance, atol=tolerance)
            np.testing.assert_allclose(tracks.covariance[k], covariance, rtol=0, atol=max(tolerance, 1e-14))
            boxes_updated.append(detected)
    assert {*boxes_updated} == {True, False}
