"""Scores that are calibrated while the tracker runs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from class_rows import class_rows

import optipmb
from optipmb.filter.undetected import AGED, MARKED
from optipmb.learning.self_calibration import (
    ALONG,
    BIN,
    DETECTIONS,
    FREE,
    GIVEN,
    HITS,
    LASTING,
    LASTING_RATIO,
    LEAST_MOVERS,
    LEAST_NOISE,
    LEAST_PART,
    LOOKS,
    LOWEST,
    MASS,
    MOST_NOISE,
    MOVING,
    OF_LOOKS,
    OUTLYING,
    PRIOR,
    PRIOR_PAIRS,
    RISE,
    TICKS,
    WALK,
    bin_of,
    calibrate,
    lasting,
    learn,
    learn_scatter,
    learned,
    learned_noise,
    needed_shares,
    squares,
    use_scatter,
)
from optipmb.model.density import BINS, COUNTS, NO_BIN, PHI, SCATTER, SLOT, SLOTS, STATE, Bernoullis, V

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

SEEDS = pytest.mark.parametrize("seed", range(3))
MIDDLES = LOWEST + (np.arange(BINS) + 0.5) * BIN
THRESHOLDS = ("score_filter", "announce_score", "birth_score")


def logit(score: Array) -> Array:
    """Log odds."""
    return np.log(score) - np.log1p(-score)


def bins(score: Array) -> NDArray[np.int64]:
    """Bins of scores."""
    return np.clip(np.floor((logit(score) - LOWEST) / BIN), 0, BINS - 1).astype(np.int64)


def test_a_bin_is_that_of_the_log_odds() -> None:
    """Equal widths of log odds, and the outermost without an end."""
    scores = np.r_[1e-12, np.random.default_rng(0).uniform(0, 1, 200), 1 - 1e-12]
    assert [bin_of(one) for one in scores] == bins(scores).tolist()
    assert bin_of(1.0) == BINS - 1


def counts(rng: np.random.Generator, classes: int = 2) -> Array:
    """Counts of classes: about half of the detections lasted and moved, more of those with good scores."""
    out = np.zeros((classes, COUNTS, BINS))
    out[:, [DETECTIONS, GIVEN, LOOKS]] = rng.integers(0, 40, (classes, 3, BINS))
    out[:, LASTING] = out[:, DETECTIONS] * np.clip(rng.normal(np.linspace(0, 1, BINS), 0.2), 0, 1)
    out[:, MOVING] = out[:, LASTING] * np.clip(rng.normal(np.linspace(0, 1, BINS), 0.2), 0, 1)
    out[:, HITS] = out[:, LOOKS] * rng.uniform(0.8, 1, (classes, BINS))
    return out


def isotonic(detections: Array, objects: Array) -> Array:
    """The largest of the least weighted means, scaled to its bounds."""
    weight = detections + PRIOR
    share = (objects + PRIOR / (1 + np.exp(-MIDDLES))) / weight
    means = [
        [np.average(share[i : j + 1], weights=weight[i : j + 1]) if j >= i else np.inf for j in range(BINS)]
        for i in range(BINS)
    ]
    curve = np.array([max(min(means[i][b:]) for i in range(b + 1)) for b in range(BINS)])
    return np.clip(curve * 0.985 / curve[-1], 0.001, 0.985)


def walkers(state: Array) -> Array:
    """Lasting detections of which few move, where most of the best fifth do."""
    best = np.cumsum(state[DETECTIONS][::-1])[::-1] - state[DETECTIONS] < 0.2 * state[DETECTIONS].sum()
    share = state[MOVING, best].sum() / state[LASTING, best].sum()
    most = np.where(best | (share <= LEAST_MOVERS), np.inf, (state[MOVING] + FREE) / share)
    return np.minimum(state[LASTING], most)


@SEEDS
@pytest.mark.parametrize("movers", [1.0, 0.5])
def test_scores_go_through_the_isotonic_curves(seed: int, movers: float) -> None:
    """Of lasting detections and of objects, the same for vehicles; thresholds do not pass the median of all scores."""
    rng = np.random.default_rng(seed)
    state, label, score = 4.0 * counts(rng), rng.integers(0, 2, 50), rng.uniform(0.001, 0.999, 50)
    state[:, MOVING] *= movers
    rows = class_rows(2, score_filter=0.1, announce_score=0.3, birth_score=0.9, constant_velocity=[False, True])
    found = calibrate(state, score, label, rows)
    assert (walkers(state[1]) < state[1, LASTING]).any() == (movers == 1.0)
    for c in range(2):
        objects = walkers(state[c]) if c else state[c, LASTING]
        curves = [isotonic(state[c, DETECTIONS], one) for one in (state[c, LASTING], objects)]
        odds = logit(score[label == c])
        wanted = [np.interp(odds, MIDDLES, curve) + RISE * odds for curve in curves]
        np.testing.assert_allclose(found[:, label == c], wanted, rtol=1e-12)
        median = int(np.searchsorted(np.cumsum(state[c, GIVEN]), 0.5 * state[c, GIVEN].sum()))
        edge = LOWEST + median * BIN
        bound = [np.interp(edge, MIDDLES, curve) + RISE * edge for curve in (curves[0], curves[1], curves[1])]
        np.testing.assert_allclose([rows[name][c] for name in THRESHOLDS], np.minimum([0.1, 0.3, 0.9], bound))
    order = np.argsort(score[label == 0])
    assert (np.diff(found[:, label == 0][:, order]) > 0).all()


@pytest.mark.parametrize("recall", [0.7, 0.85, 0.99])
def test_the_share_of_looks_follows_the_recall_of_the_best(recall: float) -> None:
    """Rho is of the bins with the best fifth of the detections, and 0.95 over five looks before there are any."""
    state = np.zeros((2, COUNTS, BINS))
    state[0, DETECTIONS, [5, 20, 25]] = [80.0, 10.0, 10.0]
    state[0, LOOKS, [5, 20, 25]] = 1000.0
    state[0, HITS, [5, 20, 25]] = [100.0, 1000 * recall, 1000 * recall]
    rho = (2000 * recall + 0.95 * PRIOR) / (2000 + PRIOR)
    np.testing.assert_allclose(needed_shares(state), [np.clip(1 - 3 * (1 - rho), 0.4, 0.87), 1 - 3 * 0.05])


class Counting:
    """The counts of a stream in plain Python: slots by id as lists of bins and numbers of looks."""

    def __init__(self, state: Array) -> None:
        self.state = state
        self.slots: dict[int, list[list[Any]]] = {}
        self.seconds: dict[int, float] = {}

    def end_slot(self, one: int, c: int, needed: float, speed: float) -> None:
        """Evaluate the middle slot of an object."""
        before, own, after = self.slots[one]
        sums = [(len(own[0] + other[0]), own[1] + other[1]) for other in (before, after)]
        lasting = any(hits >= max(3, needed * looks) for hits, looks in sums)
        share = min(1.0, 10 / own[1]) if own[0] else 0.0
        for b in own[0]:
            self.state[c, DETECTIONS, b] += share
            self.state[c, LASTING, b] += share * lasting
            self.state[c, MOVING, b] += share * (lasting and abs(speed) > WALK)
        if own[0] and before[0] and after[0]:
            mean = int(np.floor(np.mean(own[0]) + 0.5))
            self.state[c, HITS, mean] += share * len(own[0])
            self.state[c, LOOKS, mean] += share * own[1]
        self.slots[one] = [own, after, [[], 0]]
        self.seconds[one] = 0.0

    def follow(
        self,
        before: dict[int, int],
        objects: dict[int, tuple[int, int | None, bool]],
        speeds: tuple[dict[int, float], dict[int, float]],
        dt: float,
    ) -> None:
        """Count objects by id: their class, the bin of their detection, and whether they were in view."""
        needed = needed_shares(self.state)
        for one in before.keys() - objects.keys():
            for _ in range(2):
                self.end_slot(one, before[one], needed[before[one]], speeds[0][one])
            del self.slots[one]
        for one, (c, b, looked) in objects.items():
            self.seconds[one] = self.seconds[one] + dt if one in self.slots else 0.0
            slots = self.slots.setdefault(one, [[[], 0], [[], 0], [[], 0]])
            if self.seconds[one] >= 0.99 and slots[2][1] > 1:
                self.end_slot(one, c, needed[c], speeds[1][one])
            self.slots[one][2][1] += looked
            self.slots[one][2][0] += [] if b is None else [b]

    def forget(self) -> None:
        """Bound the counts."""
        for c in range(2):
            for first, end in ((DETECTIONS, GIVEN), (GIVEN, HITS), (HITS, COUNTS)):
                self.state[c, first:end] *= min(1.0, MASS / self.state[c, first].sum())


def objects_of(labels: dict[int, int], mean: Array) -> Bernoullis:
    """Objects with these ids, classes and states, of a score of one."""
    columns = {"id": np.array([*labels], np.int64), "label": np.array([*labels.values()], np.int64), "mean": mean}
    return Bernoullis.of(np.zeros(len(labels) * Bernoullis.width)).replaced(**columns, score=np.ones(len(labels)))


@SEEDS
def test_frames_are_counted_as_plain_python_counts(seed: int) -> None:
    """Slots of objects that stay, come and go; components that age; detections without use; forgetting."""
    rng = np.random.default_rng(seed)
    state = 2.0 * counts(rng)
    plain = Counting(state.copy())
    before, known, mean = np.zeros((0, SLOTS, SLOT), np.uint16), dict[int, int](), np.zeros((0, STATE))
    announced, announced_label = np.zeros(0, np.int64), np.zeros(0, np.int64)
    for k in range(60):
        dt, count = float(rng.choice([0.1, 0.3])), int(rng.integers(4, 12))
        score, label = rng.uniform(0.01, 0.99, count + 3), rng.integers(0, 2, count + 3)
        rows, own_bin = rng.permutation(count + 3)[:count], bins(score)
        now = {one: c for one, c in known.items() if rng.random() < 0.97} | {3 * k: 0, 3 * k + 1: 1}
        mean_before, mean = mean, rng.normal(0.0, WALK, (len(now), STATE))
        hit = np.r_[rng.permutation(count), np.full(len(now), -1)][: len(now)]
        looked = (rng.random(len(now)) < 0.9) | (hit >= 0)
        free = ~np.isin(np.arange(count), hit)
        fate = np.r_[rng.choice([AGED, MARKED, 0], len(announced)), np.where(free & (rng.random(count) < 0.5), 0, AGED)]
        fate[fate == 0] = np.arange((fate == 0).sum())
        of_old, of_new = np.split(fate, [len(announced)])

        np.add.at(plain.state, (label, GIVEN, own_bin), 1.0)
        found = [None if m < 0 else int(own_bin[rows[m]]) for m in hit]
        speeds = dict(zip(known, mean_before[:, V], strict=True)), dict(zip(now, mean[:, V], strict=True))
        plain.follow(known, dict(zip(now, zip(now.values(), found, looked, strict=True), strict=True)), speeds, dt)
        gone = (of_old == AGED) & (announced != NO_BIN)
        np.add.at(plain.state, (announced_label[gone], DETECTIONS, announced[gone]), min(1, 10 * dt))
        gone = rows[free & (of_new == AGED)]
        np.add.at(plain.state, (label[gone], DETECTIONS, own_bin[gone]), min(1, 10 * dt))
        plain.forget()

        meant, given = rng.uniform(0.1, 1.0, len(score)), (state, before, announced)
        old, new = objects_of(known, mean_before), objects_of(now, mean)
        after, detections = (new.words, hit, looked), (score, meant, label, rows)
        components = announced_label, fate, int((fate >= 0).sum())
        state, before, kept = learn(given, old.words, after, components, detections, dt)
        np.testing.assert_allclose(new.score, np.where(hit < 0, 1.0, (score / meant)[rows[hit]]), rtol=1e-15)
        announced = np.r_[announced[of_old >= 0], own_bin[rows[of_new >= 0]]]
        announced_label = np.r_[announced_label[of_old >= 0], label[rows[of_new >= 0]]]
        known = now
        np.testing.assert_allclose(state, plain.state, rtol=1e-9)
        np.testing.assert_array_equal(kept, announced)
        for own, one in zip(before, now, strict=True):
            for slot, (hits, looks) in zip(own, plain.slots[one], strict=True):
                np.testing.assert_array_equal(slot[:BINS], np.bincount(hits, minlength=BINS))
                assert slot[OF_LOOKS] == looks
            assert own[-1, TICKS] == round(1e4 * plain.seconds[one])


@SEEDS
def test_scatter_is_summed_over_sure_pairs_as_in_numpy(seed: int) -> None:
    """Tracks that are confirmed, a second old and detected twice in a row; products with their innovations before."""
    rng, count, second = np.random.default_rng(seed), 40, 10**9
    now, before = 20 * second, 19 * second
    root = rng.normal(0.0, 0.3, (count, 6, 6))
    prior = Bernoullis.of(np.zeros(count * Bernoullis.width)).replaced(
        id=2 + 2 * np.arange(count),
        mean=rng.normal(0.0, 0.5, (count, 6)),
        covariance=root @ np.swapaxes(root, 1, 2),
        confirmed=rng.random(count) < 0.8,
        seen_ns=np.where(rng.random(count) < 0.8, before, before - second),
        born_ns=rng.choice([now - second // 2, now - second, now - 2 * second], count),
    )
    old = Bernoullis.of(np.zeros((count + 9) * Bernoullis.width)).replaced(
        id=np.sort(np.r_[prior.id, 1 + 8 * np.arange(9)])
    )
    last = rng.normal(0.0, 0.5, (count + 9, 2))
    row = np.r_[np.sort(rng.choice(count, 30, replace=False)), [-1, -1]]
    objects = Bernoullis.of(np.zeros(32 * Bernoullis.width)).replaced(
        mean=rng.normal(0.0, 0.5, (32, 6)), label=rng.integers(0, 2, 32)
    )
    measurement = np.where(rng.random(32) < 0.9, rng.permutation(32), -1)
    own = np.where(rng.random(32) < 0.2, 2.0, 1.0)
    position = np.column_stack((rng.normal(0.0, 0.5, (32, 2)), own, np.zeros(32), own))
    scatter, lagged = np.array([[10.0, 0.5, 0.2], [MASS, 50.0, 400.0]]), np.array([[8.0, -3.0], [20.0, 40.0]])
    noise, known = np.array([0.3, 0.25]), squares(scatter, lagged)
    np.testing.assert_allclose(known - scatter, np.column_stack((np.zeros(2), np.maximum(lagged, 0.0))))
    hits, rows, words = (row, measurement), class_rows(2, noise_position=noise), (old.words, prior.words, objects.words)
    found, products, kept = learn_scatter((scatter, lagged), last, words, hits, position, (now, before), rows)

    k = np.flatnonzero((row >= 0) & (measurement >= 0))
    n, m = row[k], measurement[k]
    axis, c = np.exp(-1j * objects.mean[k, PHI]), objects.label[k]
    nu, residual = (((position[m, :2] - one[:, :2]) @ [1, 1j]) * axis for one in (prior.mean[n], objects.mean[k]))
    wanted = np.zeros((32, 2))
    wanted[k] = np.column_stack((nu.real, nu.imag))
    np.testing.assert_allclose(kept, wanted, atol=1e-12)
    sure = prior.confirmed[n] & (prior.seen_ns[n] == before) & (now - prior.born_ns[n] >= second) & (own[m] == 1.0)
    k, n, nu, residual, c = k[sure], n[sure], nu[sure], residual[sure], c[sure]
    most = OUTLYING * (PRIOR_PAIRS * noise[:, None] ** 2 + known[:, 1:]) / (PRIOR_PAIRS + scatter[:, :1])
    squared = np.column_stack((nu.real * residual.real, nu.imag * residual.imag))
    added = np.zeros((2, 5))
    np.add.at(added[:, :3], c, np.column_stack((np.ones(len(k)), np.clip(squared, 0.0, most[c]))))
    spread = (0.5 * np.trace(prior.covariance[n, :2, :2], axis1=1, axis2=2) + noise[c] ** 2)[:, None]
    turned = np.column_stack((axis[sure].real, -axis[sure].imag))
    gain = np.clip((turned * prior.covariance[n, V, :2]).sum(axis=1)[:, None] / spread, 0.0, 1.0)
    lag = -np.column_stack((nu.real, nu.imag)) * last[np.searchsorted(old.id, prior.id[n])]
    np.add.at(added[:, 3:], c, np.clip(lag, -OUTLYING * spread, OUTLYING * spread) / (1.0 + gain) ** 2)
    both = np.column_stack((scatter, lagged)) + added
    both *= np.minimum(1.0, MASS / both[:, :1])
    assert len(k) > 2
    np.testing.assert_allclose(np.column_stack((found, products)), both, rtol=1e-9)


def test_learned_noise_goes_to_the_state_the_box_and_the_covariance() -> None:
    """R and R' are the scatter, with the profile's for fifty pairs; lasting errors keep their shape over the knots."""
    scatter = np.array([[150.0, 12.0, 6.0], [0.0, 0.0, 0.0], [1e3, 1e-3, 1e-3], [1e3, 1e5, 1e5]])
    curve = np.zeros((4, 32))
    curve[:, :2] = [0.3, 0.15]
    left = 1.0 / (1.0 / 0.06**2 - 1.0 / 0.3**2)
    columns = {"noise_position": 0.3, "reported_position": left, "knots": 2, "knot_along": curve, "knot_across": curve}
    columns |= {"gate": 3.0, "clutter_intensity": 0.01, "birth_intensity": 0.002}
    rows = class_rows(4, **columns)
    use_scatter(scatter, rows)
    for own, one in zip(rows, scatter, strict=True):
        if not one[0]:
            assert own == class_rows(4, **columns)[1]
            continue

        def mean(prior: float, one: Array = one) -> float:
            variances = np.clip((50.0 * prior**2 + one[1:]) / (50.0 + one[0]), LEAST_NOISE**2, MOST_NOISE**2)
            assert learned(one, ALONG, prior**2) == pytest.approx(variances[0], rel=1e-12)
            return float(variances.mean())

        measured, reported = max(mean(0.3), LEAST_PART * 0.3**2), mean(0.06)
        assert own["noise_position"] ** 2 == pytest.approx(measured, rel=1e-12)
        assert own["gate"] == pytest.approx(max(3.0, math.sqrt(2.0 * 9.21 * measured)))
        assert own["clutter_intensity"] == pytest.approx(0.01 * 0.3**2 / measured)
        assert own["birth_intensity"] == pytest.approx(0.002 * 0.3**2 / measured)
        of_box = 1.0 / (1.0 / own["reported_position"] + 1.0 / measured) if own["reported_position"] else measured
        assert of_box == pytest.approx(min(reported, measured), rel=1e-9)
        for s, name in ((1, "knot_along"), (2, "knot_across")):
            variance = min((50.0 * 0.15**2 + LASTING_RATIO[s] ** 2 * one[s]) / (50.0 + one[0]), MOST_NOISE**2)
            assert lasting(one, s, 0.15) == pytest.approx(variance, rel=1e-12)
            np.testing.assert_allclose(own[name][:2], np.sqrt(variance) * np.array([0.3, 0.15]) / 0.15, rtol=1e-12)


def test_errors_of_metres_are_learned() -> None:
    """Of boats in a radar that turns every two seconds: scatter from a metre to four, and ellipses that hold most."""
    rng, tracker = np.random.default_rng(0), optipmb.OnlineTracker(optipmb.generic_parameters(["boat"], 2.0))
    start, velocity, within = rng.uniform(-800.0, 800.0, (8, 2)), rng.uniform(-5.0, 5.0, (8, 2)), []
    for k in range(150):
        place = start + 2.0 * k * velocity
        off = place + 3.0 * rng.standard_normal((8, 2))
        tracks = tracker.update(t=2.0 * k, x=off[:, 0], y=off[:, 1], score=[0.9] * 8, label=["boat"] * 8)
        if k >= 75:
            wrong = tracks.center[:, :2] - place[tracks.detection]
            squared = (wrong * np.linalg.solve(tracks.covariance[:, :2, :2], wrong[..., None])[..., 0]).sum(axis=1)
            within.extend(squared[tracks.detection >= 0] <= 5.99)
    own = tracker.density.self_calibration
    assert own is not None
    pairs, along, across = squares(own.scatter, own.lagged)[0]
    assert 1.0 < math.sqrt(0.5 * (along + across) / pairs) < 4.0
    assert np.mean(within) > 0.6


def test_the_noise_of_long_objects_is_learned_across_their_heading() -> None:
    """Ships, whose centres are uncertain along the heading, teach the scatter of their boxes across it."""
    rng, tracker = np.random.default_rng(0), optipmb.OnlineTracker(optipmb.generic_parameters(["boat"], 0.5))
    for k in range(200):
        along, across = rng.normal(0.0, 1.0, 4), rng.normal(0.0, 0.8, 4)
        center = np.column_stack((2.0 * k + along, 100.0 * np.arange(4) + across, np.zeros(4)))
        boxes = {"center": center, "size": [[25.0, 6.0, 4.0]] * 4, "yaw": np.zeros(4), "score": [0.9] * 4}
        tracker.update(boxes, t=0.5 * k, label=["boat"] * 4)
    own = tracker.density.self_calibration
    assert own is not None
    pairs, _, across = own.scatter[0]
    assert pairs > 500.0
    assert 0.6 < np.sqrt(across / pairs) < 1.0


@pytest.mark.parametrize("noise", [0.15, 0.4])
def test_white_noise_is_learned_and_smoothed(noise: float) -> None:
    """Of objects at constant velocity: the scatter is the noise to a quarter, and tracks are nearer than boxes."""
    rng, tracker = np.random.default_rng(0), optipmb.OnlineTracker(PARAMETERS)
    start, velocity = np.array([[10.0, -20.0], [40.0, 10.0], [0.0, 30.0]]), np.array([[8.0, 0.0], [-12, 3], [5, 5]])
    errors = []
    for k in range(200):
        place = start + 0.1 * k * velocity
        off = noise * rng.standard_normal((3, 2))
        yaw, size = np.arctan2(velocity[:, 1], velocity[:, 0]), [[4.5, 1.9, 1.6]] * 3
        center = np.column_stack((place + off, np.zeros(3)))
        tracks = tracker.update(t=0.1 * k, center=center, size=size, yaw=yaw, score=[0.9] * 3, label=["car"] * 3)
        if k >= 80:
            own = tracks.detection
            errors.append((((tracks.center[:, :2] - place[own]) ** 2).sum(), (off[own] ** 2).sum()))
    of_tracks, of_boxes = np.sum(errors, axis=0)
    assert np.sqrt(of_tracks / of_boxes) < 0.8
    calibration = tracker.density.self_calibration
    assert calibration is not None
    pairs, along, across = calibration.scatter[0]
    assert np.sqrt((along + across) / (2.0 * pairs)) == pytest.approx(noise, rel=0.25)
    assert calibration.scatter.shape == (2, SCATTER)


CLASSES = ("car", "pedestrian")
PARAMETERS = optipmb.generic_parameters(CLASSES, 0.1)


def street(frames: int, scale: float = 1.0, seed: int = 0, clutter: int = 8) -> Iterator[dict[str, Any]]:
    """Ten parked cars, seen in nine frames of ten with scores about 0.8, and false detections with scores about 0.3."""
    rng = np.random.default_rng(seed)
    places = np.column_stack((20.0 * np.arange(10), np.zeros(10)))
    for k in range(frames):
        seen = rng.random(10) < 0.9
        false = rng.uniform((0, 20), (200, 100), (clutter, 2))
        center = np.vstack((places[seen] + rng.normal(0, 0.1, (seen.sum(), 2)), false))
        score = scale * np.r_[rng.uniform(0.7, 0.9, seen.sum()), rng.uniform(0.2, 0.4, clutter)]
        yield {
            "stamp_ns": k * 100_000_000,
            "labels": CLASSES,
            "label": np.zeros(len(score), np.int64),
            "center": np.column_stack((center, np.ones(len(score)))),
            "size": np.tile([4.0, 1.8, 1.6], (len(score), 1)),
            "yaw": np.zeros(len(score)),
            "score": score,
        }


def run(parameters: optipmb.Parameters, frames: Iterator[dict[str, Any]]) -> list[optipmb.StepResult]:
    """Track frames."""
    tracker = optipmb.Tracker(parameters)
    density, results = tracker.initial(), []
    for one in frames:
        results.append(tracker.step(density, optipmb.make_frame(parameters, **one)[0]))
        density = results[-1].density
    return results


@pytest.mark.parametrize("scale", [1.0, 0.4, 0.1])
def test_confirmed_tracks_are_the_objects_whatever_the_scale_of_the_scores(scale: float) -> None:
    """After five seconds all cars are confirmed and nothing else is; published scores remain the detector's."""
    last = run(PARAMETERS, street(60, scale))[-1].tracks
    assert last.confirmed.sum() == 10
    assert (last.center[last.confirmed, 1] < 5.0).all()
    assert (last.existence[last.confirmed] > 0.7).all()
    assert last.score.max() <= 0.9 * scale


@pytest.mark.parametrize("speed", [1.0, 0.0])
@pytest.mark.parametrize("label", range(2))
def test_what_stands_is_no_person_where_people_walk(label: int, speed: float) -> None:
    """Boxes that stand and score less than six walkers are clutter; not of cars, and not where all stand."""
    rng, velocity = np.random.default_rng(0), np.r_[np.full(6, speed), np.zeros(4)]

    def frames() -> Iterator[dict[str, Any]]:
        for k in range(100):
            score = np.r_[rng.uniform(0.7, 0.9, 6), rng.uniform(0.3, 0.45, 4)]
            center = np.column_stack((0.1 * k * velocity, 20.0 * np.arange(10), np.ones(10)))
            center[:, :2] += rng.normal(0.0, 0.05, (10, 2))
            boxes = {"label": [label] * 10, "center": center, "size": [[0.7, 0.7, 1.75]] * 10, "yaw": [0.0] * 10}
            yield {"stamp_ns": k * 100_000_000, "labels": CLASSES, "score": score, **boxes}

    last = run(PARAMETERS, frames())[-1].tracks
    confirmed = np.sort(np.rint(last.center[last.confirmed, 1] / 20.0))
    np.testing.assert_array_equal(confirmed, np.arange(6 if label and speed else 10))


def test_a_profile_that_does_not_calibrate_counts_nothing() -> None:
    """Neither the density nor its bytes have counts; a density that has some goes on without."""
    plain = PARAMETERS.model_copy(update={"self_calibration": False})
    results = run(plain, street(3))
    assert results[-1].density.self_calibration is None
    assert set(optipmb.bytes_of(results[-1].density)) == {"bernoulli", "poisson"}
    counted = run(PARAMETERS, street(3))[-1].density
    frame, _ = optipmb.make_frame(plain, **list(street(4))[-1])
    assert optipmb.Tracker(plain).step(counted, frame).density.self_calibration is None


def test_a_stored_density_goes_on_to_the_last_bit() -> None:
    """Bytes make the same density again, and the next frames give the same bytes."""
    frames = list(street(40))
    wanted = run(PARAMETERS, iter(frames))
    density = wanted[24].density
    columns = optipmb.columns_in(optipmb.bytes_of(density), len(CLASSES))
    for name, column in optipmb.columns_of(density).items():
        np.testing.assert_array_equal(columns[name], column, err_msg=name)
    density, tracker = (
        optipmb.density_of(density.stamp_ns, density.next_id, columns, CLASSES),
        optipmb.Tracker(PARAMETERS),
    )
    for one in frames[25:]:
        density = tracker.step(density, optipmb.make_frame(PARAMETERS, **one)[0]).density
    assert optipmb.bytes_of(density) == optipmb.bytes_of(wanted[-1].density)


def test_learned_noise_is_said_in_words_by_class() -> None:
    """The line of a class has its own scatter; a class with few pairs has none, nor a density without counts."""
    density = run(PARAMETERS, street(1))[-1].density
    own = density.self_calibration
    assert own is not None
    scatter = np.array([[PRIOR_PAIRS - 1, 9.0, 9.0], [100.0, 100 * 0.3**2, 100 * 0.5**2]])
    known = replace(density, self_calibration=replace(own, scatter=scatter, lagged=np.zeros_like(own.lagged)))
    assert learned_noise(known) == (f"{CLASSES[1]}: 0.41 m scatter, 0.34 m lasting",)
    assert learned_noise(replace(density, self_calibration=None)) == ()


def test_wrong_counts_are_refused_by_name() -> None:
    """Another shape or type, negative or endless counts, bins that there are not; the tracker refuses misfits too."""
    density = run(PARAMETERS, street(5))[-1].density
    columns = optipmb.columns_of(density)
    for part in ("classes", "objects", "components", "scatter"):
        name = f"calibration.{part}"
        good = columns[name]
        beyond = [] if part == "objects" else [-2 - good, np.full_like(good, 10**12)]  # in slots it fits
        for wrong in (good[:-1], good.astype(np.float32), None, *beyond):
            with pytest.raises(optipmb.DensityError, match=name.replace(".", r"\.")):
                optipmb.density_of(density.stamp_ns, density.next_id, columns | {name: wrong}, CLASSES)
        assert density.self_calibration is not None
        other = replace(density, self_calibration=replace(density.self_calibration, **{part: good[:-1]}))
        frame, _ = optipmb.make_frame(PARAMETERS, **list(street(6))[-1])
        with pytest.raises(optipmb.DensityError):
            optipmb.Tracker(PARAMETERS).step(other, frame)


def test_the_order_of_detections_changes_nothing() -> None:
    """Counts are sums over bins: a detector may list its boxes in any order."""
    rng = np.random.default_rng(1)

    def shuffled() -> Iterator[dict[str, Any]]:
        for one in street(30):
            order = rng.permutation(len(one["score"]))
            columns = ("label", "center", "size", "yaw", "score")
            yield one | {name: one[name][order] for name in columns}

    found, wanted = run(PARAMETERS, shuffled())[-1].density, run(PARAMETERS, street(30))[-1].density
    assert optipmb.bytes_of(found) == optipmb.bytes_of(wanted)


@pytest.mark.parametrize("modules", [optipmb.Modules(habm=False), optipmb.Modules(rpp=False)])
def test_scores_are_calibrated_with_any_modules(modules: optipmb.Modules) -> None:
    """Components made by measurements, and removed ones, leave counts that fit the density."""
    tracker = optipmb.Tracker(optipmb.load_profile("generic"), modules)
    density, place = tracker.initial(), np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 30.0, 0.0]])
    for k in range(12):
        frame, _ = optipmb.make_frame(
            tracker.parameters,
            stamp_ns=k * 100_000_000,
            labels=("car",),
            label=[0, 0, 0],
            center=place,
            size=[[4.0, 2.0, 1.5]] * 3,
            yaw=[0.0] * 3,
            score=[0.9, 0.3, 0.6],
        )
        density = tracker.step(density, frame).density
    assert density.self_calibration is not None
    assert len(density.self_calibration.components) == len(density.poisson)
