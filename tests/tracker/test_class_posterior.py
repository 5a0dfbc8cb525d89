"""The posterior over the classes of a group: its formulas, and what a track that changes its class is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from class_rows import class_rows
from scenes import random_parameters, steps

import optipmb
from optipmb.filter.class_posterior import (
    CHANGE_ODDS,
    UNGROUPED,
    Groups,
    label_probability,
    update_classes,
    weigh_by_class,
)
from optipmb.filter.hypotheses import gate, groups
from optipmb.model.parameters import parse_parameters
from optipmb.model.stages import NEW, Measurements, Survivors
from optipmb.model.table import ClassTable

if TYPE_CHECKING:
    from optipmb import Frame, Parameters

SEEDS = pytest.mark.parametrize("seed", range(4))
LABELS = ("car", "walker", "truck", "bus")
GROUP = np.array([0, 1, 0, 0])
SIZE = np.array([3, 1, 3, 3])


def motor(**values: Any) -> Parameters:
    """Cars, trucks and buses in one group, walkers in none."""
    document = random_parameters(0, LABELS)
    for name, one in document["classes"].items():
        one.update(document["classes"]["car"], score_filter=0.1, birth_score=0.3, detection=0.8, nms_iou=0.1, gate=3.0)
        one.update(extract_new=0.1, extract_known=0.1, motion="cv", heading_sign=None, birth_heading_speed=0.0)
        one.update(values if name != "walker" else {}, group=None if name == "walker" else "motor")
    return parse_parameters(document)


def seen(parameters: Parameters, t: float, *objects: tuple[str, float, float]) -> Frame:
    """A frame of boxes: class, x and score; the vehicles at y = 0, all of one size."""
    frame, _ = optipmb.make_frame(
        parameters,
        stamp_ns=round(t * 1e9),
        labels=LABELS,
        label=[LABELS.index(name) for name, _, _ in objects],
        center=np.array([[x, 0.0, 0.0] for _, x, _ in objects]).reshape(-1, 3),
        size=np.tile([5.0, 2.0, 2.0], (len(objects), 1)),
        yaw=np.zeros(len(objects)),
        score=[score for _, _, score in objects],
    )
    return frame


def likelihoods(confusion: np.ndarray, d: int, s: float) -> np.ndarray:
    """p(d | c) for all classes c of the group of d, zero for the others."""
    return np.where(GROUP[d] == GROUP, s * confusion[:, d] + (1 - s) / SIZE[d], 0.0)


@SEEDS
def test_the_posterior_is_bayes_rule(seed: int) -> None:
    """Pi of detected, missed and new objects, and the class that each reports, as numpy multiplies and divides."""
    rng = np.random.default_rng(seed)
    confusion = ClassTable.of(motor(class_confusion=rng.uniform(0.05, 0.3))).confusion
    np.testing.assert_allclose(confusion.sum(axis=1), 1.0)
    label = rng.choice([0, 2, 3, 1], 12)
    before = np.where(GROUP[label, None] == GROUP, rng.uniform(0.05, 1, (12, 4)), 0.0)
    before /= before.sum(axis=1, keepdims=True)
    measured = np.where(label == 1, 1, rng.choice([0, 2, 3], 12))
    score = rng.uniform(0.1, 1, 12)
    row = np.array([*range(10), NEW, NEW])
    measurement = np.where(rng.random(12) < 0.3, -1, np.arange(12))
    measurement[10:] = 10, 11
    z = Measurements(UNGROUPED, UNGROUPED, UNGROUPED, UNGROUPED, score, measured, measured)
    classes = class_rows(4, group=GROUP, group_size=SIZE)
    survivors, found = Survivors(row, measurement, score, 10, 0), np.empty(12, np.int64)
    pi = update_classes(survivors, label, found, z, Groups(before, confusion), classes)
    changed = 0
    for k in range(12):
        m, own = measurement[k], measured[k] if row[k] == NEW else label[k]
        prior = before[k] if row[k] != NEW else (GROUP[own] == GROUP) / SIZE[own]
        wanted = prior * likelihoods(confusion, measured[m], score[m]) if m >= 0 else prior
        np.testing.assert_allclose(pi[k], wanted / wanted.sum(), rtol=1e-12)
        best = int(np.argmax(wanted))
        changes = row[k] != NEW and m >= 0 and wanted[best] >= CHANGE_ODDS * wanted[own]
        assert found[k] == (best if changes else own)
        changed += int(found[k] != own)
    assert changed
    nothing = update_classes(survivors, label, found, z, Groups(UNGROUPED, UNGROUPED), classes)
    np.testing.assert_array_equal(found, np.where(row == NEW, measured, label))
    assert nothing.shape == (12, 0)


@SEEDS
def test_pairs_weigh_by_what_the_detector_calls_them(seed: int) -> None:
    """The gate is open to the group; ln p(d), p(d) = sum_c pi_c Lambda_cd, is added to ln N with R of the label."""
    rng = np.random.default_rng(seed)
    confusion = ClassTable.of(motor(class_confusion=0.2)).confusion
    label, measured, score = rng.integers(0, 4, 20), rng.integers(0, 4, 30), rng.uniform(0.1, 1, 30)
    pi = np.where(GROUP[label, None] == GROUP, rng.uniform(0.05, 1, (20, 4)), 0.0)
    pi /= pi.sum(axis=1, keepdims=True)
    mean, position = rng.normal(0, 2, (20, 6)), rng.normal(0, 2, (30, 2))
    covariance = np.tile(np.eye(6), (20, 1, 1))
    noise = rng.uniform(0.2, 1, 4)
    classes = class_rows(4, group=GROUP, group_size=SIZE, noise_position=noise)
    np.testing.assert_array_equal(groups(label, classes), GROUP[label])
    row, measurement, found = gate(mean, covariance, label, np.full(20, 2.0), position, measured, classes, True)
    near = np.linalg.norm(mean[:, None, :2] - position, axis=2) <= 2.0
    wanted = np.argwhere(near & (GROUP[label][:, None] == GROUP[measured]))
    np.testing.assert_array_equal(np.column_stack((row, measurement)), wanted)
    z = Measurements(position, UNGROUPED, UNGROUPED, UNGROUPED, score, measured, measured)
    weigh_by_class(row, measurement, found, z, Groups(pi, confusion), classes)
    for n, m, value in zip(row, measurement, found, strict=True):
        p = pi[n] @ likelihoods(confusion, measured[m], 1.0)
        variance, away = 1 + noise[measured[m]] ** 2, mean[n, :2] - position[m]
        normal = -np.log(2 * np.pi * variance) - 0.5 * away @ away / variance
        assert value == pytest.approx(normal + np.log(p), rel=1e-12)
        if label[n] != 1:
            p = pi[n] @ likelihoods(confusion, measured[m], score[m])
            assert label_probability(pi[n], measured[m], score[m], confusion, classes) == pytest.approx(p, rel=1e-12)


def test_a_truck_once_called_car_becomes_a_truck_under_its_id() -> None:
    """The id stays, the class follows the detections, and a single other label changes nothing."""
    parameters = motor()
    calls = ["car"] * 3 + ["truck"] * 6 + ["car"] + ["truck"] * 2
    results = steps(parameters, [seen(parameters, 0.1 * k, (name, 20.0, 0.8)) for k, name in enumerate(calls)])
    assert {tuple(one.tracks.id) for one in results} == {(1,)}
    reported = [LABELS[one.tracks.label[0]] for one in results]
    change = reported.index("truck")
    assert 3 < change <= 8
    assert reported == ["car"] * change + ["truck"] * (len(calls) - change)
    for one in results:
        assert one.density.class_probability is not None
        np.testing.assert_array_equal(one.class_probability, one.density.class_probability)
        np.testing.assert_allclose(one.density.class_probability.sum(axis=1), 1.0)
        assert one.density.class_probability[0, 1] == 0.0


def test_probabilities_are_those_of_the_tracks() -> None:
    """An object that is not extracted has no row; the rows follow the ids of the tracks."""
    parameters = motor(extract_new=0.9, extract_known=0.99, survival=0.95, max_misses=5, min_existence=0.01)
    frames = [("bus", 20.0, 0.8), ("truck", 60.0, 0.9)], [("truck", 60.0, 0.9)]
    results = steps(parameters, [seen(parameters, 0.1 * k, *objects) for k, objects in enumerate(frames)])
    last = results[-1]
    assert last.class_probability is not None
    assert last.density.class_probability is not None
    rows = np.isin(last.density.bernoulli.id, last.tracks.id)
    assert len(last.class_probability) == len(last.tracks) < len(rows)
    np.testing.assert_array_equal(last.class_probability, last.density.class_probability[rows])


def test_a_walker_is_no_truck() -> None:
    """A detection of a class outside the group is another object."""
    parameters = motor()
    results = steps(
        parameters, [seen(parameters, 0.1 * k, (name, 20.0, 0.8)) for k, name in enumerate(["car", "walker"])]
    )
    assert results[-1].tracks.id.tolist() == [1, 2]


def test_labels_are_forgotten() -> None:
    """Without detections a posterior goes towards the uniform one, and the class reported stays."""
    parameters = motor(max_misses=1000, survival=1.0, min_existence=1e-300)
    results = steps(
        parameters, [seen(parameters, 0.0, ("bus", 20.0, 0.9)), seen(parameters, 0.1), seen(parameters, 5.0)]
    )
    first, second, last = (one.density.class_probability for one in results)
    assert first is not None
    assert second is not None
    assert last is not None
    assert first[0, 3] > second[0, 3] > last[0, 3] > 1 / 3
    np.testing.assert_allclose(last[0, [0, 2, 3]], 1 / 3, atol=0.1)
    assert results[-1].density.bernoulli.label.tolist() == [3]


def test_a_density_is_stored_with_its_posterior() -> None:
    """Bytes make the same density again; wrong columns are refused by name; without groups there is no such column."""
    parameters = motor()
    density = steps(parameters, [seen(parameters, 0.0, ("bus", 20.0, 0.9), ("car", 60.0, 0.7))])[0].density
    columns = optipmb.columns_in(optipmb.bytes_of(density), len(LABELS))
    for name, column in optipmb.columns_of(density).items():
        np.testing.assert_array_equal(columns[name], column, err_msg=name)
    again = optipmb.density_of(density.stamp_ns, density.next_id, columns, LABELS)
    np.testing.assert_array_equal(again.class_probability, density.class_probability)
    good = columns["classes.probability"]
    for wrong in (good[:1], good[:, :3], 2 * good, -good, np.where(good > 0, np.nan, good), good.astype(np.float32)):
        with pytest.raises(optipmb.DensityError, match=r"classes\.probability"):
            optipmb.density_of(density.stamp_ns, density.next_id, columns | {"classes.probability": wrong}, LABELS)
    plain = parse_parameters(random_parameters(0, LABELS))
    assert "classes.probability" not in optipmb.columns_of(
        steps(plain, [seen(plain, 0.0, ("bus", 20.0, 0.9))])[0].density
    )


def test_probabilities_of_another_group_are_refused() -> None:
    """A posterior that gives a class outside the object's group any weight is a DensityError of the step."""
    parameters = motor()
    density = steps(parameters, [seen(parameters, 0.0, ("bus", 20.0, 0.9))])[0].density
    assert density.class_probability is not None
    tracker = optipmb.Tracker(parameters)
    others = np.full((2, 4), 0.25), SimpleNamespace(shape=(1, 4))
    for wrong in (np.array([[0.0, 1.0, 0.0, 0.0]]), np.array([[2.0, 0.0, -1.0, 0.0]]), *others):
        other = optipmb.Density(
            density.stamp_ns, density.next_id, density.bernoulli, density.poisson, density.labels, None, wrong
        )  # type: ignore[arg-type]  # one of them is no array, which has to be refused too
        with pytest.raises(optipmb.DensityError):
            tracker.step(other, seen(parameters, 0.1))


def test_a_density_from_before_there_were_posteriors_goes_on() -> None:
    """Its objects begin as if first detected as their class."""
    parameters = motor()
    density = steps(parameters, [seen(parameters, 0.0, ("bus", 20.0, 1.0))])[0].density
    columns = optipmb.columns_of(density)
    del columns["classes.probability"]
    earlier = optipmb.density_of(density.stamp_ns, density.next_id, columns, LABELS)
    tracker, frame = optipmb.Tracker(parameters), seen(parameters, 0.1, ("truck", 20.0, 0.8))
    found, wanted = tracker.step(earlier, frame).density, tracker.step(density, frame).density
    np.testing.assert_allclose(found.class_probability, wanted.class_probability, rtol=1e-12)


def test_a_vehicle_of_two_names_keeps_its_id_by_default() -> None:
    """A car that is called a truck in three frames of ten is one track of `auto`, a car."""
    parameters = optipmb.generic_parameters(("car", "truck"), 0.1)
    tracker, found = optipmb.OnlineTracker(parameters), list[optipmb.OnlineTracks]()
    for k, truck in enumerate(np.random.default_rng(4).random(100) < 0.3):
        boxes = {"center": [[0.8 * k, 5.0, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.0], "score": [0.9]}
        found.append(tracker.update(stamp_ns=k * 100_000_000, label=["truck" if truck else "car"], **boxes))
    assert {int(identity) for one in found for identity in one.tracks.id} == {1}
    assert all(len(one) == 1 for one in found[5:])
    assert {parameters.labels[label] for label in found[-1].tracks.label} == {"car"}
