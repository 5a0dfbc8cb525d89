"""The tracker against the oracle: whole steps over random scenes, the whole density and all tracks at every frame."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from compare import assert_matches
from oracle import Oracle
from scenes import Options, frame_of, random_parameters, scene

import optipmb
from optipmb.model.parameters import parse_parameters

COMBINATIONS = list(product((True, False), repeat=4))
PROFILES = ("kitti", "nuscenes")


def follow(parameters: optipmb.Parameters, modules: optipmb.Modules, seed: int, options: Options) -> dict[str, int]:
    """Run both over one scene, compare after every frame, and count what happened."""
    tracker, oracle = optipmb.Tracker(parameters, modules), Oracle(parameters, modules)
    density = tracker.initial()
    seen = dict.fromkeys(("tracks", "poisson", "ambiguous", "updated_poisson", "missed"), 0)
    for number, given in enumerate(scene(seed, options)):
        frame = frame_of(parameters, given)
        result = tracker.step(density, frame)
        wanted = oracle.step(frame)
        assert_matches(oracle, wanted, result.density, result.tracks, f"seed {seed} frame {number}:")
        density = result.density
        objects = oracle.costs.shape[1] - oracle.costs.shape[0]
        finite = np.isfinite(oracle.costs[:, :objects])
        seen["ambiguous"] += int(((finite.sum(axis=0) > 1) & finite[finite.sum(axis=1) > 1].any(axis=0)).sum())
        seen["tracks"] += len(result.tracks.id)
        seen["poisson"] += len(oracle.poisson)
        seen["updated_poisson"] += sum(0.0 < b.existence < 1.0 and b.seen_ns == b.born_ns for b in oracle.bernoulli)
        seen["missed"] += sum(b.detection < 0 for b in oracle.bernoulli)
    return seen


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("flags", COMBINATIONS, ids=lambda flags: "".join(str(int(flag)) for flag in flags))
def test_every_combination_of_modules_equals_algorithm_1(profile: str, flags: tuple[bool, ...]) -> None:
    """With each of ADP, HABM, RPP and OTE on or off, every step equals the literal Algorithm 1 to 1e-9."""
    parameters = optipmb.load_profile(profile)
    options = Options(labels=parameters.labels, frames=8, period=parameters.nominal_period)
    seed = sum(flag << i for i, flag in enumerate(flags)) + 100 * PROFILES.index(profile)
    seen = follow(parameters, optipmb.Modules(*flags), seed, options)
    assert seen["tracks"] > 0


@pytest.mark.parametrize("profile", PROFILES)
def test_long_scenes_equal_algorithm_1(profile: str) -> None:
    """Over a long scene nothing drifts apart, and everything that can happen happened."""
    parameters = optipmb.load_profile(profile)
    options = Options(labels=parameters.labels, frames=40, period=parameters.nominal_period)
    seen = follow(parameters, optipmb.Modules(), 7, options)
    assert min(seen.values()) > 10, seen


@pytest.mark.parametrize("seed", range(9))
def test_random_parameters_equal_algorithm_1(seed: int) -> None:
    """The agreement does not hang on the values of the two profiles; two in three of these have a calibration."""
    parameters = parse_parameters(random_parameters(seed, calibrated=seed % 3 > 0))
    rng = np.random.default_rng(seed)
    options = Options(
        frames=12,
        objects=int(rng.integers(4, 16)),
        extent=float(rng.choice([8.0, 30.0])),
        missed=float(rng.uniform(0, 0.6)),
        velocity=str(rng.choice(["known", "none", "mixed"])),
        flips=float(rng.choice([0.0, 0.5])),
    )
    modules = optipmb.Modules(*(bool(flag) for flag in rng.random(4) < 0.75))
    follow(parameters, modules, seed, options)


def test_crowds_are_decided_like_the_full_matrix() -> None:
    """Where dozens of objects share their gates, the shortest paths give the assignment of the full cost matrix."""
    document = random_parameters(3)
    for values in document["classes"].values():
        values.update(gate=6.0, max_misses=10, survival=1.0)
    parameters = parse_parameters(document)
    options = Options(frames=12, objects=40, extent=6.0, clutter=10.0, missed=0.3, irregular=False)
    seen = follow(parameters, optipmb.Modules(), 5, options)
    assert seen["ambiguous"] > 100
