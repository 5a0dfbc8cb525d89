"""Records that a stage of Algorithm 1 makes and several others read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from optipmb.model.rows import Array, Index


class Measurements(NamedTuple):
    """The measurement set Z_k, best score first.

    Attributes:
        position: (M, 2) z_xy, m; (M, 5) with rho_xx, rho_xy and rho_yy of `optipmb.model.frame` behind, where some
            detection of the frame has another R than its class.
        yaw: (M,) z_phi, rad, NaN where unknown.
        velocity: (M, 2) z_v, m/s, NaN where unknown.
        auxiliary: (M, 4) z_A = [length, width, height, z], NaN where unknown.
        score: (M,) z_s in (0, 1].
        label: (M,) class z_c.
        source: (M,) index in the caller's arrays.
    """

    position: Array
    yaw: Array
    velocity: Array
    auxiliary: Array
    score: Array
    label: Index
    source: Index


UNASSIGNED: Final = -1
"""No measurement of an object, no object of a measurement."""

NEW: Final = -1
"""`Survivors.row` of a first-time detection."""


class Survivors(NamedTuple):
    """The local hypotheses of the best global hypothesis that outlive pruning: one per object of the posterior.

    Known objects come first, in their order; then the new ones, in the order of their measurements.

    Attributes:
        row: (K,) predicted object, or `NEW`.
        measurement: (K,) its measurement, or `UNASSIGNED`.
        existence: (K,) posterior existence probability r.
        known: how many are known objects.
        detected: how many of those have a measurement.
    """

    row: Index
    measurement: Index
    existence: Array
    known: int
    detected: int


class Update(NamedTuple):
    """The PMB update of Algorithm 1.

    Attributes:
        objects: array of the objects of the posterior.
        class_probability: (K, C) their class posteriors, or (K, 0).
        components: array of the Poisson components.
        fate: of the predicted ones (`optipmb.filter.undetected.update_undetected`).
        row: (K,) predicted object of each object of the posterior, or `NEW`.
        measurement: (K,) its measurement, negative where missed.
        known: how many objects are known ones.
        detected: how many of those have a measurement.
        repaired: how many covariances had to be repaired.
    """

    objects: Array
    class_probability: Array
    components: Array
    fate: Index
    row: Index
    measurement: Index
    known: int
    detected: int
    repaired: int
