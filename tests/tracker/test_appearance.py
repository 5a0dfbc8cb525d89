"""Vectors of appearance where tracks are joined over gaps: how they are counted, compared, kept and refused."""

from dataclasses import replace
from typing import Any

import gaps
import numpy as np
import pytest
from optipmb_tools.run.rejoining import tracklets

import optipmb
from optipmb import OnlineTracker, Rejoin, Relocation, Tracker, generic_parameters
from optipmb.joining.appearance import Vectors, appearance_score
from optipmb.model.lost_objects import DISTANCES, Appearance

GENERIC = generic_parameters(gaps.CLASSES, 0.1)
HOW = Rejoin(embedding_model="reid-7")
RECORDING = gaps.record("square", 8, 20.0)
FRAMES = gaps.with_vectors(RECORDING, 0.85, numbers=15)
Floats = np.ndarray[Any, np.dtype[np.float64]]


def last(frames: list[dict[str, Any]], how: Rejoin = HOW, density: optipmb.Density | None = None) -> optipmb.StepResult:
    """Return the result of the last frame."""
    tracker = Tracker(GENERIC, rejoin=how)
    density = density or tracker.initial()
    for given in frames:
        result = tracker.step(density, optipmb.make_frame(GENERIC, **given)[0])
        density = result.density
    return result


def appearance_of(density: optipmb.Density) -> Appearance:
    assert density.rejoining is not None
    assert density.rejoining.appearance is not None
    return density.rejoining.appearance


def direction(vector: Floats) -> Floats:
    return vector / np.linalg.norm(vector)


class Twin:
    """The vectors and the counts, in numpy: by track, without kernels."""

    def __init__(self) -> None:
        self.total: dict[int, tuple[int, Floats]] = {}
        self.first: dict[int, tuple[int, Floats]] = {}
        self.counted: dict[int, int] = {}
        self.decided: set[int] = set()
        self.counts = np.zeros((3, 3, DISTANCES))

    def follow(self, result: optipmb.StepResult, given: dict[str, Any]) -> None:
        """Follow the tracks of a frame."""
        stamp, here = given["stamp_ns"], {}
        for one, label, detection in zip(result.tracks.id, result.tracks.label, result.tracks.detection, strict=True):
            if detection >= 0:
                if one in self.decided and one not in self.first and one in self.total:
                    self.first[one] = self.total[one]
                    self.counted[one] = self.total[one][0]
                before, total = self.total.get(one, (stamp, np.zeros(15)))
                vector = given["embedding"][detection].astype(np.float64)
                self.total[one] = stamp, np.exp((before - stamp) * 1e-9) * total + direction(vector)
                if one in self.decided:
                    here[one] = label
        order = list(here)
        for at, one in enumerate(order):
            if one not in self.first or stamp - self.counted[one] < 5e8 or stamp - self.first[one][0] > 1e10:
                continue
            self.counted[one] = stamp
            since, first = self.first[one]
            new = self.total[one][1] - np.exp((since - stamp) * 1e-9) * first
            others = [other for other in order[at + 1 :] + order[:at] if here[other] == here[one]][:8]
            for which, vector in [(0, new), *((1, self.total[other][1]) for other in others)]:
                apart = np.linalg.norm(direction(vector) - direction(first))
                self.counts[here[one], which, int(apart * DISTANCES / 2)] += 1
        assert result.joined is not None
        self.decided |= set(result.tracks.id[result.joined.object >= 0].tolist())


def test_vectors_and_counts_are_those_of_plain_numpy() -> None:
    """The vector of each track and the histograms of each class equal a plain dictionary of tracks."""
    tracker, twin = Tracker(GENERIC, rejoin=HOW), Twin()
    density = tracker.initial()
    for given in FRAMES[:120]:
        result = tracker.step(density, optipmb.make_frame(GENERIC, **given)[0])
        density = result.density
        twin.follow(result, given)
    found = appearance_of(density)
    assert density.rejoining is not None
    assert len(density.rejoining.lost) > 3
    for rows, vectors in ((density.rejoining.live, found.total), (density.rejoining.lost, found.lost)):
        for one, vector in zip(rows.id.tolist(), vectors, strict=True):
            expected = twin.total[one][1] if one in twin.total else np.zeros(15)
            np.testing.assert_allclose(vector[:15], expected, atol=1e-5)
            assert vector[15] == 0.0
    assert found.counts.sum() > 2000
    assert np.abs(found.counts - twin.counts).sum() <= 4  # a distance at the edge of a bin


@pytest.mark.parametrize(
    ("sure", "alike", "bounds"),
    [(0, True, (-1.0, 4.0)), (50, False, (0.0, 4.0)), (50, True, (-1.0, 4.0)), (100, True, (-6.0, 4.0)),
     (2000, True, (-6.0, 8.0))],
)  # fmt: skip
def test_the_score_is_the_smoothed_ratio(sure: int, alike: bool, bounds: tuple[float, float]) -> None:  # noqa: FBT001
    """Of the histograms by hand, within bounds that widen with sure joins; nothing for few counts or no vector."""
    chance = np.random.default_rng(5)
    counts = np.zeros((1, 3, DISTANCES))
    counts[0, 0, 4:12], counts[0, 1, 9:20] = chance.integers(20, 60, 8), chance.integers(100, 400, 11)
    lost = chance.standard_normal((1, 6)).astype(np.float32)
    counts[0, 1] *= 10.0
    same, different, _ = counts[0]
    counts[0, 2, 5 if alike else 18] = sure
    used = np.stack((counts[0, 2] if sure >= 100 else same, different))
    padded = np.pad(used, ((0, 0), (1, 1)), mode="edge")
    smooth = 0.25 * (padded[:, :-2] + 2.0 * used + padded[:, 2:]) / used.sum(axis=1, keepdims=True)
    ratio = (smooth[0] + 0.5 / used[0].sum()) / (smooth[1] + 0.5 / used[0].sum())
    found = set()
    for angle in np.linspace(0.01, np.pi - 0.01, 40):
        aside = direction(np.linalg.qr(np.column_stack((lost[0], chance.standard_normal(6))))[0][:, 1])
        one = (np.cos(angle) * direction(lost[0].astype(float)) + np.sin(angle) * aside) * 3.0
        live = np.array([one], np.float32)
        vectors = Vectors(np.array([9]), live, np.array([2]), lost, counts)
        at = int(np.sin(0.5 * angle) * DISTANCES)
        expected = np.clip(np.log(ratio[at]), *bounds)
        assert appearance_score(vectors, 2, 9, 0) == pytest.approx(expected, rel=1e-5)
        found.add(np.sign(expected))
        few = vectors._replace(counts=np.stack([[199.0 * same / same.sum(), different, counts[0, 2]]]))
        assert appearance_score(few, 2, 9, 0) == 0.0
        assert appearance_score(vectors._replace(total=np.zeros_like(live)), 2, 9, 0) == 0.0
    assert {np.sign(bounds[0]), 1.0} <= found


def test_sure_joins_count_the_distances_over_gaps() -> None:
    """Vectors of another side behind a gap are counted where motion alone is sure, and cost no join."""
    recording = gaps.record("car park", 8, 60.0)
    turned = gaps.with_vectors(recording, 4.0, numbers=15, lasts=True)
    found = []
    for frames, how in ((recording.frames, Rejoin()), (turned, HOW)):
        tracks = gaps.tracked(frames, GENERIC, how)
        rows = tracklets(tracks, GENERIC.labels)
        found.append(gaps.judge(rows, gaps.decided(tracks, rows), gaps.owners(tracks, recording.source)).counts(0.0))
    (plain, *_), (right, wrong, _) = found
    assert right >= 0.97 * plain > 20
    assert wrong <= 1
    counts = appearance_of(last(turned).density).counts[0, 2]
    assert 20 <= counts.sum() <= right
    assert counts[: DISTANCES // 3].sum() < 0.2 * counts.sum()


def test_vectors_join_what_motion_does_not() -> None:
    """In a crowd, on seconds in which the counts are already enough, more joins are right, and few are wrong."""
    recording = gaps.record("square", 41, 50.0)
    found = []
    for frames, how in ((gaps.with_vectors(recording, 0.85), HOW), (recording.frames, Rejoin())):
        tracks = gaps.tracked(frames, GENERIC, how)
        rows = tracklets(tracks, GENERIC.labels)
        judged = gaps.judge(rows, gaps.decided(tracks, rows), gaps.owners(tracks, recording.source))
        found.append(judged.counts(0.0)[:2])
    (right, wrong), (fewer, _) = found
    assert right >= 1.3 * fewer > 5
    assert wrong <= right / 20


@pytest.fixture(scope="module")
def result() -> optipmb.StepResult:
    """The result of the last frame, with lost objects."""
    return last(FRAMES[:120])


def test_vectors_are_part_of_the_stored_state(result: optipmb.StepResult) -> None:
    """A density that is written and read goes on to the same bytes; a motion of the world leaves vectors alone."""
    density = result.density
    parts = optipmb.bytes_of(density)
    columns = optipmb.columns_in(parts, len(density.labels))
    read = optipmb.density_of(density.stamp_ns, density.next_id, columns, density.labels)
    assert optipmb.bytes_of(read) == parts
    one, other = (last(FRAMES[120:150], density=start).density for start in (density, read))
    assert optipmb.bytes_of(one) == optipmb.bytes_of(other)
    moved = Relocation(10.0, 5.0, 0.0, 1.0).density(density)
    assert appearance_of(moved) is appearance_of(density)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("total", lambda one: one[:-1]),
        ("first", lambda one: np.full_like(one, np.inf)),
        ("stamp_ns", lambda one: one + 10**12),
        ("lost", lambda one: one.astype("f8")),
        ("counts", lambda one: one - 1.0),
        ("model", lambda one: one[:1]),
        ("total", lambda _: None),
    ],
)
def test_a_stored_state_that_does_not_fit_is_refused(result: optipmb.StepResult, name: str, change: Any) -> None:
    """The column is named."""
    columns = optipmb.columns_of(result.density)
    path, state = f"rejoin.appearance.{name}", (result.density.stamp_ns, result.density.next_id)
    with pytest.raises(optipmb.DensityError, match=path if name != "model" else "rejoin.appearance"):
        optipmb.density_of(*state, columns | {path: change(columns[path])}, result.density.labels)


def test_bytes_of_no_length_of_vectors_are_refused(result: optipmb.StepResult) -> None:
    """A model of one number is none."""
    parts = optipmb.bytes_of(result.density) | {"rejoin.appearance.model": np.array([7, 1]).tobytes()}
    with pytest.raises(optipmb.DensityError, match=r"rejoin\.appearance\.model: expected 2 to 512"):
        optipmb.columns_in(parts, 3)


def test_vectors_of_another_model_change_nothing() -> None:
    """They are ignored, as are all without the setting: the same tracks, and a state without vectors."""
    plain, other = last(RECORDING.frames[:60], Rejoin()), last(FRAMES[:60], Rejoin(embedding_model="reid-8"))
    assert optipmb.bytes_of(plain.density) == optipmb.bytes_of(other.density)
    assert optipmb.bytes_of(last(FRAMES[:60], Rejoin()).density) == optipmb.bytes_of(plain.density)


def test_another_model_in_the_setting_begins_anew(result: optipmb.StepResult) -> None:
    """State of the model before is dropped at the next frame, for vectors of any length."""
    density = last(FRAMES[120:121], Rejoin(embedding_model="reid-8"), result.density).density
    assert density.rejoining is not None
    assert density.rejoining.appearance is None
    given = FRAMES[120] | {"embedding": FRAMES[120]["embedding"][:, :4], "embedding_model": "reid-8"}
    begun = last([given], Rejoin(embedding_model="reid-8"), result.density).density
    assert appearance_of(begun).counts.sum() == 0.0
    assert np.abs(appearance_of(begun).total).sum() > 0.0
    assert not appearance_of(begun).lost.any()


def test_another_length_is_refused(result: optipmb.StepResult) -> None:
    """Of the same model; a frame without vectors is none of another length."""
    short = FRAMES[120] | {"embedding": FRAMES[120]["embedding"][:, :4]}
    with pytest.raises(optipmb.FrameError, match="embedding: expected 15 numbers for each detection"):
        last([short], density=result.density)
    without = last([RECORDING.frames[120]], density=result.density).density
    kept = appearance_of(without)
    assert kept.counts.tobytes() == appearance_of(result.density).counts.tobytes()
    assert without.rejoining is not None
    assert len(kept.total) == len(without.rejoining.live)


BOXES: dict[str, Any] = {"center": [[0, 0, 0], [9, 0, 0], [18, 0, 0]], "label": ["car"] * 3}
LOOKS = [[3.0, 4.0], [0.0, 1e-5], [np.nan, np.nan]]


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"embedding": LOOKS[:2]}, "embedding"),
        ({"embedding": [1, 2, 3]}, "embedding"),
        ({"embedding": [[1], [2], [3]]}, "embedding"),
        ({"embedding": np.ones((3, 513))}, "embedding"),
        ({"embedding": [[1, 2], [1, 1e300], [1, 2]]}, r"embedding\[1\]\[1\]"),
        ({"embedding": [[1, 2], [1, np.nan], [1, 2]]}, r"embedding\[1\]\[1\]"),
        ({"embedding": [[1, 2], [1, 2], [0, 9e-7]]}, r"embedding\[2\]"),
        ({"embedding_model": None}, "embedding_model"),
        ({"embedding_model": "reid-8"}, "embedding_model: expected 'reid-7'"),
    ],
)
def test_vectors_that_are_none_are_refused(change: dict[str, Any], path: str) -> None:
    """With the path, before anything changes; a row of NaN is unknown."""
    tracker = OnlineTracker(GENERIC, rejoin=HOW)
    tracker.update(BOXES, t=0.0, embedding=LOOKS, embedding_model="reid-7")
    before, given = tracker.density, {"embedding": LOOKS, "embedding_model": "reid-7"} | change
    assert appearance_of(before).total.any(axis=1).tolist() == [True, True, False]
    with pytest.raises(optipmb.FrameError, match=path):
        tracker.update(BOXES, t=0.1, **given)
    assert tracker.density is before
    with pytest.raises(optipmb.FrameError, match="embedding_model: expected the model of Rejoin"):
        OnlineTracker(GENERIC).update(BOXES, t=0.0, embedding=LOOKS, embedding_model="reid-7")
    frame, _ = optipmb.make_frame(
        GENERIC, stamp_ns=0, labels=("car", "boat"), center=BOXES["center"], label=[0, 1, 0], score=[0.9] * 3,
        embedding=LOOKS, embedding_model="reid-7",
    )  # fmt: skip
    assert frame.embedding is not None
    assert len(frame.embedding.vectors) == 2
    with pytest.raises(optipmb.FrameError, match="embedding"):
        replace(frame, embedding=frame.embedding._replace(vectors=frame.embedding.vectors[:1]))
