"""The field of view of a sensor: outside it nothing can be detected, and nothing is missed.

The detection probability of an object is ``p_d E[view]``: the share of the object that lies in the field of view, in
the mean over its uncertain position. Outside it is zero, so the object keeps its existence probability (but for
survival), its counters stand still for some seconds, and another sensor may find it again. Several sensors can so feed
one density by turns. A frame without a field of view looks at everything. What a sensor detects it has looked at: an
object within its gate of a detection that lies outside counts as in view, for a view that is stated too narrow would
otherwise make a new object of each such detection.

Azimuth is counter-clockwise from x in the xy plane of the sensor (x forward, y left, z up), elevation is from that
plane upwards, range is the distance from the sensor.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb.compiled import kernel
from optipmb.filter.calibration import log_odds
from optipmb.model.density import PHI, STATE, Misses, Moment, X, Y
from optipmb.model.frame import FieldOfView
from optipmb.model.rows import read_only, record

if TYPE_CHECKING:
    from optipmb.model.density import Bernoullis, Density
    from optipmb.model.rows import Array, Columns, Index
    from optipmb.model.stages import Measurements, Update
    from optipmb.model.table import ClassTable


HALF: Final = 0.5
"""Share of a detection below which it lies outside."""

_AXES_OF_WORLD: Final = read_only(np.eye(3)), read_only(np.zeros(3))
"""Rotation and translation where there is no pose."""


@record
class Looks:
    """View of one frame.

    Attributes:
        in_view: (N,) share of each object that is in view, in [0, 1].
        poisson_in_view: (J,) share of each Poisson component.
        counted: (N,) share of a miss of each object that counts: `in_view` times the attention of the sensor.
        time: (N,) s since each object was last looked at.
        misses: of the objects, if this frame misses them.
    """

    in_view: Array
    poisson_in_view: Array
    counted: Array
    time: Array
    misses: Misses


def look(
    view: FieldOfView | None, prior: Density, measurements: Measurements, moment: Moment, table: ClassTable
) -> tuple[Looks | None, Density]:
    """Compute which part of the predicted density is in view, and stop the counters of the rest.

    A look covers the time since the last frame that looked at the object, but where other frames came in between at
    most a nominal period (or the time since the last frame): an object that no sensor could see for long has not been
    missed for long. A Poisson component that is out of view ages no further.

    With p_s = 1 nothing else would end them, so this holds for a while only: all time counts as missed for an object
    that was not detected for `unseen_time`, and for a component whose gate no longer holds one standard deviation
    of its position.

    A sensor looks at a class with its attention (`optipmb.Sensor`): a miss counts for that part of the time, and the
    rest is left for the next look.

    Returns:
        The looks, None while no frame has had a field of view; and the prediction, with later stamps of Poisson
        components out of view.
    """
    bernoulli, poisson, misses = prior.bernoulli, prior.poisson, prior.misses
    before_ns, now_ns = moment.before_ns, moment.stamp_ns
    if view is None and misses is None and table.attention is None:
        return None, prior
    given, view = view, view or FieldOfView()
    if misses is None:
        misses = Misses(missed_from_ns=bernoulli.seen_ns, looked_ns=np.full(len(bernoulli), before_ns, np.int64))
    axes: tuple[Array, Array] = _AXES_OF_WORLD if view.pose is None else (view.pose.rotation, view.pose.translation)
    where = *axes, view.limits
    in_view, poisson_in_view = np.empty(len(bernoulli)), np.empty(len(poisson))
    for rows, share in ((bernoulli, in_view), (poisson, poisson_in_view)):
        shares_in_view(rows.mean, rows.covariance, table.known_boxes(rows.label, rows.auxiliary), *where, share)
    if given is not None:
        places = _out_of_view(measurements, where, table)
        for rows, share in ((bernoulli, in_view), (poisson, poisson_in_view)):
            show(rows.mean, table["gate"][rows.label], places, share)
    looked_ns, counted = np.where(in_view > 0.0, now_ns, misses.looked_ns), in_view
    if table.attention is not None:
        attention = table.attention[bernoulli.label]
        in_view *= attention > 0.0
        counted = in_view * attention
        looked_ns = misses.looked_ns + np.rint(attention * (looked_ns - misses.looked_ns)).astype(np.int64)
    time, missed_from_ns = count_looks(counted, misses.looked_ns, misses.missed_from_ns, tuple(moment))
    lost = now_ns - bernoulli.seen_ns > table.unseen_time * 1e9
    missed_from_ns[lost] = misses.missed_from_ns[lost]
    if len(poisson):
        xx, xy, yy = poisson.covariance[:, X, X], poisson.covariance[:, X, Y], poisson.covariance[:, Y, Y]
        largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
        hidden = np.where(largest > table["gate"][poisson.label] ** 2, 0.0, 1.0 - poisson_in_view)
        hidden_ns = np.rint(hidden * max(0, now_ns - before_ns)).astype(np.int64)
        prior = replace(prior, poisson=poisson.replaced(born_ns=np.minimum(poisson.born_ns + hidden_ns, now_ns)))
    if table.attention is not None:
        poisson_in_view *= table.attention[poisson.label] > 0.0
    return Looks(
        in_view, poisson_in_view, counted, time, Misses(missed_from_ns=missed_from_ns, looked_ns=looked_ns)
    ), prior


def _out_of_view(measurements: Measurements, where: tuple[Array, Array, Array], table: ClassTable) -> Array:
    """Return the places (D, 2) of the detections that lie in view by less than half."""
    count = len(measurements.label)
    mean, share = np.zeros((count, STATE)), np.empty(count)
    mean[:, [X, Y]], mean[:, PHI] = measurements.position[:, :2], np.nan_to_num(measurements.yaw)
    boxes = table.known_boxes(measurements.label, measurements.auxiliary)
    shares_in_view(mean, np.zeros((count, STATE, STATE)), boxes, *where, share)
    return np.ascontiguousarray(measurements.position[share < HALF][:, :2])


def follow_looks(
    looks: Looks,
    update: Update,
    before: Bernoullis,
    objects: Bernoullis,
    measurements: Measurements,
    moment: Moment,
    table: ClassTable,
) -> Misses:
    """Correct score and evidence of the posterior `objects` by the looks of the frame, and return its misses.

    Objects out of view keep their score and evidence as `before`, in the prediction; objects partly in view are missed
    for that part of the time since the last look. A look at a part of an object counts in part.
    """
    count, known, stamp_ns = len(objects), update.known, moment.stamp_ns
    row, hit = update.row[:known], update.measurement[:known] >= 0
    missed_from_ns, looked_ns = np.full(count, stamp_ns, np.int64), np.full(count, stamp_ns, np.int64)
    missed_from_ns[:known] = np.where(hit, stamp_ns, looks.misses.missed_from_ns[row])
    looked_ns[:known] = np.where(hit, stamp_ns, looks.misses.looked_ns[row])
    share = looks.counted[row]
    hidden = ~hit & (share == 0.0)
    objects.score[:known][hidden] = before.score[row][hidden]
    part = np.where(hit, 1.0, share)
    objects.looks[:known] = before.looks[row] + part
    label = objects.label[:known]
    latest = -table["missed_evidence"][label]
    latest[hit] = [log_odds(score) for score in measurements.score[update.measurement[:known][hit]].tolist()]
    kept = table["memory"][label] ** (part * looks.time[row] / table.period)
    kept[objects.born_ns[:known] == stamp_ns] = 1.0
    objects.evidence[:known] = kept * before.evidence[row] + (1.0 - kept) * latest
    return Misses(missed_from_ns=missed_from_ns, looked_ns=looked_ns)


@kernel
def shares_in_view(
    mean: Array, covariance: Array, auxiliary: Array, rotation: Array, translation: Array, limits: Array, share: Array
) -> None:
    """Compute how much of each object is in view, in the mean over its position.

    The footprint of a box stands for points spread evenly over length and width; with the position of the object they
    have covariance ``C = diag(l^2, w^2) / 12 + R' P_xy R`` in the axes R of the box. It is replaced by the 3 x 3 points
    of the Gauss-Hermite rule, ``L (i, j) sqrt(3)`` with ``L L' = C``, weights 2/3 and 1/6; where the position is
    known these are the centre, the corners and the middles of the edges. Along the height: bottom, centre and top, with
    the same weights (Simpson's rule). Shares of 0 and 1 are exact.
    """
    for n in range(mean.shape[0]):
        cos_phi, sin_phi = math.cos(mean[n, PHI]), math.sin(mean[n, PHI])
        p_xx, p_xy, p_yy = covariance[n, X, X], covariance[n, X, Y], covariance[n, Y, Y]
        length, width, height = auxiliary[n, 0], auxiliary[n, 1], auxiliary[n, 2]
        c_ll = length * length / 12.0 + cos_phi * cos_phi * p_xx + 2.0 * cos_phi * sin_phi * p_xy
        c_ll += sin_phi * sin_phi * p_yy
        c_ww = width * width / 12.0 + sin_phi * sin_phi * p_xx - 2.0 * cos_phi * sin_phi * p_xy
        c_ww += cos_phi * cos_phi * p_yy
        c_lw = cos_phi * sin_phi * (p_yy - p_xx) + (cos_phi * cos_phi - sin_phi * sin_phi) * p_xy
        along = math.sqrt(3.0 * c_ll)
        skew = 3.0 * c_lw / along
        across = math.sqrt(max(3.0 * c_ww - skew * skew, 0.0))
        weight = 0
        for i in range(-1, 2):
            for j in range(-1, 2):
                ahead, aside = i * along, i * skew + j * across
                dx = mean[n, X] + cos_phi * ahead - sin_phi * aside - translation[0]
                dy = mean[n, Y] + sin_phi * ahead + cos_phi * aside - translation[1]
                for k in range(-1, 2):
                    dz = auxiliary[n, 3] + 0.5 * k * height - translation[2]
                    if in_view(dx, dy, dz, rotation, limits):
                        weight += (4 if i == 0 else 1) * (4 if j == 0 else 1) * (4 if k == 0 else 1)
        share[n] = weight / 216.0


@kernel
def show(mean: Array, gate: Array, places: Array, share: Array) -> None:
    """Put objects (N, 6) in view that have one of the places (D, 2) in their gate (N,), m."""
    for n in range(mean.shape[0]):
        for d in range(places.shape[0]):
            if math.hypot(places[d, 0] - mean[n, X], places[d, 1] - mean[n, Y]) <= gate[n]:
                share[n] = 1.0


@kernel
def in_view(dx: float, dy: float, dz: float, rotation: Array, limits: Array) -> bool:
    """Tell whether a point, given from the sensor along the axes of the world, is in view."""
    x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    away = math.sqrt(x * x + y * y + z * z)
    return bool(
        (x * limits[0] + y * limits[1] >= limits[2] * math.sqrt(x * x + y * y))
        & (limits[3] * away <= z <= limits[4] * away)
        & (limits[5] <= away <= limits[6])
    )


@kernel
def count_looks(in_view: Array, looked_ns: Index, missed_from_ns: Index, moment: Columns) -> tuple[Array, Index]:
    """Compute the time that the look at each object covers, and from when its misses count if it is missed.

    Returns:
        (N,) seconds since the last look, at most a period where frames in between did not look; (N,) the stamp from
        which misses count then: later by the time without a look.
    """
    now = Moment(*moment)
    time, missed_from_out = np.empty(in_view.shape[0]), np.empty(in_view.shape[0], np.int64)
    step_ns = now.stamp_ns - now.before_ns
    most_ns = max(step_ns, math.floor(now.period * 1e9))
    for n in range(in_view.shape[0]):
        covered_ns = min(now.stamp_ns - looked_ns[n], most_ns)
        time[n] = covered_ns * 1e-9
        counted_ns = math.floor(in_view[n] * covered_ns + 0.5)
        missed_from_out[n] = missed_from_ns[n] + step_ns - counted_ns
    return time, missed_from_out
