"""The calibration of one class (`optipmb.filter.calibration`) from training data.

Everything is tracked once for each memory that is tried. Then, of the tracks by their evidence:

- existence: isotonic regression (Barlow et al., 1972) of being matched to an object on the evidence, put in a few
  knots, one for each range of probability that occurs. The memory is the one with the least log loss in sequences that
  are left out in turn.
- along, across: in each fifth of the matched tracks, the standard deviation that has to be added to the filter's for
  the mean squared error to be the expected one, NEES = 2; then both times one factor, so that NEES = 2 in sequences
  that are left out in turn, too, where errors are always a little larger than where they were measured.
- speed, turn_rate: the factor on the filter's standard deviation with which 95 % of the errors lie in the interval of
  95 %. Braking and turning make few errors many times as large as all others; a mean would be theirs alone. The truth
  is the motion of the label from half a second before to half a second after.

Centres within two metres match, as in `optipmb_tools.evaluation.calibration`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from scipy.optimize import brentq, isotonic_regression

from optipmb import Calibration, Parameters
from optipmb_tools.evaluation.calibration import NORMAL_95, CalibrationResult, calibration, rows_of, sample
from optipmb_tools.geometry import Bools, Floats, Ints, wrap_angle
from optipmb_tools.tuning.clips import Clip, track_clip
from optipmb_tools.tuning.scoring import Scorer, folds_of
from optipmb_tools.tuning.values import rounded, with_calibration

MEMORIES = (0.3, 0.5, 0.7, 0.8)  # tried for the weight that evidence keeps over a nominal period
MISSED = 1.0  # log odds that a miss counts for against a track
LEAST_TRACKS, LEAST_MATCHED = 200, 50  # with fewer boxes of tracks, or of tracks on objects, there is no calibration
_EDGES = (0.0, 0.05, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95, 1.0)
_LEAST_KNOT = 30  # boxes of tracks that a knot stands on
_FIFTHS = 5
_CERTAIN = (0.001, 0.999)  # beyond these no share that was measured is known
_WIDEST, _MOST = 10.0, 1.5
_HALF_WINDOW_S = 0.5
_LEVEL, _FACTORS = 0.95, (0.1, 1.0)
_UNWEIGHTED = 1e-3
"""Factor with which velocities are published as they are: the factor is measured on them."""
_NEES = 2.0
_SCALE = 28.0  # width of the evidence, from one surest to the other, as the score tells it


@dataclass(frozen=True)
class _Rows:
    """The tracks of one sequence that count."""

    evidence: Floats  # (K,)
    true: Bools  # (K,)
    error: Floats  # (H, 2) of the matched ones, along and across the heading, m
    variance: Floats  # (H, 2) that the filter expects, m^2
    mixed: Floats  # (H,) covariance of the two
    motion: Floats
    """(H, 2) errors of speed and turn rate in standard deviations of the filter; NaN where the truth is not known"""

    def __add__(self, other: "_Rows") -> "_Rows":
        return _Rows(*(np.concatenate([value, getattr(other, key)]) for key, value in vars(self).items()))


def calibrate(
    clips: Sequence[Clip], scorer: Scorer, parameters: Parameters, memory: float | None = None
) -> Calibration | None:
    """Return the calibration of a class; None where there is too little to measure. Without `memory` try several."""
    best: tuple[float, float, list[_Rows]] | None = None
    for one in MEMORIES if memory is None else (memory,):
        rows = [_rows(clip, scorer, parameters, one) for clip in clips]
        loss = 0.0 if memory is not None else _log_loss(rows)
        if best is None or loss < best[0]:
            best = (loss, one, rows)
    assert best is not None  # noqa: S101  at least one memory is tried
    everything = reduce(add, best[2])
    if len(everything.true) < LEAST_TRACKS or everything.true.sum() < LEAST_MATCHED:
        return None
    return _fitted(everything, best[1], _widening(best[2]))


def measured_calibration(clips: Sequence[Clip], scorer: Scorer, parameters: Parameters) -> CalibrationResult:
    """Return the calibration figures of the tracks of some sequences."""
    parts = []
    for clip in clips:
        tracks = track_clip(clip, parameters)
        counted = tracks.take(scorer.counts(clip, tracks))
        parts.append(calibration(clip.world, counted, tracks, scorer.name, scorer.near))
    return reduce(add, parts)


def cross_calibration(clips: Sequence[Clip], scorer: Scorer, parameters: Parameters) -> CalibrationResult:
    """Return the calibration figures where each sequence has the calibration that the others give.

    The parameters are those found on all sequences, and so is the memory. With one sequence, or without a calibration,
    the tracks are evaluated as they are.
    """
    calibration = parameters.classes[scorer.name].calibration
    if calibration is None or len(clips) == 1:
        return measured_calibration(clips, scorer, parameters)
    rows = [_rows(clip, scorer, parameters, calibration.memory) for clip in clips]
    parts = []
    for i, clip in enumerate(clips):
        rest = [one for j, one in enumerate(rows) if j != i]
        everything = reduce(add, rest)
        if everything.true.sum() >= LEAST_MATCHED:
            found = _fitted(everything, calibration.memory, _widening(rest))
            parts.append(measured_calibration([clip], scorer, with_calibration(parameters, scorer.name, found)))
    return reduce(add, parts)


def _rows(clip: Clip, scorer: Scorer, parameters: Parameters, memory: float) -> _Rows:
    """Track a sequence; the score carries the evidence."""
    probe = Calibration(
        memory=memory,
        missed=MISSED,
        score_of_evidence=1.0,
        evidence=(0.0,),
        existence=(1.0,),
        along=(0.0,),
        across=(0.0,),
        speed=_UNWEIGHTED,
    )
    full = track_clip(clip, with_calibration(parameters, scorer.name, probe))
    found = sample(clip.world, full.take(scorer.counts(clip, full)), full, scorer.name, scorer.near)
    matched, owner = found.row[found.true], found.owner[found.true]
    turn, offset = full.yaw[matched], found.offset[found.true]
    ahead = np.column_stack([np.cos(turn), np.sin(turn)])
    aside = np.column_stack([-np.sin(turn), np.cos(turn)])
    covariance = full.covariance[matched, :2, :2]
    velocity, turn_rate = _true_motion(clip, rows_of(clip.world.frame, clip.world.id, full.frame[matched], owner))
    motion = [((full.velocity[matched] - velocity) * ahead).sum(axis=1), full.yaw_rate[matched] - turn_rate]
    return _Rows(
        evidence=(full.score[found.row] - 0.5) * _SCALE,
        true=found.true,
        error=np.column_stack([(offset * ahead).sum(axis=1), (offset * aside).sum(axis=1)]),
        variance=np.column_stack([np.einsum("ni,nij,nj->n", axis, covariance, axis) for axis in (ahead, aside)]),
        mixed=np.asarray(np.einsum("ni,nij,nj->n", ahead, covariance, aside)),
        motion=np.column_stack(motion) / np.sqrt(full.covariance[matched][:, [2, 4], [2, 4]]) * (_UNWEIGHTED, 1.0),
    )


def _true_motion(clip: Clip, label: Ints) -> tuple[Floats, Floats]:
    """Return velocity (N, 2) and turn rate (N,) of some labels, by the labels half a second before and after."""
    truth, stamps = clip.world, clip.stamps * 1e-9
    apart = max(1, round(_HALF_WINDOW_S / float(np.median(np.diff(stamps))))) if len(stamps) > 1 else 1
    before, after = (
        rows_of(truth.frame, truth.id, truth.frame[label] + shift, truth.id[label]) for shift in (-apart, apart)
    )
    known = (before >= 0) & (after >= 0)
    velocity, turn_rate = np.full((len(label), 2), np.nan), np.full(len(label), np.nan)
    one, other = before[known], after[known]
    elapsed = stamps[truth.frame[other]] - stamps[truth.frame[one]]
    velocity[known] = (truth.center[other, :2] - truth.center[one, :2]) / elapsed[:, None]
    turn_rate[known] = wrap_angle(truth.yaw[other] - truth.yaw[one]) / elapsed
    return velocity, turn_rate


def _log_loss(rows: Sequence[_Rows]) -> float:
    """Return the log loss of sequences that are left out in turn, or of all where there are too few."""
    loss, count = 0.0, 0
    for rest, out in _left_out(rows):
        knots = _existence(rest)
        predicted = np.clip(np.interp(out.evidence, knots[:, 0], knots[:, 1]), 1e-3, 1.0 - 1e-3)
        loss -= float(np.log(np.where(out.true, predicted, 1.0 - predicted)).sum())
        count += len(predicted)
    return loss / max(count, 1)


def _left_out(rows: Sequence[_Rows]) -> Iterator[tuple[_Rows, _Rows]]:
    """Yield all but one sequence, and the one; where there is one alone, that for both."""
    for group in folds_of([int(one.true.sum()) for one in rows], len(rows)) or [tuple(range(len(rows)))]:
        rest = [one for i, one in enumerate(rows) if i not in group] or rows
        yield reduce(add, rest), reduce(add, [rows[i] for i in group])


def _widening(rows: Sequence[_Rows]) -> float:
    """Return the factor on the lasting error that makes NEES 2 in sequences that are left out in turn."""
    held: list[_Rows] = []
    lasting: list[Floats] = []
    for rest, out in _left_out(rows):
        if rest.true.sum() >= LEAST_MATCHED:
            knots, evidence = _lasting(rest), out.evidence[out.true]
            held.append(out)
            lasting.append(np.column_stack([np.interp(evidence, knots[:, 0], knots[:, i]) for i in (1, 2)]))
    if not held:
        return 1.0
    out, extra = reduce(add, held), np.concatenate(lasting) ** 2

    def excess(factor: float) -> float:
        along, across = (out.variance + factor**2 * extra).T
        one, other = out.error.T
        nees = (across * one**2 + along * other**2 - 2.0 * out.mixed * one * other) / (along * across - out.mixed**2)
        return float(nees.mean()) - _NEES

    if excess(1.0) <= 0.0:
        return 1.0
    return float(brentq(excess, 1.0, _MOST)) if excess(_MOST) < 0.0 else _MOST


def _fitted(rows: _Rows, memory: float, widening: float) -> Calibration:
    existence, lasting = _existence(rows), _lasting(rows) * (1.0, widening, widening)
    bends = sorted({rounded(x) for x in (*existence[:, 0].tolist(), *lasting[:, 0].tolist())})

    def column(knots: Floats, place: int) -> list[float]:
        return [rounded(float(y)) for y in np.interp(bends, knots[:, 0], knots[:, place])]

    return Calibration(
        memory=memory,
        missed=MISSED,
        evidence=tuple(bends),
        existence=tuple(np.clip(column(existence, 1), *_CERTAIN).tolist()),
        along=tuple(column(lasting, 1)),
        across=tuple(column(lasting, 2)),
        speed=_factor(rows.motion[:, 0]),
        turn_rate=_factor(rows.motion[:, 1]),
    )


def _factor(deviations: Floats) -> float:
    """Return the factor, one at most, with which 95 % of the errors lie in the interval of 95 %."""
    known = np.abs(deviations[np.isfinite(deviations)])
    if len(known) < LEAST_MATCHED:
        return 1.0
    return rounded(float(np.clip(np.quantile(known, _LEVEL) / NORMAL_95, *_FACTORS)))


def _existence(rows: _Rows) -> Floats:
    """Return knots (K, 2) of evidence and probability, both ascending."""
    order = np.argsort(rows.evidence, kind="stable")
    evidence, true = rows.evidence[order], rows.true[order].astype(np.float64)
    if not len(true):
        return np.array([[0.0, 0.5]])
    level = np.asarray(isotonic_regression(true).x, dtype=np.float64)
    cuts = [0, *(int(np.searchsorted(level, edge)) for edge in _EDGES[1:-1]), len(level)]
    knots: list[tuple[float, float]] = []
    begin = 0
    for end in cuts[1:]:
        if end - begin >= _LEAST_KNOT or (end == len(level) and end > begin and not knots):
            # One more of either kind: a share of none of a few is not zero.
            knots.append(
                (float(evidence[begin:end].mean()), float((true[begin:end].sum() + 0.5) / (end - begin + 1.0)))
            )
            begin = end
    found = np.array(knots)
    found[:, 1] = np.maximum.accumulate(found[:, 1])
    return found


def _lasting(rows: _Rows) -> Floats:
    """Return knots (K, 3) of evidence and the lasting error along and across the heading, in metres."""
    evidence = rows.evidence[rows.true]
    parts = np.array_split(np.argsort(evidence, kind="stable"), _FIFTHS)
    return np.array(
        [
            (float(evidence[part].mean()), *(_added(rows.error[part, i], rows.variance[part, i]) for i in range(2)))
            for part in parts
        ]
    )


def _added(error: Floats, variance: Floats) -> float:
    """Return the standard deviation that makes the mean of e^2 / (P + s^2) one; zero where P is enough."""

    def excess(deviation: float) -> float:
        return float((error**2 / (variance + deviation**2)).mean()) - 1.0

    if excess(0.0) <= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, _WIDEST)) if excess(_WIDEST) < 0.0 else _WIDEST
