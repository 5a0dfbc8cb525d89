"""Smoothing of finished tracks, for labellers: every state given all frames of its track, not only the earlier ones.

The unscented Rauch-Tung-Striebel smoother (Särkkä, "Unscented Rauch-Tung-Striebel smoother", IEEE Transactions on
Automatic Control 53(3), 2008), with the motion models of the tracker. From the last state of a track to its first,

    X = m_k +- sqrt(n) S_k,  P_k = S_k S_k'        sigma points, as in `optipmb.filter.predict`
    m-, P-                                         mean and covariance of f(X); P- with Q
    D   = sum w (X - m_k) (f(X) - m-)'
    G   = D (P-)^-1
    m^s_k = m_k + G (m^s_{k+1} - m-)
    P^s_k = P_k + G (P^s_{k+1} - P-) G'

m_k and P_k are the state and covariance of every frame in which the filter holds the object; in frames in which it is a
track, state and covariance of its published box (`optipmb.filter.calibration`). So frames without detection need no
rule of their own.

An object does not turn by pi from frame to frame, so one sign of the heading holds for the whole track: the one in
favour of which the mean of the log odds (`optipmb.filter.lightweight`) is; and this mean is the confidence in it.

Size, height, existence and score stay as the tracker tells them.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np

from optipmb import Density, Parameters, Tracks
from optipmb.filter.calibration import calibrate_rows
from optipmb.filter.lightweight import doubt, sign_probability
from optipmb.filter.predict import ORDER, SPREAD, WEIGHT, predict_state
from optipmb.model.density import OMEGA, PHI, STATE, A, V
from optipmb.model.table import ClassTable
from optipmb_tools.geometry import Bools, Floats, Ints, wrap_angle

_TURN: Final = np.array([-1.0 if s in {V, A} else 1.0 for s in range(STATE)])
"""Diagonal of T: x -> T x and phi + pi describes the same motion (`optipmb.filter.lightweight`)."""


class Smoother:
    """Collects the frames of one sequence, in order, and returns their tracks smoothed."""

    def __init__(self, parameters: Parameters) -> None:
        self._table = ClassTable.of(parameters)
        self._frames: list[tuple[int, Density, Tracks]] = []

    def add(self, index: int, density: Density, tracks: Tracks) -> None:
        """Take the posterior and the tracks of frame `index`."""
        self._frames.append((index, density, tracks))

    def tracks(self) -> Iterator[tuple[int, Tracks]]:
        """Yield index and tracks of every frame; the same tracks as were taken, with other motion states."""
        if not self._frames:
            return
        objects = [density.bernoulli for _, density, _ in self._frames]
        counts = [len(one) for one in objects]
        starts = np.concatenate(([0], np.cumsum(counts)))[:-1]
        rows = [
            start + np.searchsorted(one.id, tracks.id)
            for start, one, (*_, tracks) in zip(starts, objects, self._frames, strict=True)
        ]
        shown, extracted = np.concatenate(rows), _joined([tracks for *_, tracks in self._frames])
        evidence = np.concatenate([one.evidence for one in objects])[shown]
        label = np.concatenate([one.label for one in objects])
        mean = np.concatenate([one.mean for one in objects])
        covariance = np.concatenate([one.covariance for one in objects])
        mean[shown, :2], mean[shown, PHI] = extracted.center[:, :2], extracted.yaw  # speeds stay the filter's
        factors = self._factors(extracted.label)
        lasting = self._lasting(extracted.label, evidence, extracted.yaw)
        covariance[shown] = (extracted.covariance - lasting) / factors
        covariance[shown, PHI, PHI] -= [doubt(p) for p in extracted.heading_confidence.tolist()]
        odds = smooth(
            np.concatenate([one.id for one in objects]),
            np.repeat(np.array([density.stamp_ns for _, density, _ in self._frames]), counts),
            label,
            np.concatenate([one.heading_odds for one in objects]),
            mean,
            covariance,
            self._table,
        )
        confidence = np.array([sign_probability(h) for h in odds[shown].tolist()])
        confidence[self._table["sign_memory"][extracted.label] == 0.0] = 1.0
        covariance[shown] *= factors
        covariance[shown] += self._lasting(extracted.label, evidence, mean[shown, PHI])
        covariance[shown, PHI, PHI] += [doubt(p) for p in confidence.tolist()]
        start = 0
        for (index, _, tracks), chosen in zip(self._frames, rows, strict=True):
            end = start + len(chosen)
            yield index, _with_motion(tracks, mean[chosen], covariance[chosen], confidence[start:end])
            start = end

    def _lasting(self, label: Ints, evidence: Floats, yaw: Floats) -> Floats:
        """Return what the calibration adds to the covariances (N, 6, 6) of tracks with these headings (N,)."""
        lasting, unused = np.zeros((len(label), STATE, STATE)), np.empty((2, len(label)))
        still = np.zeros((len(label), 2))
        calibrate_rows(label, evidence, yaw, self._table.classes, unused[0], unused[1], still, lasting)
        return lasting

    def _factors(self, label: Ints) -> Floats:
        """Return the factors of the calibration on the covariances (N, 6, 6) of tracks."""
        factors = np.ones((len(label), STATE))
        known = self._table["knots"][label] > 0
        for s, name in ((V, "factor_speed"), (OMEGA, "factor_turn_rate")):
            factors[known, s] = self._table[name][label[known]]
        return np.asarray(factors[:, :, None] * factors[:, None, :])


def smooth(
    identity: Ints,
    stamp_ns: Ints,
    label: Ints,
    heading_odds: Floats,
    mean: Floats,
    covariance: Floats,
    table: ClassTable,
) -> Floats:
    """Smooth the states of objects in place.

    Args:
        identity: (R,) ids of the objects.
        stamp_ns: (R,) stamps of their frames, for each id in the order of the frames.
        label: (R,) classes.
        heading_odds: (R,) log odds that the object faces along phi.
        mean: (R, 6) filtered [x, y, v, phi, omega, a], world frame, m, rad, s; receives m^s.
        covariance: (R, 6, 6) of those; receives P^s.
        table: parameters as columns.

    Returns:
        (R,) log odds that the object faces along the smoothed phi, the same in every frame of a track.
    """
    order = np.argsort(identity, kind="stable")
    before, after = order[:-1], order[1:]
    known = covariance[:, OMEGA, OMEGA] != 0.0  # states of unknown heading stay (`optipmb.filter.unknown_heading`)
    follows = (identity[before] == identity[after]) & known[before] & known[after]
    before, after = before[follows], after[follows]
    predicted, spread, gain = _predictions(
        mean[before], covariance[before], (stamp_ns[after] - stamp_ns[before]) * 1e-9, label[before], table
    )
    turned = np.zeros(len(identity), dtype=np.bool_)  # whether the filter turned the state since the frame before
    for step in _backwards(identity[order], follows):
        k, n = before[step], after[step]
        turned[n] = np.cos(mean[n, PHI] - predicted[step, PHI]) < 0.0
        later, later_spread = _turned(mean[n], covariance[n], turned[n])
        change = later - predicted[step]
        change[:, PHI] = wrap_angle(change[:, PHI])
        mean[k] += np.einsum("nij,nj->ni", gain[step], change)
        covariance[k] += gain[step] @ (later_spread - spread[step]) @ gain[step].transpose(0, 2, 1)
    _, group, lengths = np.unique(identity[order], return_inverse=True, return_counts=True)
    first = np.concatenate(([0], np.cumsum(lengths)))[:-1]
    turns = np.cumsum(turned[order])
    side = 1.0 - 2.0 * ((turns - turns[first][group]) % 2)  # relative to the first state of the track
    odds = np.bincount(group, side * heading_odds[order]) / lengths
    wrong = order[side * np.where(odds < 0.0, -1.0, 1.0)[group] < 0.0]
    mean[wrong], covariance[wrong] = _turned(mean[wrong], covariance[wrong], np.ones(len(wrong), dtype=np.bool_))
    mean[:, PHI] = wrap_angle(mean[:, PHI])
    result = np.empty(len(identity))
    result[order] = np.abs(odds)[group]
    return result


def _predictions(
    mean: Floats, covariance: Floats, dt: Floats, label: Ints, table: ClassTable
) -> tuple[Floats, Floats, Floats]:
    """Return m- (R, 6), P- (R, 6, 6) and G (R, 6, 6) of filtered states, each over its own time dt (R,), s."""
    root, points = buffers = np.empty((STATE, STATE)), np.empty((2 * STATE, STATE))
    predicted, spread, cross = np.empty_like(mean), np.empty_like(covariance), np.empty_like(covariance)
    for row, c in enumerate(label.tolist()):
        own = table.classes[c]
        predict_state(mean[row], covariance[row], dt[row], own, buffers, predicted[row], spread[row])
        # The deviations X - m_k are SPREAD times the columns of the root, once plus and once minus.
        cross[row, ORDER] = root @ (points[0::2] - points[1::2]) * (SPREAD * WEIGHT)
    gain = np.linalg.solve(spread, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    return predicted, spread, np.asarray(gain, dtype=np.float64)


def _backwards(identity: Ints, follows: Bools) -> Iterator[Ints]:
    """Yield the pairs of neighbouring states, of all tracks side by side, from the ends of the tracks on.

    Args:
        identity: (R,) ids, sorted by track.
        follows: (R - 1,) whether a state is followed by one of the same id: the pairs.
    """
    end = np.concatenate((np.flatnonzero(identity[1:] != identity[:-1]), [len(identity) - 1]))
    place = np.arange(len(identity) - 1)[follows]
    left = end[np.searchsorted(end, place)] - place
    by_distance = np.argsort(left, kind="stable")
    yield from np.split(by_distance, np.flatnonzero(np.diff(left[by_distance])) + 1)


def _turned(mean: Floats, covariance: Floats, turn: Bools) -> tuple[Floats, Floats]:
    """Return the states with the opposite heading where `turn` (N,) says so."""
    mean, covariance = mean.copy(), covariance.copy()
    mean[turn] *= _TURN
    mean[turn, PHI] += np.pi
    covariance[turn] *= _TURN[:, None] * _TURN
    return mean, covariance


def _joined(parts: list[Tracks]) -> Tracks:
    return Tracks(**{name: np.concatenate([getattr(one, name) for one in parts]) for name in Tracks.described})


def _with_motion(tracks: Tracks, mean: Floats, covariance: Floats, confidence: Floats) -> Tracks:
    yaw, speed = mean[:, PHI], mean[:, V]
    return tracks.replaced(
        center=np.column_stack((mean[:, :2], tracks.center[:, 2])),
        yaw=yaw,
        heading_confidence=confidence,
        velocity=np.column_stack((speed * np.cos(yaw), speed * np.sin(yaw))),
        yaw_rate=mean[:, OMEGA],
        acceleration=mean[:, A],
        covariance=covariance,
    )
