"""Attributes of detections: which texts a track keeps, and how they decide on joins over gaps."""

from typing import Any

import gaps
import numpy as np
import pytest

import optipmb
from optipmb import FrameError, OnlineTracker, Passage, Rejoin, generic_parameters
from optipmb.model.attributes import MOST_NAMES, MOST_TEXTS, Attributes, gathered, texts_of, words_of

GENERIC = generic_parameters(gaps.CLASSES, 0.1)
HIDDEN = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)))
"""A car that is hidden for four seconds and goes on as before."""


def tracked(frames: list[dict[str, Any]], attributes: Any, how: Rejoin | None = None) -> optipmb.OnlineTracks:
    """Return the last tracks of frames, given the attributes of each detection by time."""
    tracker = OnlineTracker(GENERIC, rejoin=how)
    for one in frames:
        given = {name: value for name, value in one.items() if name not in {"labels", "stamp_ns"}}
        texts = [attributes(one["stamp_ns"] / 1e9)] * len(one["score"])
        tracks = tracker.update(given, stamp_ns=one["stamp_ns"], attributes=texts)
    return tracks


def test_a_track_keeps_the_text_with_most_evidence() -> None:
    """Scores of a text add up; detections without attributes leave its share of the evidence as it is."""

    def reading(t: float) -> dict[str, Any] | None:
        plates = {0.1: ("8", 0.9), 0.2: ("B", 0.5), 0.3: ("B", np.float32(0.7))}
        return {"plate": plates[at]} if (at := round(t, 1)) in plates else None

    tracks = tracked(gaps.cars((0, 3, (0, 0), (8, 0)))[:20], reading)
    texts, share = tracks.attributes["plate"]
    assert texts.tolist() == ["B"]
    assert share == pytest.approx([1.2 / 2.1])
    assert tracks.columns()["attributes.plate"].tolist() == ["B"]


@pytest.mark.parametrize(("later", "expected"), [("AB 1", 1), ("AB 2", 2), (None, 1)])
def test_a_contradiction_forbids_a_join(later: str | None, expected: int) -> None:
    """A car with another plate is another car; one with the same or an unknown plate is the same, and keeps it."""

    def reading(t: float) -> dict[str, Any] | None:
        plate = "AB 1" if t < 5.0 else later
        return plate and {"plate": plate}  # type: ignore[return-value]

    tracks = tracked(HIDDEN, reading, Rejoin())
    assert tracks.object is not None
    assert tracks.object.tolist() == [expected]
    assert tracks.attributes["plate"][0].tolist() == [later or "AB 1"]


def test_equal_attributes_raise_the_odds_within_a_bound() -> None:
    """Each equal attribute adds 3 to the log odds, all together no more than 6, where two cars fit equally well."""

    def odds(names: int) -> float:
        frames = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 2.5), (8, 0)), (7, 10, (0, -2.5), (8, 0)))
        tracker = OnlineTracker(GENERIC, rejoin=Rejoin(min_probability=0.5))
        for one in frames:
            given = {name: value for name, value in one.items() if name not in {"labels", "stamp_ns"}}
            known = [{str(name): "x" for name in range(names)} if y > -1.0 else None for _, y, _ in one["center"]]
            tracks = tracker.update(given, stamp_ns=one["stamp_ns"], attributes=known)
        assert tracks.candidate_probability is not None
        share = tracks.candidate_probability[np.argmax(tracks.center[:, 1])]
        return float(np.log(share / (1.0 - share)))

    assert [odds(names) for names in (0, 1, 2, 5)] == pytest.approx([0.0, 3.0, 6.0, 6.0], abs=1e-4)


def test_a_wrong_reading_does_not_forbid_a_join() -> None:
    """A text is known from two thirds of the evidence on: one wrong reading among four decides nothing."""
    tracks = tracked(HIDDEN, lambda t: {"plate": "AB 1" if t < 5.0 or t > 7.15 else "8B 1"}, Rejoin())
    assert tracks.object is not None
    assert tracks.object.tolist() == [1]


def test_memory_is_bounded() -> None:
    """An object has at most eight attributes with four texts each, those with most evidence."""
    names = words_of([f"name {n % 12}" for n in range(120)])
    texts, score = words_of([f"text {n // 12}" for n in range(120)]), np.linspace(0.1, 1.0, 120)
    kept = gathered(Attributes.empty(), np.full(120, 7), names, texts, score)
    assert len(kept) == MOST_NAMES * MOST_TEXTS
    assert set(texts_of(kept.text)) == {"text 6", "text 7", "text 8", "text 9"}
    assert set(texts_of(kept.name)) == {f"name {n}" for n in range(4, 12)}


def test_the_newest_objects_keep_their_attributes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more objects than have attributes at once, the older ones lose theirs."""
    monkeypatch.setattr("optipmb.tracker.MOST_OBJECTS", 2)
    cars = gaps.cars((0, 3, (0, 0), (8, 0)), (1, 3, (0, 20), (8, 0)), (2, 3, (0, 40), (8, 0)))[:25]
    tracks = tracked(cars, lambda _: {"plate": "AB 1"})
    assert tracks.id[tracks.attributes["plate"][1] > 0.0].tolist() == [2, 3]


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ([], "attributes"),
        (["AB 1"], "attributes[0]"),
        ([{"plate": ""}], "attributes[0].plate"),
        ([{"plate": "ü" * 17}], "attributes[0].plate"),
        ([{"plate": ("AB 1", 1.5)}], "attributes[0].plate"),
        ([{"plate": 7}], "attributes[0].plate"),
        ([{"plate": "AB \ud800"}], "attributes[0].plate"),
        ([{"": "AB 1"}], "attributes[0]"),
        ([{str(n): "x" for n in range(9)}], "attributes[0]"),
    ],
)
def test_what_is_no_attribute_is_refused(given: Any, path: str) -> None:
    """The error names the detection and the attribute; nothing has changed."""
    tracker = OnlineTracker(GENERIC)
    box = [{"class": "car", "x": 0.0, "y": 0.0, "l": 4.5, "w": 1.9, "yaw": 0.0}]
    with pytest.raises(FrameError) as error:
        tracker.update(box, t=0.0, attributes=given)
    assert error.value.path == path
    assert tracker.density.stamp_ns == -1


def test_a_restored_density_goes_on_equally() -> None:
    """In a gap, with exits, passages and attributes, bytes of the density give the same tracks and the same bytes."""
    how = Rejoin(
        exits=(((30.0, 10.0), (40.0, 10.0), (40.0, 20.0), (30.0, 20.0)),),
        passages=(Passage(((20, -3), (30, -3), (30, 3), (20, 3)), ((50, -3), (62, -3), (62, 3), (50, 3)), (2.0, 8.0)),),
    )
    tracker = optipmb.Tracker(GENERIC, rejoin=how)
    density, other = tracker.initial(), None
    for one in HIDDEN:
        texts = [{"plate": "AB 1", "colour": ("rot", 0.5)}] * len(one["score"])
        frame, _ = optipmb.make_frame(GENERIC, **one, attributes=texts)
        density = tracker.step(density, frame).density
        if other is not None:
            other = tracker.step(other, frame).density
            assert optipmb.bytes_of(density) == optipmb.bytes_of(other)
        elif one["stamp_ns"] == 5 * 10**9:
            columns = optipmb.columns_in(optipmb.bytes_of(density), len(GENERIC.labels))
            other = optipmb.density_of(density.stamp_ns, density.next_id, columns, GENERIC.labels)
    assert density.attributes is not None
    assert set(density.attributes.id.tolist()) == {2}


def test_attributes_of_a_stored_density_are_checked() -> None:
    """Ids that were never given and negative evidence are refused by their names."""
    tracker = OnlineTracker(GENERIC)
    tracker.update([{"class": "car", "x": 0.0, "y": 0.0}], t=0.0, attributes=[{"plate": "AB 1"}])
    columns = optipmb.columns_of(tracker.density)
    for name, value in (("id", 9), ("evidence", -1.0)):
        wrong = columns | {f"attributes.{name}": np.full_like(columns[f"attributes.{name}"], value)}
        with pytest.raises(optipmb.DensityError, match=f"attributes.{name}"):
            optipmb.density_of(0, tracker.density.next_id, wrong, GENERIC.labels)
