"""Scores of an unknown detector, calibrated while the tracker runs (not in the paper).

A score of 0.4 is a sure object for one detector and a doubtful one for another. Where a profile has `self_calibration`,
every score becomes the share of the detections with such a score that were of a lasting object, before thresholds,
births and the evidence of tracks use it. Tracks still publish the scores of the detector.

Without a truth, a detection counts as one of an object when its track is detected again and again. Each object has
three slots of about a second: one is being filled, the one before it is evaluated when that ends. Its detections are
lasting if, together with the slot before or after, the object was detected in a share s of the looks at it, and at
least three times:

    s = 1 - 3 (1 - rho), from 0.4 to 0.87

rho is the share of looks in which the objects with the best scores are detected, so that a detector that misses many
objects is not taken for one that imagines them. A detection that no object uses, and that announces none within
`poisson_steps`, does not last.

The curve of a class is the isotonic regression of the shares over the log odds of the scores, with `PRIOR` detections
in each bin whose scores are right. Its largest value is `MOST`. It depends on frames of the past alone, and
the state is part of the density. Counts fade from `MASS` detections on.

Clutter that stands lasts too. Of a class whose motion is "cv", such as pedestrians, a bin below the best fifth of the
scores counts no more lasting detections than the moving ones among them tell:

    n = min(lasting, (moving + `FREE`) / mu)

mu is the share of the lasting detections of the best fifth that move, faster than `WALK` a slot later. Where it is at
most `LEAST_MOVERS`, or a class parks, standing tells nothing. The score filter and the suppression of overlapping boxes
use the curve without it, as standing boxes are of something.

Noise is learned in the same way. Of a confirmed track of at least `SURE_S` that was detected in the frame before, the
innovation nu and the residual epsilon of a detection, z less the predicted and the updated position, give its scatter
along and across the heading:

    sigma^2 = mean of nu epsilon        E[nu epsilon] = R where the filter is right

with `PRIOR_PAIRS` pairs of the profile's noise. Where the process noise of the class is more than its objects need, the
filter follows every box and takes scatter for motion. Then the innovations of neighbouring frames have opposite signs,
and their product tells what is missing. A filter that believes its boxes alone, and gives its speed the share g of an
innovation, K_v dt, has E[nu nu'] = -(1 + g)^2 R:

    sigma^2 = mean of nu epsilon + max(0, -mean of nu nu' / (1 + g)^2)

The scatter is R of the class, and R' of the published box. The errors
of a detector last, too: no filter sees the offset of a box from its object. It is larger along the heading, where half
of an object is hidden, than across. `LASTING_RATIO` times the scatter is added to the published covariance of sure
tracks; the curve of the profile tells how much more the errors of doubtful ones last.

A threshold never excludes the upper half of the scores of a class. Detections that are filtered out teach nothing, so
that otherwise a detector of low scores would remain silent for ever.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.calibration import log_odds
from optipmb.filter.hypotheses import DEVIATIONS_2
from optipmb.filter.predict import rows_within
from optipmb.filter.undetected import AGED
from optipmb.model.density import (
    BINS,
    COUNTS,
    FROM_LAST_DETECTION,
    NO_BIN,
    PHI,
    SLOT,
    SLOTS,
    Moment,
    SelfCalibration,
    V,
    X,
    Y,
    components_in,
    objects_in,
)
from optipmb.model.frame import PLAIN
from optipmb.model.rows import read_only

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.density import Density, Misses, Poissons
    from optipmb.model.frame import Frame
    from optipmb.model.rows import Array, Columns, Index
    from optipmb.model.stages import Measurements, Update
    from optipmb.model.table import Classes, ClassTable

    Slots = NDArray[np.uint16]

BIN: Final = 0.4
LOWEST: Final = -0.5 * BIN * BINS
"""Width of a bin of log odds, and the lower edge of the first."""

DETECTIONS, LASTING, MOVING, GIVEN, HITS, LOOKS = range(6)
"""Counts of a class by bin: evaluated detections, lasting ones, lasting ones whose object moves, all scores of the
detector, and hits and looks of inner slots by the mean bin of the slot."""
SLOT_TICKS: Final = 9900
"""Shortest time of a slot: a second, less the jitter of stamps, in ticks of 0.1 ms."""
OF_LOOKS, TICKS = BINS, BINS + 1
"""Columns of a slot behind the detections by bin."""
MOST_TICKS: Final = 60_000
MOST_LOOKS: Final = 60_000
"""Where the counts of a slot end."""

PRIOR: Final = 5.0
MASS: Final = 3000.0
MOST: Final = 0.985
LEAST: Final = 0.001
RISE: Final = 5e-5
"""Least slope of a curve, per unit of log odds: the order of detections stays."""
LEAST_HITS: Final = 3.0
FULL_SLOT: Final = 10.0
"""Detections of a slot, and of a second, that count in full: a fast stream does not forget sooner."""
LEAST_SHARE, MOST_SHARE, PRIOR_RECALL = 0.4, 0.87, 0.95
BEST: Final = 0.2
"""Share of the detections of a class whose scores are the best."""
WALK: Final = 0.5
"""Speed from which an object moves, m/s."""
LEAST_MOVERS: Final = 0.5
"""Least of mu."""
FREE: Final = 10.0
"""Moving detections that a bin is given, so that a few standing people of one score are not clutter."""

PAIRS, ALONG, ACROSS = range(3)
"""Columns of the scatter of a class."""
PRIOR_PAIRS: Final = 50.0
SURE_S: Final = 1.0
LEAST_NOISE, MOST_NOISE = 0.02, 10.0
"""Bounds of a learned standard deviation, m."""
OUTLYING: Final = 9.0
"""Squared standard deviations that a pair counts for at most: a half-hidden object jumps."""
LASTING_RATIO: Final = (0.0, 1.1, 0.7)
"""Lasting errors in units of the scatter, by column of it."""
LEAST_PART: Final = 1.0
"""Part of the profile's variance that R has at least, so that the box of a half-hidden object stays with its track."""


@kernel
def bin_of(score: float) -> int:
    """Return the bin of a score in (0, 1]."""
    return min(max(math.floor((log_odds(score) - LOWEST) / BIN), 0), BINS - 1)


@kernel
def best_from(counts: Array) -> int:
    """Return the lowest bin of the best fifth of the detections of a class."""
    mass, taken, b = counts[DETECTIONS].sum(), 0.0, BINS
    while b > 0 and taken < BEST * mass:
        b -= 1
        taken += counts[DETECTIONS, b]
    return b


@kernel
def of_objects(counts: Array) -> Array:
    """Return the lasting detections n of a class of walkers by bin, (`BINS`,), less standing clutter."""
    best = best_from(counts)
    out: Array = counts[LASTING].copy()
    of_best, moving = out[best:].sum(), counts[MOVING, best:].sum()
    if moving > LEAST_MOVERS * of_best:
        for b in range(best):
            out[b] = min(out[b], (counts[MOVING, b] + FREE) * of_best / moving)
    return out


@kernel
def isotonic(detections: Array, objects: Array, out: Array) -> None:
    """Write the curve of a class at the middles of the bins, (`BINS`,), by pooling neighbours."""
    share, weight, size = np.empty(BINS), np.empty(BINS), np.empty(BINS, np.int64)
    blocks = 0
    for b in range(BINS):
        meant = 1.0 / (1.0 + math.exp(-(LOWEST + (b + 0.5) * BIN)))
        weight[blocks] = detections[b] + PRIOR
        share[blocks] = (objects[b] + PRIOR * meant) / weight[blocks]
        size[blocks] = 1
        blocks += 1
        while blocks > 1 and share[blocks - 2] >= share[blocks - 1]:
            blocks -= 1
            total = weight[blocks - 1] + weight[blocks]
            share[blocks - 1] += (share[blocks] - share[blocks - 1]) * weight[blocks] / total
            weight[blocks - 1] = total
            size[blocks - 1] += size[blocks]
    b = 0
    for k in range(blocks):
        for _ in range(size[k]):
            out[b] = min(max(share[k] * MOST / share[blocks - 1], LEAST), MOST)
            b += 1


@kernel
def curves(classes: Array, label: Index, table: Classes) -> Array:
    """Return the curves of the shares that last, and of the shares of objects, (2, C, `BINS`).

    Those of classes that no detection has had, nor one of `label` (M,), are not written.
    """
    out = np.empty((2, classes.shape[0], BINS))
    for c in range(classes.shape[0]):
        if classes[c, GIVEN].sum() == 0.0 and not (label == c).any():
            continue
        isotonic(classes[c, DETECTIONS], classes[c, LASTING], out[0, c])
        if table[c].constant_velocity:
            isotonic(classes[c, DETECTIONS], of_objects(classes[c]), out[1, c])
        else:
            for b in range(BINS):
                out[1, c, b] = out[0, c, b]
    return out


@kernel
def on_curve(odds: float, curve: Array) -> float:
    """Return a curve at log odds: straight between the middles of the bins, level outside, and rising everywhere."""
    place = min(max((odds - LOWEST) / BIN - 0.5, 0.0), BINS - 1.0)
    low = min(int(place), BINS - 2)
    value: float = curve[low] + (place - low) * (curve[low + 1] - curve[low]) + RISE * odds
    return value


@kernel
def recall(counts: Array) -> float:
    """Return rho of a class."""
    best = best_from(counts)
    share: float = (PRIOR_RECALL * PRIOR + counts[HITS, best:].sum()) / (PRIOR + counts[LOOKS, best:].sum())
    return share


@kernel
def calibrate(classes: Array, score: Array, label: Index, table: Classes) -> Array:
    """Return scores (2, M) by the curves; write rho to `table`, with thresholds below the edge of the median score.

    `classes` are the counts, (C, `COUNTS`, `BINS`).
    """
    curve, out = curves(classes, label, table), np.empty((2, score.shape[0]))
    for m in range(score.shape[0]):
        odds = log_odds(score[m])
        for k in range(2):
            out[k, m] = on_curve(odds, curve[k, label[m]])
    for c in range(classes.shape[0]):
        table[c].recall = recall(classes[c])
        given = classes[c, GIVEN]
        half, below, median = 0.5 * given.sum(), 0.0, 0
        while median < BINS - 1 and below + given[median] < half:
            below += given[median]
            median += 1
        if half > 0.0:
            odds, own = LOWEST + median * BIN, table[c]
            lasting, objects = on_curve(odds, curve[0, c]), on_curve(odds, curve[1, c])
            if median == 0:
                lasting = objects = 0.0
            own.score_filter = min(own.score_filter, lasting)
            own.announce_score = min(own.announce_score, objects)
            own.birth_score = min(own.birth_score, objects)
    return out


@kernel
def calibrate_frame(
    classes: Array, sums: tuple[Array, Array], score: Array, label: Index, table: Classes
) -> tuple[Array, Array]:
    """Return the scores of `calibrate`, (M,) each, and write thresholds and learned noise to `table`.

    `sums` are `scatter` and `lagged` of `SelfCalibration`.
    """
    scatter, lagged = sums
    use_scatter(squares(scatter, lagged), table)
    lasting, meant = calibrate(classes, score, label, table)
    return lasting, meant


@kernel
def needed_shares(classes: Array) -> Array:
    """Return the share s of looks, for each class, in which a lasting object is detected."""
    needed = np.empty(classes.shape[0])
    for c in range(classes.shape[0]):
        needed[c] = min(max(1.0 - 3.0 * (1.0 - recall(classes[c])), LEAST_SHARE), MOST_SHARE)
    return needed


@kernel
def copy_rows(slots: Slots, first: int, out: Slots) -> None:
    """Copy slots from `first` on to the first rows of `out`; assigning arrays takes numba seconds to compile."""
    for s in range(first, SLOTS):
        for b in range(SLOT):
            out[s - first, b] = slots[s, b]


@kernel
def next_slot(slots: Slots, counts: Array, needed: float, speed: float) -> None:
    """Evaluate the middle of the slots of an object in the counts of its class, and begin a new slot.

    A lasting object is detected in the share `needed` of looks; `speed`: of the object now, m/s.
    """
    hits, looks = np.zeros(SLOTS), np.empty(SLOTS)
    for s in range(SLOTS):
        looks[s] = slots[s, OF_LOOKS]
        for b in range(BINS):
            hits[s] += slots[s, b]
    lasting = False
    for other in (0, 2):
        lasting |= hits[1] + hits[other] >= max(LEAST_HITS, needed * (looks[1] + looks[other]))
    if hits[1] > 0.0:
        share, mean, moves = min(FULL_SLOT / looks[1], 1.0), 0.0, lasting and abs(speed) > WALK
        for b in range(BINS):
            counts[DETECTIONS, b] += share * slots[1, b]
            counts[LASTING, b] += share * slots[1, b] * lasting
            counts[MOVING, b] += share * slots[1, b] * moves
            mean += slots[1, b] * b
        if hits[0] > 0.0 and hits[2] > 0.0:
            middle = min(max(int(mean / hits[1] + 0.5), 0), BINS - 1)
            counts[HITS, middle] += share * hits[1]
            counts[LOOKS, middle] += share * looks[1]
    copy_rows(slots, 1, slots)
    slots[SLOTS - 1] = 0


@kernel
def learn(
    counts: tuple[Array, Slots, Index],
    before_words: Array,
    after: tuple[Array, Index, NDArray[np.bool_]],
    components: tuple[Index, Index, int],
    detections: tuple[Array, Array, Index, Index],
    dt: float,
) -> tuple[Array, Slots, Index]:
    """Return the counts after a frame, and write the scores of the detector to the objects of the posterior.

    Arguments of its own:
        counts: of classes, objects and components, as in `SelfCalibration`; the classes' are written.
        before_words: array of the `Bernoullis` of the frame before.
        after: array of the posterior, and for each object its measurement, negative where missed, and whether it was in
            view, (K,).
        components: classes of the predicted components, (J,); `fate` of `update_undetected`, (J + M,); and how many
            stay, none without RPP.
        detections: scores, calibrated scores and classes of the detections, (D,), and the detection of each
            measurement, (M,).
    """
    classes, slots, bins = counts
    words, hit, looked = after
    before, objects = objects_in(before_words), objects_in(words)
    (components_label, fate, staying), (score, meant, label, rows) = components, detections
    for d in range(score.shape[0]):
        classes[label[d], GIVEN, bin_of(score[d])] += 1.0
    used, share = np.zeros(rows.shape[0], np.bool_), min(FULL_SLOT * dt, 1.0)
    lasting = needed_shares(classes)

    # Objects; their slots are evaluated at once when they end
    kept_slots = np.zeros((objects.id.shape[0], SLOTS, SLOT), np.uint16)
    n = 0
    for k in range(objects.id.shape[0] + 1):
        last = k == objects.id.shape[0]
        while n < before.id.shape[0] and (last or before.id[n] < objects.id[k]):
            own = np.empty((SLOTS, SLOT), np.uint16)
            copy_rows(slots[n], 0, own)
            for _ in range(SLOTS - 1):
                c = before.label[n]
                next_slot(own, classes[c], lasting[c], before.mean[n, V])
            n += 1
        if last:
            break
        own = kept_slots[k]
        if n < before.id.shape[0] and before.id[n] == objects.id[k]:
            copy_rows(slots[n], 0, own)
            own[SLOTS - 1, TICKS] = min(own[SLOTS - 1, TICKS] + 1e4 * dt + 0.5, MOST_TICKS)
            n += 1
        if own[SLOTS - 1, TICKS] >= SLOT_TICKS and own[SLOTS - 1, OF_LOOKS] > 1:
            c = objects.label[k]
            next_slot(own, classes[c], lasting[c], objects.mean[k, V])
        counted = own[SLOTS - 1, OF_LOOKS] < MOST_LOOKS
        own[SLOTS - 1, OF_LOOKS] += looked[k] and counted
        if hit[k] >= 0:
            d, used[hit[k]] = rows[hit[k]], True
            own[SLOTS - 1, bin_of(score[d])] += counted
            objects.score[k] *= score[d] / meant[d]

    # Components, and detections that no object uses
    bins_after, predicted = np.full(staying, NO_BIN), fate.shape[0] - rows.shape[0]
    for j in range(bins.shape[0]):
        b = min(bins[j], BINS - 1)
        if 0 <= fate[j] < staying:
            bins_after[fate[j]] = b
        elif fate[j] == AGED and b >= 0:
            classes[components_label[j], DETECTIONS, b] += share
    for m in range(rows.shape[0]):
        d, j = rows[m], fate[predicted + m]
        if 0 <= j < staying:
            bins_after[j] = bin_of(score[d])
        elif not used[m]:
            classes[label[d], DETECTIONS, bin_of(score[d])] += share

    for c in range(classes.shape[0]):
        for first, end in ((DETECTIONS, GIVEN), (GIVEN, HITS), (HITS, COUNTS)):
            mass = classes[c, first].sum()
            if mass > MASS:
                classes[c, first:end] *= MASS / mass
    return classes, kept_slots, bins_after


@kernel
def squares(scatter: Array, lagged: Array) -> Array:
    """Return the pairs of the classes and the sums of their squared scatter along and across, (C, 3), m^2."""
    out = scatter.copy()
    for c in range(out.shape[0]):
        for s in range(lagged.shape[1]):
            out[c, ALONG + s] += max(lagged[c, s], 0.0)
    return out


@kernel
def learned(own: Array, axis: int, prior: float) -> float:
    """Return the variance of a class along an axis, m^2, from its row of the scatter (3,) and the prior variance."""
    variance: float = (PRIOR_PAIRS * prior + own[axis]) / (PRIOR_PAIRS + own[PAIRS])
    return min(max(variance, LEAST_NOISE * LEAST_NOISE), MOST_NOISE * MOST_NOISE)


@kernel
def use_scatter(scatter: Array, table: Classes) -> None:
    """Write the learned noise, R, R_x and the lasting errors, to the rows of a table; `scatter` as of `squares`.

    Gates hold 99 % of the differences of two boxes. The area of the profile is for its noise: a detector with errors of
    metres looks over more water, and its clutter and births are spread over so much more.
    """
    for c in range(scatter.shape[0]):
        own = table[c]
        if scatter[c, PAIRS] == 0.0:
            continue
        measured = own.noise_position * own.noise_position
        reported = measured
        if own.reported_position > 0.0:
            reported = 1.0 / (1.0 / own.reported_position + 1.0 / measured)
        along, across = learned(scatter[c], ALONG, reported), learned(scatter[c], ACROSS, reported)
        reported = 0.5 * (along + across)
        measured = 0.5 * (learned(scatter[c], ALONG, measured) + learned(scatter[c], ACROSS, measured))
        measured = max(measured, LEAST_PART * own.noise_position * own.noise_position)
        own.clutter_intensity *= own.noise_position * own.noise_position / measured
        own.birth_intensity *= own.noise_position * own.noise_position / measured
        own.noise_position = math.sqrt(measured)
        own.reported_position = 1.0 / (1.0 / reported - 1.0 / measured) if reported < measured else 0.0
        own.gate = max(own.gate, math.sqrt(2.0 * DEVIATIONS_2 * measured))
        if own.knots > 0:
            grow(own.knot_along, own.knots, scatter[c], ALONG)
            grow(own.knot_across, own.knots, scatter[c], ACROSS)


@kernel
def grow(curve: Array, knots: int, own: Array, axis: int) -> None:
    """Scale the lasting errors of a class, m, so that those of its surest tracks are the learned ones."""
    sure = curve[knots - 1]
    factor = math.sqrt(lasting(own, axis, sure)) / sure if sure > 0.0 else 0.0
    for k in range(knots):
        curve[k] *= factor


@kernel
def lasting(own: Array, axis: int, prior: float) -> float:
    """Return the variance of the lasting error along an axis, m^2, with the standard deviation of the profile, m."""
    total = PRIOR_PAIRS * prior * prior + LASTING_RATIO[axis] ** 2 * own[axis]
    variance: float = total / (PRIOR_PAIRS + own[PAIRS])
    return min(variance, MOST_NOISE * MOST_NOISE)


@kernel
def learn_scatter(
    sums: tuple[Array, Array],
    innovations: Array,
    words: tuple[Array, Array, Array],
    hits: tuple[Index, Index],
    position: Array,
    moment: tuple[int, int],
    table: Classes,
) -> tuple[Array, Array, Array]:
    """Return scatter (C, 3) and lagged products (C, 2) with the pairs of a frame, and the innovations (K, 2).

    Arguments of its own:
        sums: `scatter` and `lagged` of `SelfCalibration`.
        innovations: of the objects of the frame before.
        words: arrays of the `Bernoullis` of the frame before, of the predicted and of the updated ones.
        hits: `row` and `measurement` of the updated ones, as in `optipmb.model.stages.Update`.
        position: (M, 2) or (M, 5) of the measurements.
        moment: stamps of the frame and of the one before.
    """
    scatter, lagged = sums
    out, products, known = scatter.copy(), lagged.copy(), squares(scatter, lagged)
    before, prior, objects = objects_in(words[0]), objects_in(words[1]), objects_in(words[2])
    (row, measurement), (stamp_ns, before_ns), b = hits, moment, 0
    kept = np.zeros((row.shape[0], lagged.shape[1]))
    for k in range(row.shape[0]):
        n, m, c = row[k], measurement[k], objects.label[k]
        if n < 0 or m < 0:
            continue
        while before.id[b] < prior.id[n]:
            b += 1
        cos, sin = math.cos(objects.mean[k, PHI]), math.sin(objects.mean[k, PHI])
        nu_x, nu_y = position[m, 0] - prior.mean[n, X], position[m, 1] - prior.mean[n, Y]
        kept[k, 0], kept[k, 1] = cos * nu_x + sin * nu_y, cos * nu_y - sin * nu_x
        if not prior.confirmed[n] or prior.seen_ns[n] != before_ns or stamp_ns - prior.born_ns[n] < SURE_S * 1e9:
            continue
        rho = 1.0
        if position.shape[1] > PLAIN:
            more_x, more_y = position[m, 2] - 1.0, position[m, 4] - 1.0
            rho += more_x + more_y
            if rho < 1.0 or abs(more_x * more_y - position[m, 3] ** 2) > 1e-9 * rho * rho:
                continue  # with a covariance of its own, not that of the class, or of a long object across its heading
        usual = table[c].noise_position ** 2
        e_x, e_y = position[m, 0] - objects.mean[k, X], position[m, 1] - objects.mean[k, Y]
        along = kept[k, 0] * (cos * e_x + sin * e_y) / rho
        across = kept[k, 1] * (cos * e_y - sin * e_x)
        out[c, PAIRS] += 1.0
        out[c, ALONG] += min(max(along, 0.0), OUTLYING * learned(known[c], ALONG, usual))
        out[c, ACROSS] += min(max(across, 0.0), OUTLYING * learned(known[c], ACROSS, usual))
        spread = 0.5 * (prior.covariance[n, X, X] + prior.covariance[n, Y, Y]) + usual
        of_speed = (cos * prior.covariance[n, V, X] + sin * prior.covariance[n, V, Y]) / spread
        gain = min(max(of_speed * (stamp_ns - before_ns) * 1e-9, 0.0), 1.0)
        for s in range(lagged.shape[1]):
            product = kept[k, s] * innovations[b, s] / (rho if s == 0 else 1.0)
            product = min(max(product, -OUTLYING * spread), OUTLYING * spread)
            products[c, s] -= product / (1.0 + gain) ** 2
    for c in range(out.shape[0]):
        if out[c, PAIRS] > MASS:
            share = MASS / out[c, PAIRS]
            for s in range(out.shape[1]):
                out[c, s] *= share
            for s in range(lagged.shape[1]):
                products[c, s] *= share
    return out, products, kept


@kernel
def learn_frame(
    counts: tuple[Array, Slots, Index, tuple[Array, Array], Array],
    prior: tuple[Array, Array, Array, Array],
    posterior: tuple[Array, Index, Index, Index, Index, int],
    detections: tuple[Array, Array, Index, Index],
    position: Array,
    moment: Columns,
    table: Classes,
) -> tuple[Array, Slots, Index, Array, Array, Array]:
    """Return the arrays of `SelfCalibration` after a frame, by `learn` and `learn_scatter`, whose arguments these are.

    Arguments of its own:
        counts: the arrays before it; `sums` and `innovations` last.
        prior: arrays of the objects and components of the frame before, and of the predicted ones.
        posterior: array of the objects; `row`, `measurement` and `fate` of `Update`; `Misses.looked_ns`, (0,) where
            every frame looks at all objects; and the number of components.
    """
    classes, slots, bins, sums, innovations = counts
    before_words, components_before, prior_words, components = prior
    (words, row, hit, fate, looked_ns, staying), now = posterior, Moment(*moment)
    looked = looked_ns == now.stamp_ns if looked_ns.shape[0] else np.ones(hit.shape[0], np.bool_)
    waiting, label = components_in(components_before), components_in(components).label
    if label.shape[0] < bins.shape[0]:
        bins = bins[rows_within(waiting.label, waiting.born_ns, now.before_ns, True, now, table)]
    given, known = (classes.copy(), slots, bins), (label, fate, staying)
    found = learn(given, before_words, (words, hit, looked), known, detections, now.dt)
    stamps = now.stamp_ns, now.before_ns
    three = before_words, prior_words, words
    scatter, lagged, kept = learn_scatter(sums, innovations, three, (row, hit), position, stamps, table)
    return (*found, scatter, lagged, kept)


class Scores(NamedTuple):
    """The scores of a frame.

    Attributes:
        before: the density that they are calibrated by.
        given: (D,) of the detector.
        lasting: (D,) shares of the detections with such scores that last.
        meant: (D,) calibrated: shares that are of objects.
        label: (D,) classes of the detections.
    """

    before: Density
    given: Array
    lasting: Array
    meant: Array
    label: Index


def calibrated(density: Density, frame: Frame, table: ClassTable) -> tuple[Scores, ClassTable]:
    """Return the calibrated scores of a frame, and parameters whose thresholds they may be compared with."""
    own, table = SelfCalibration.of(density), table.copy()
    sums = own.scatter, own.lagged
    lasting, meant = calibrate_frame(own.classes, sums, frame.score, frame.label, table.classes)
    return Scores(density, frame.score, read_only(lasting), read_only(meant), frame.label), table


def followed(
    scores: Scores,
    prior: Density,
    poisson: Poissons,
    misses: Misses | None,
    update: Update,
    measurements: Measurements,
    rows: Index,
    moment: Moment,
    table: ClassTable,
) -> SelfCalibration:
    """Return the counts after a frame, and write the scores of the detector to the objects of the new posterior.

    Arguments of its own:
        prior: the predicted density.
        poisson, misses: of the posterior.
        rows: (M,) detection of each measurement.
    """
    density, looked_ns = scores.before, FROM_LAST_DETECTION if misses is None else misses.looked_ns
    own = SelfCalibration.of(density)
    classes, objects, components, scatter, lagged, innovations = learn_frame(
        (own.classes, own.objects, own.components, (own.scatter, own.lagged), own.innovations),
        (density.bernoulli.words, density.poisson.words, prior.bernoulli.words, prior.poisson.words),
        (update.objects, update.row, update.measurement, update.fate, looked_ns, len(poisson)),
        (scores.given, scores.meant, scores.label, rows),
        measurements.position,
        tuple(moment),
        table.classes,
    )
    return SelfCalibration(classes, objects, components, scatter, innovations, lagged)


def learned_noise(density: Density) -> tuple[str, ...]:
    """Return the learned noise of the detections of each class in words, of classes with `PRIOR_PAIRS` pairs."""
    own, lines = density.self_calibration, []
    known = [] if own is None else squares(own.scatter, own.lagged).tolist()
    for name, row in zip(density.labels, known, strict=own is not None):
        if row[PAIRS] >= PRIOR_PAIRS:
            white, last = (
                math.sqrt(0.5 * (along**2 * row[ALONG] + across**2 * row[ACROSS]) / row[PAIRS])
                for along, across in ((1.0, 1.0), LASTING_RATIO[ALONG:])
            )
            lines.append(f"{name}: {white:.2f} m scatter, {last:.2f} m lasting")
    return tuple(lines)
