"""Every kernel must equal a plain twin: a table of their tests, and the twins that fit in no other file."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from class_rows import class_rows
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from optipmb.calibration import SURE, calibrate_rows, log_odds
from optipmb.class_posterior import UNGROUPED, Groups
from optipmb.density import (
    COMPONENT,
    FROM_LAST_DETECTION,
    OBJECT,
    BernoulliArrays,
    Bernoullis,
    PoissonArrays,
    Poissons,
    components_in,
    misses_counted_from,
    objects_in,
)
from optipmb.detection_probability import of_rows
from optipmb.errors import FrameError
from optipmb.frame import MAX_COORDINATE, MAX_SPEED, _refuse, allowed
from optipmb.hypotheses import detection_costs, first_detections, gate, gate_radii, local_hypotheses
from optipmb.preprocess import Measurements
from optipmb.warm import kernels

COMPILING = settings(deadline=None)  # the first call compiles
HERE = Path(__file__).parent

TWINS = {
    "association.associate": "test_hypotheses.test_the_total_is_that_of_the_hungarian_algorithm",
    "update.birth_states": "test_update.test_a_birth_is_the_textbook_birth",
    "update.first_detected_states": "test_kernels.test_announced_objects_are_matched_mixtures",
    "association.forbid_births": "test_kernels.test_births_are_forbidden_as_set_logic_says",
    "calibration.calibrate_rows": "test_twins.test_rows_are_calibrated_as_numpy_interpolates",
    "calibration.log_odds": "test_twins.test_log_odds_are_bounded",
    "class_posterior.label_probability": "test_class_posterior.test_pairs_weigh_by_what_the_detector_calls_them",
    "geometry.boxes_overlap": "test_unknown_heading.test_boxes_of_unknown_heading_overlap_alike_in_all_axes",
    "predict.heading_unknown": "test_unknown_heading.test_the_prediction_is_that_of_a_linear_model",
    "predict.predict_without_heading": "test_unknown_heading.test_the_prediction_is_that_of_a_linear_model",
    "preprocess.below": "test_unknown_heading.test_the_order_of_detections_does_not_matter",
    "preprocess.differ": "test_unknown_heading.test_the_order_of_detections_does_not_matter",
    "table.known_length": "test_unknown_heading.test_a_point_has_the_box_of_its_class_until_one_is_measured",
    "unknown_heading.all_measured": "test_unknown_heading.test_a_point_has_the_box_of_its_class_until_one_is_measured",
    "unknown_heading.begin_turning": "test_unknown_heading.test_a_heading_is_found_taken_and_lost",
    "unknown_heading.face_along": "test_unknown_heading.test_the_update_is_the_linear_kalman_filter",
    "unknown_heading.find_heading": "test_unknown_heading.test_a_heading_is_found_taken_and_lost",
    "unknown_heading.lose_heading": "test_unknown_heading.test_a_heading_is_found_taken_and_lost",
    "unknown_heading.scale_across": "test_unknown_heading.test_a_heading_is_found_taken_and_lost",
    "unknown_heading.show_heading": "test_unknown_heading.test_a_heading_is_found_taken_and_lost",
    "unknown_heading.take_heading": "test_unknown_heading.test_a_heading_is_found_taken_and_lost",
    "unknown_heading.turn_axes": "test_unknown_heading.test_the_update_is_the_linear_kalman_filter",
    "class_posterior.update_classes": "test_class_posterior.test_the_posterior_is_bayes_rule",
    "class_posterior.weigh_by_class": "test_class_posterior.test_pairs_weigh_by_what_the_detector_calls_them",
    "density.labels_within": "test_safety.test_labels_are_within_the_classes",
    "density.components_in": "test_rows.test_kernels_read_the_columns_that_numpy_does",
    "density.objects_in": "test_rows.test_kernels_read_the_columns_that_numpy_does",
    "density.misses_counted_from": "test_twins.test_misses_count_from_the_last_detection_without_fields_of_view",
    "density.copy_state": "test_update.test_states_without_a_measurement_stay_as_predicted",
    "density.whole_periods": "test_kernels.test_periods_are_counted_to_the_nearest",
    "extract.confirm": "test_confirmed.test_confirmation_has_hysteresis",
    "detection_probability.of_rows": "test_twins.test_rows_have_the_value_of_their_class",
    "extract.extract": "test_kernels.test_tracks_are_read_off_the_states",
    "extract.tracks_in": "test_rows.test_kernels_read_the_columns_that_numpy_does",
    "extract.select_tracks": "test_kernels.test_tracks_are_selected_by_two_thresholds",
    "frame.allowed": "test_twins.test_values_are_allowed_as_numpy_says",
    "geometry.overlaps": "test_geometry.test_iou_is_that_of_clipped_polygons",
    "geometry.box_iou": "test_geometry.test_iou_is_that_of_clipped_polygons",
    "geometry.corners": "test_geometry.test_iou_is_that_of_clipped_polygons",
    "geometry.intersection_area": "test_geometry.test_iou_is_that_of_clipped_polygons",
    "geometry.iou_exceeds": "test_kernels.test_cheap_rejections_change_no_decision",
    "lightweight.doubt": "test_kernels.test_tracks_are_read_off_the_states",
    "lightweight.follow_sign": "test_kernels.test_the_light_weight_filter_is_its_formulas",
    "lightweight.sign_probability": "test_kernels.test_tracks_are_read_off_the_states",
    "lightweight.turn_around": "test_kernels.test_the_light_weight_filter_is_its_formulas",
    "field_of_view.count_looks": "test_field_of_view.test_looks_are_counted_as_plain_arithmetic_says",
    "field_of_view.in_view": "test_field_of_view.test_a_point_is_in_view_by_its_angles",
    "field_of_view.shares_in_view": "test_field_of_view.test_shares_are_the_quadrature_over_the_box_and_its_position",
    "hypotheses._grown": "test_hypotheses.test_the_gate_holds_every_pair_of_a_class_within_the_distance",
    "hypotheses.close_gates": "test_field_of_view.test_gates_are_closed_for_what_cannot_be_detected",
    "hypotheses.detection_costs": "test_hypotheses.test_costs_and_association_probabilities_are_the_formulas",
    "hypotheses.exclude_turned": "test_twins.test_hypotheses_are_those_of_their_parts",
    "hypotheses.first_detections": "test_hypotheses.test_each_kind_of_first_detection_has_its_formula",
    "hypotheses.gate": "test_hypotheses.test_the_gate_holds_every_pair_of_a_class_within_the_distance",
    "hypotheses.gate_widening": "test_hypotheses.test_a_gate_widens_by_what_r_is_above_that_of_the_class",
    "hypotheses.gate_radii": "test_hypotheses.test_gates_widen_with_unknown_speed",
    "hypotheses.groups": "test_class_posterior.test_pairs_weigh_by_what_the_detector_calls_them",
    "hypotheses.pairs_of_few": "test_hypotheses.test_the_gate_holds_every_pair_of_a_class_within_the_distance",
    "hypotheses.pairs_of_many": "test_hypotheses.test_the_gate_holds_every_pair_of_a_class_within_the_distance",
    "hypotheses.sort_measurements": "test_hypotheses.test_the_gate_holds_every_pair_of_a_class_within_the_distance",
    "hypotheses.local_hypotheses": "test_twins.test_hypotheses_are_those_of_their_parts",
    "lightweight.light_weight_filter": "test_kernels.test_the_light_weight_filter_is_its_formulas",
    "predict.decay_and_turn": "test_motion.test_the_prediction_is_the_textbook_unscented_transform",
    "predict.displacement": "test_motion.test_the_prediction_is_the_textbook_unscented_transform",
    "predict.centred": "test_motion.test_the_prediction_is_the_textbook_unscented_transform",
    "predict.ctra_displacement": "test_motion.test_the_displacement_is_the_integral_of_the_velocity",
    "predict.predict_state": "test_motion.test_the_prediction_is_the_textbook_unscented_transform",
    "predict.small_turn": "test_motion.test_the_displacement_is_the_integral_of_the_velocity",
    "predict.square_root": "test_motion.test_the_square_root_squared_is_the_covariance",
    "predict.travel": "test_motion.test_the_way_under_a_decaying_acceleration_is_its_integral",
    "predict.turn_integrals": "test_motion.test_the_way_under_a_decaying_acceleration_is_its_integral",
    "predict.wrap": "test_motion.test_a_wrapped_angle_is_the_same_direction_in_the_half_open_interval",
    "geometry.block": "test_kernels.test_a_search_finds_every_neighbour_once",
    "geometry.cell": "test_kernels.test_a_search_finds_every_neighbour_once",
    "geometry.empty_torus": "test_kernels.test_a_search_finds_every_neighbour_once",
    "geometry.insert": "test_kernels.test_a_search_finds_every_neighbour_once",
    "calibration.follow_box": "test_kernels.test_tracks_are_read_off_the_states",
    "paths._doubts": "test_paths.test_a_doubtful_heading_changes_no_motion",
    "paths.predict_paths": "test_paths.test_states_are_predicted_as_numpy_does_step_by_step",
    "detection_probability.boxes_in_sensor": "test_geometry.test_points_in_boxes_counts_every_point",
    "detection_probability.boxes_of_cells": "test_geometry.test_points_in_boxes_counts_every_point",
    "detection_probability.cells_of_points": "test_geometry.test_points_at_the_faces_of_boxes_fall_into_their_cells",
    "detection_probability.column": "test_geometry.test_points_at_the_faces_of_boxes_fall_into_their_cells",
    "detection_probability.count_points": "test_geometry.test_points_in_boxes_counts_every_point",
    "predict.predict_rows": "test_kernels.test_components_within_their_limit_are_predicted",
    "predict.rows_within": "test_kernels.test_components_within_their_limit_are_predicted",
    "predict.predict_density": "test_kernels.test_components_within_their_limit_are_predicted",
    "preprocess.non_maximum_suppression": "test_geometry.test_suppression_is_the_greedy_one_per_group",
    "preprocess.precedes": "test_kernels.test_the_canonical_order_is_a_lexicographic_one",
    "preprocess.select": "test_kernels.test_only_scores_from_the_filter_on_are_chosen",
    "preprocess.sort_canonically": "test_kernels.test_the_canonical_order_is_a_lexicographic_one",
    "association.surviving_objects": "test_kernels.test_objects_survive_by_existence_and_misses",
    "self_calibration.bin_of": "test_self_calibration.test_a_bin_is_that_of_the_log_odds",
    "self_calibration.calibrate": "test_self_calibration.test_scores_go_through_the_isotonic_curve",
    "self_calibration.copy_rows": "test_self_calibration.test_frames_are_counted_as_plain_python_counts",
    "self_calibration.curves": "test_self_calibration.test_scores_go_through_the_isotonic_curve",
    "self_calibration.on_curve": "test_self_calibration.test_scores_go_through_the_isotonic_curve",
    "self_calibration.learn": "test_self_calibration.test_frames_are_counted_as_plain_python_counts",
    "self_calibration.needed_shares": "test_self_calibration.test_the_share_of_looks_follows_the_recall_of_the_best",
    "self_calibration.next_slot": "test_self_calibration.test_frames_are_counted_as_plain_python_counts",
    "extract.all_within": "test_soundness.test_bounds_are_kept_in_every_column",
    "sensor_motion._refine": "test_sensor_motion.test_the_motion_is_the_rigid_fit_of_the_pairs_it_joins",
    "sensor_motion.common_motion": "test_sensor_motion.test_the_motion_is_the_rigid_fit_of_the_pairs_it_joins",
    "sensor_motion.nearest": "test_sensor_motion.test_the_motion_is_the_rigid_fit_of_the_pairs_it_joins",
    "sensor_motion.sideways": "test_sensor_motion.test_sideways_is_the_least_distance_to_where_an_object_can_drive",
    "sensor_motion.together": "test_sensor_motion.test_the_motion_is_the_rigid_fit_of_the_pairs_it_joins",
    "tracker.update": "test_oracle.test_every_combination_of_modules_equals_algorithm_1",
    "undetected.with_births": "test_kernels.test_components_that_stay_and_those_that_are_born_stand_in_order",
    "undetected.update_undetected": "test_kernels.test_what_is_undetected_stays_or_is_born",
    "update.moment_match": "test_update.test_a_mixture_keeps_its_mean_and_covariance",
    "update.ukf_update": "test_update.test_the_update_is_the_textbook_ukf",
    "update.ukf_updates": "test_update.test_the_update_is_the_textbook_ukf",
    "zones.crossings": "test_zones.test_places_and_crossings_are_those_of_shapely",
    "zones.locate": "test_zones.test_places_and_crossings_are_those_of_shapely",
    "update.workspace": "test_update.test_the_update_is_the_textbook_ukf",
}
"""Kernel -> the test that holds it, or the kernel that it is a part of, against plain numpy or a textbook formula."""


def test_every_kernel_has_a_twin() -> None:
    """The table names every kernel, and tests that there are."""
    assert {name.removeprefix("optipmb.") for name in kernels()} == set(TWINS)
    tests = set()
    for path in HERE.glob("test_*.py"):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        tests |= {f"{path.stem}.{node.name}" for node in body if isinstance(node, ast.FunctionDef)}
    assert set(TWINS.values()) <= tests


def test_rows_have_the_value_of_their_class() -> None:
    """Objects first, then components."""
    value, first, second = np.array([0.3, 0.7, 0.9]), np.array([2, 0, 1, 1]), np.array([1, 2])
    words = np.zeros(4 * OBJECT), np.zeros(2 * COMPONENT)
    objects_in(words[0]).label[:], components_in(words[1]).label[:] = first, second
    np.testing.assert_array_equal(of_rows(value, *words), value[np.r_[first, second]])


def test_misses_count_from_the_last_detection_without_fields_of_view() -> None:
    """Given stamps hold; else the stamps of the last detections, one for each object."""
    stamps, width = np.arange(3), {"mean": (3, 6), "covariance": (3, 6, 6), "auxiliary": (3, 4)}
    columns = {name: np.zeros(width.get(name, 3), column.number) for name, column in Bernoullis.described.items()} | {
        "seen_ns": 10 + stamps
    }
    objects = objects_in(Bernoullis(**columns).words)
    np.testing.assert_array_equal(misses_counted_from(objects, stamps), stamps)
    np.testing.assert_array_equal(misses_counted_from(objects, FROM_LAST_DETECTION), 10 + stamps)
    assert misses_counted_from(objects_in(Bernoullis.empty().words), FROM_LAST_DETECTION).size == 0


COORDINATES = st.sampled_from(
    [0.0, -3.5, MAX_COORDINATE, -MAX_COORDINATE, np.nextafter(MAX_COORDINATE, np.inf), np.nan]
)
LENGTHS = st.sampled_from([1.0, 1e-300, MAX_COORDINATE, 0.0, -1.0, np.inf, np.nan])
SCORES = st.sampled_from([0.5, 1.0, 1e-300, 0.0, -0.5, np.nextafter(1.0, 2.0), np.nan])
SPEEDS = st.sampled_from([0.0, MAX_SPEED, -MAX_SPEED, np.nextafter(MAX_SPEED, np.inf), np.nan, -np.inf])


@COMPILING
@given(data=st.data(), count=st.integers(0, 3), worst=st.integers(0, 6))
def test_values_are_allowed_as_numpy_says(data: st.DataObject, count: int, worst: int) -> None:
    """Bounds, signs, NaN and half-known velocities; refused are exactly the values that are not allowed."""

    def drawn(place: int, shape: tuple[int, ...], values: st.SearchStrategy[float]) -> np.ndarray:
        return data.draw(arrays(np.float64, shape, elements=values)) if place == worst else np.full(shape, 0.5)

    label = data.draw(arrays(np.int64, count, elements=st.integers(-1, 3))) if worst == 0 else np.zeros(count, np.int64)
    center, size = drawn(1, (count, 3), COORDINATES), drawn(2, (count, 3), LENGTHS)
    yaw, score, velocity = drawn(3, (count,), COORDINATES), drawn(4, (count,), SCORES), drawn(5, (count, 2), SPEEDS)
    unknown = np.isnan(velocity).all(axis=1, keepdims=True)
    far = np.abs(np.where(np.isnan(center) & [False, False, True], 0.0, center))
    known_size, known_yaw = np.where(np.isnan(size), 1.0, size), np.where(np.isnan(yaw), 0.0, yaw)
    wanted = (
        bool(((label >= 0) & (label < 3)).all())
        and bool((far <= MAX_COORDINATE).all() and (np.abs(known_yaw) <= MAX_COORDINATE).all())
        and bool(((known_size > 0) & (known_size <= MAX_COORDINATE)).all() and ((score > 0) & (score <= 1)).all())
        and bool(((np.abs(velocity) <= MAX_SPEED) | unknown).all())
    )
    assert allowed(label, 3, center, size, yaw, score, velocity) == wanted
    if wanted:
        _refuse(label, 3, center, size, yaw, score, velocity)
    else:
        with pytest.raises(FrameError):
            _refuse(label, 3, center, size, yaw, score, velocity)


@pytest.mark.parametrize("seed", range(5))
def test_rows_are_calibrated_as_numpy_interpolates(seed: int) -> None:
    """`numpy.interp` over knots, a turned diagonal, factors, weighted velocities; other classes stay as they are."""
    rng = np.random.default_rng(seed)
    knots = np.array([4, 0, 1])
    bends = np.sort(rng.normal(0, 2, (3, 4)), axis=1)
    existence_at, along_at, across_at = (np.sort(rng.uniform(0, 1, (3, 4)), axis=1) for _ in range(3))
    label, evidence, yaw = rng.integers(0, 3, 30), rng.normal(0, 3, 30), rng.normal(0, 3, 30)
    evidence[:4], label[:4] = bends[0], 0  # at the knots themselves
    rows = np.arange(30)
    existence, score, covariance = (rng.normal(0, 1, (rows.size, *shape)) for shape in ((), (), (6, 6)))
    velocity = rng.normal(0, 1, (30, 2))
    covariance[:, 2, 2] = rng.uniform(0.1, 1.0, 30)
    told, ranked, moving, widened = existence.copy(), score.copy(), velocity.copy(), covariance.copy()
    weight = np.array([0.3, 1.0, 0.0])
    factors = np.ones((3, 6))
    factors[:, [2, 4]] = rng.uniform(0.2, 2.0, (3, 2))
    classes = class_rows(
        3, knots=knots, score_of_evidence=weight, factor_speed=factors[:, 2], factor_turn_rate=factors[:, 4]
    )
    for name, curve in (("evidence", bends), ("existence", existence_at), ("along", along_at), ("across", across_at)):
        classes[f"knot_{name}"][:, :4] = curve
    calibrate_rows(label, evidence, yaw, classes, told, ranked, moving, widened)
    for k, n in enumerate(rows):
        c = label[n]
        used = slice(0, knots[c])
        if knots[c]:
            existence[k], along, across = (
                np.interp(evidence[n], bends[c, used], curve[c, used]) for curve in (existence_at, along_at, across_at)
            )
            cos, sin = np.cos(yaw[n]), np.sin(yaw[n])
            turn = np.array([[cos, -sin], [sin, cos]])
            covariance[k] *= np.outer(factors[c], factors[c])
            squared = velocity[k] @ velocity[k]
            velocity[k] *= squared**2 / (squared**2 + (3 * covariance[k, 2, 2]) ** 2)
            covariance[k, :2, :2] += turn @ np.diag([along**2, across**2]) @ turn.T
            score[k] = np.average([score[k], 0.5 + 0.5 * evidence[n] / SURE], weights=[1 - weight[c], weight[c]])
    np.testing.assert_allclose(told, existence, rtol=1e-12)
    np.testing.assert_allclose(ranked, score, rtol=1e-15)
    np.testing.assert_allclose(moving, velocity, rtol=1e-12)
    np.testing.assert_allclose(widened, covariance, rtol=1e-12, atol=1e-15)


@COMPILING
@given(score=st.floats(1e-12, 1.0))
def test_log_odds_are_bounded(score: float) -> None:
    """`ln[z / (1 - z)]` between minus and plus `SURE`, also at one."""
    with np.errstate(divide="ignore"):
        wanted = np.clip(np.log(np.float64(score)) - np.log1p(-np.float64(score)), -SURE, SURE)
    assert log_odds(score) == pytest.approx(wanted, rel=1e-14, abs=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_hypotheses_are_those_of_their_parts(seed: int) -> None:
    """Gates, headings beyond eta_dist, costs, ln e = ln(mu p_d) + ln N and first-time detections, column by column."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.5, (20, 6, 6))
    mean, covariance = rng.normal(0, 4, (20, 6)), root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(6)
    label, weight, p_d = rng.integers(0, 2, 20), rng.uniform(0.1, 1, 20), rng.uniform(0.1, 0.9, 20)
    position, measured, score = rng.normal(0, 4, (15, 2)), rng.integers(0, 2, 15), rng.uniform(0, 1, 15)
    distance, noise = np.array([2.0, 4.0]), np.array([0.2, 0.7])
    clutter, birth, threshold = np.array([1e-3, 1e-2]), np.array([1e-4, 1e-3]), np.array([0.3, 0.6])
    old, new = slice(0, 12), slice(12, 20)
    classes = class_rows(2, noise_position=noise, clutter_intensity=clutter, birth_intensity=birth)
    classes["birth_score"], classes["birth_over_clutter"] = threshold, [True, False]
    classes["gate"], classes["gate_deviations"], classes["noise_heading"] = distance, [0.0, 30.0], 0.15
    parts = [{"mean": mean[rows], "covariance": covariance[rows], "label": label[rows]} for rows in (old, new)]
    objects = BernoulliArrays(**dict(Bernoullis.empty().columns()) | parts[0] | {"existence": weight[old]})
    components = PoissonArrays(**dict(Poissons.empty().columns()) | parts[1] | {"weight": weight[new]})
    yaw = rng.uniform(-np.pi, np.pi, 15)
    measurements = Measurements(position, yaw, np.empty((15, 2)), np.empty((15, 4)), score, measured, measured)
    found = local_hypotheses(objects, components, p_d, measurements, Groups(UNGROUPED, UNGROUPED), 0.15, classes)
    radius = gate_radii(covariance, label, 0.15, classes)
    row, measurement, likelihood = gate(*parts[0].values(), radius[old], position, measured, classes, False)
    apart = np.linalg.norm(position[measurement] - mean[row, :2], axis=1)
    turn = (yaw[measurement] - mean[row, 3] + np.pi / 2) % np.pi - np.pi / 2
    turned = turn**2 > 1.5**2 * (covariance[row, 3, 3] + 0.15**2)
    likelihood[(apart > distance[label[row]]) & turned] = -np.inf
    association = np.empty(15)
    cost = detection_costs(row, measurement, likelihood, weight[old], p_d[old], association)
    component, announced, log_e = gate(*parts[1].values(), radius[new], position, measured, classes, False)
    log_e = np.log((weight * p_d)[new][component]) + log_e
    first = first_detections(announced, log_e, score, association, measured, classes)
    wanted = row, measurement, cost, component, announced, log_e, *first, association
    for column, expected in zip(found, wanted, strict=True):
        np.testing.assert_allclose(column, expected, rtol=1e-12)
