"""The parameters as columns, one entry per class, ready for kernels and for indexing by class."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from optipmb.parameters import Calibration, ClassParameters, Parameters

    Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ClassTable:
    """Columns over the classes; names as in `optipmb.parameters.ClassParameters`, where they are described.

    Attributes:
        group: (C,) the first class of the group of each, itself without one.
        clutter_intensity: lambda_c = mu_c / A, 1/m^2.
        birth_intensity: mu_b0 / A, 1/m^2.
        process_noise: (C, 6) standard deviations in state order, per square root of a second.
        noise_position: (C,) standard deviation of z_x and z_y.
        noise_growth: (C,) g of `optipmb.position_noise`; noise_grows: whether any is above zero.
        noise_velocity: (C,) of z_vx and z_vy.
        noise_heading: (C,) of z_phi.
        acceleration_time: (C,) time constant of the acceleration, s, infinite where it is constant.
        constant_velocity: (C,) whether the motion model is that of constant velocity.
        linearisations: (C,) of measured velocities, zero for the UKF.
        reported_position: (C,) variance that R_x of `optipmb.reported` leaves for z_x and z_y; zero without it.
        reported_heading: (C,) for z_phi.
        birth_known: (C, 6) standard deviations of P^0 when the detection brings a velocity.
        birth_unknown: (C, 6) when it does not.
        sign_known: (C,) whether the sign of the heading is followed; the next four are zero where not.
        sign_memory: (C,) lambda of the sign.
        sign_detection: (C,) b_d.
        sign_motion: (C,) b_v.
        sign_speed: (C,) v_0.
        memory: (C,) lambda; one without a calibration, and so the evidence stays zero.
        missed_evidence: (C,) l_miss.
        score_of_evidence: (C,) weight of the evidence in the score.
        knots: (C,) number of knots of the calibration, zero without one.
        knot_evidence: (C, K) and the other columns at the knots, zero from `knots` on.
    """

    period: float
    detection_over_time: bool
    score_filter: Array
    nms_iou: Array
    group: NDArray[np.int64]
    survival: Array
    gate: Array
    detection: Array
    expected_points: Array
    detection_floor: Array
    birth_score: Array
    adaptive_birth_rate: Array
    clutter_intensity: Array
    birth_intensity: Array
    poisson_steps: NDArray[np.int64]
    extract_new: Array
    extract_known: Array
    extract_misses: NDArray[np.int64]
    max_misses: NDArray[np.int64]
    min_existence: Array
    birth_heading_speed: Array
    acceleration_time: Array
    constant_velocity: NDArray[np.bool_]
    gate_growth: Array
    gate_deviations: Array
    birth_over_clutter: NDArray[np.bool_]
    ground_clearance: Array
    confirm_from: Array
    confirm_until: Array
    process_noise: Array
    noise_position: Array
    noise_growth: Array
    noise_grows: bool
    noise_velocity: Array
    noise_heading: Array
    linearisations: NDArray[np.int64]
    reported_position: Array
    reported_heading: Array
    birth_known: Array
    birth_unknown: Array
    sign_known: NDArray[np.bool_]
    sign_memory: Array
    sign_detection: Array
    sign_motion: Array
    sign_speed: Array
    memory: Array
    missed_evidence: Array
    score_of_evidence: NDArray[np.float64]
    knots: NDArray[np.int64]
    knot_evidence: Array
    knot_existence: Array
    knot_along: Array
    knot_across: Array

    @classmethod
    def of(cls, parameters: Parameters) -> ClassTable:
        """Lay out the classes of a profile as columns."""
        rows = tuple(parameters.classes.values())

        def column(value: Callable[[ClassParameters], float]) -> Array:
            return np.array([value(row) for row in rows], dtype=np.float64)

        def count(value: Callable[[ClassParameters], int]) -> NDArray[np.int64]:
            return np.array([value(row) for row in rows], dtype=np.int64)

        def spread(speed: Callable[[ClassParameters], float]) -> Array:
            return np.array(
                [
                    [
                        p.birth.position,
                        p.birth.position,
                        speed(p),
                        p.birth.heading,
                        p.birth.turn_rate,
                        p.birth.acceleration,
                    ]
                    for p in rows
                ]
            )

        calibrations = [row.calibration for row in rows]
        knots = [len(one.evidence) if one else 0 for one in calibrations]

        def curve(value: Callable[[Calibration], tuple[float, ...]]) -> Array:
            values = np.zeros((len(rows), max(knots)))
            for row, one in enumerate(calibrations):
                if one is not None:
                    values[row, : knots[row]] = value(one)
            return values

        groups = [(p.group,) if p.group is not None else row for row, p in enumerate(rows)]
        noise = [p.process_noise for p in rows]
        signs = [p.heading_sign for p in rows]
        return cls(
            period=parameters.nominal_period,
            detection_over_time=parameters.detection_over_time,
            score_filter=column(lambda p: p.score_filter),
            nms_iou=column(lambda p: p.nms_iou),
            group=np.array([groups.index(group) for group in groups], dtype=np.int64),
            survival=column(lambda p: p.survival),
            gate=column(lambda p: p.gate),
            detection=column(lambda p: p.detection),
            expected_points=column(lambda p: p.expected_points),
            detection_floor=column(lambda p: p.detection_floor),
            birth_score=column(lambda p: p.birth_score),
            adaptive_birth_rate=column(lambda p: p.adaptive_birth_rate),
            clutter_intensity=column(lambda p: p.clutter_rate / p.area),
            birth_intensity=column(lambda p: p.undetected_birth_rate / p.area),
            poisson_steps=count(lambda p: p.poisson_steps),
            extract_new=column(lambda p: p.extract_new),
            extract_known=column(lambda p: p.extract_known),
            extract_misses=count(lambda p: p.extract_misses),
            max_misses=count(lambda p: p.max_misses),
            min_existence=column(lambda p: p.min_existence),
            birth_heading_speed=column(lambda p: p.birth_heading_speed),
            acceleration_time=column(lambda p: math.inf if p.acceleration_time is None else p.acceleration_time),
            constant_velocity=np.array([p.motion == "cv" for p in rows], dtype=np.bool_),
            gate_growth=column(lambda p: p.gate_growth),
            gate_deviations=column(lambda p: p.gate_deviations),
            birth_over_clutter=np.array([p.birth_over_clutter for p in rows], dtype=np.bool_),
            ground_clearance=column(lambda p: p.ground_clearance),
            confirm_from=column(lambda p: p.confirm_from),
            confirm_until=column(lambda p: p.confirm_until),
            process_noise=np.array(
                [[q.position, q.position, q.speed, q.heading, q.turn_rate, q.acceleration] for q in noise]
            ),
            noise_position=column(lambda p: p.measurement_noise.position),
            noise_growth=column(lambda p: p.measurement_noise.position_growth),
            noise_grows=any(p.measurement_noise.position_growth > 0.0 for p in rows),
            noise_velocity=column(lambda p: p.measurement_noise.velocity),
            noise_heading=column(lambda p: p.measurement_noise.heading),
            linearisations=count(lambda p: p.linearisations),
            reported_position=column(lambda p: _left_over(p, "position")),
            reported_heading=column(lambda p: _left_over(p, "heading")),
            birth_known=spread(lambda p: p.birth.speed),
            birth_unknown=spread(lambda p: p.birth.unknown_speed),
            sign_known=np.array([one is not None for one in signs], np.bool_),
            sign_memory=np.array([one.memory if one else 0.0 for one in signs]),
            sign_detection=np.array([one.detection if one else 0.0 for one in signs]),
            sign_motion=np.array([one.motion if one else 0.0 for one in signs]),
            sign_speed=np.array([one.speed if one else 0.0 for one in signs]),
            memory=np.array([one.memory if one else 1.0 for one in calibrations]),
            missed_evidence=np.array([one.missed if one else 0.0 for one in calibrations]),
            score_of_evidence=np.array([one.score_of_evidence if one else 0.0 for one in calibrations]),
            knots=np.array(knots, np.int64),
            knot_evidence=curve(lambda one: one.evidence),
            knot_existence=curve(lambda one: one.existence),
            knot_along=curve(lambda one: one.along),
            knot_across=curve(lambda one: one.across),
        )


def _left_over(parameters: ClassParameters, name: str) -> float:
    """R_x of `optipmb.reported`: 1 / (1 / R' - 1 / R), zero where boxes are reported as they are."""
    if parameters.reported_noise is None:
        return 0.0
    reported, measured = getattr(parameters.reported_noise, name), getattr(parameters.measurement_noise, name)
    precision = _precision(reported) - _precision(measured)
    return float(1.0 / precision) if precision > 0.0 else 0.0


def _precision(deviation: float) -> float:
    """1 / R; infinite where it is larger than any number."""
    try:
        return float(deviation**-2)
    except OverflowError:
        return math.inf
