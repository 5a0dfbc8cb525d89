"""The figures of the nuScenes tracking benchmark: known answers, filters, interpolation, and naive twins."""

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_cases import tracks_of
from hypothesis import given, settings
from hypothesis import strategies as st
from nuscenes_cases import Rows, disturbed_tracks, greedy_tracks, truth_tracks, write
from nuscenes_tables import Scene, Thing, crowd, write_detections, write_root
from optipmb_tools.cli import run
from optipmb_tools.datasets import DatasetError
from optipmb_tools.datasets.nuscenes import NuScenesDataset, NuScenesSequence
from optipmb_tools.evaluation.cases import Case
from optipmb_tools.evaluation.nuscenes import (
    NuScenesClass,
    NuScenesConfig,
    NuScenesScene,
    NuScenesScores,
    ObjectState,
    Racks,
    ThresholdMatches,
    TrackBoxes,
    evaluate_nuscenes,
    evaluate_scenes,
    interpolate,
    pair,
    prepare_scene,
)
from optipmb_tools.results.nuscenes import NUSCENES_CLASSES
from real_data import nuscenes_root

CAR, PEDESTRIAN = NUSCENES_CLASSES.index("car"), NUSCENES_CLASSES.index("pedestrian")
NO_RACKS = Racks(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
PATIENT = settings(deadline=None)  # other work on the machine may make any example slow
RECALLS = np.linspace(0.1, 1.0, 40).round(12)

Row = tuple[int, int, float, float]
"""Frame, id, x, y."""


def boxes(rows: Sequence[Row], scores: Sequence[float] | float = math.nan, label: int = CAR) -> TrackBoxes:
    rows = sorted(rows, key=lambda row: row[0])
    count = len(rows)
    return TrackBoxes(
        frame=np.array([row[0] for row in rows], dtype=np.int64),
        id=np.array([row[1] for row in rows], dtype=np.int64),
        label=np.full(count, label, dtype=np.int64),
        center=np.array([[row[2], row[3], 0.0] for row in rows]).reshape(-1, 3),
        score=np.broadcast_to(np.asarray(scores, dtype=np.float64), count).copy(),
    )


def scene_of(rows: Sequence[Row], frames: int = 10) -> NuScenesScene:
    """Give a scene with cars around a car that stands at the origin."""
    stamps = 500_000 * np.arange(frames, dtype=np.int64)
    return NuScenesScene("made", stamps, np.zeros((frames, 2)), NO_RACKS, interpolate(boxes(rows), stamps))


def cars(
    truth: Sequence[Row], tracks: Sequence[tuple[int, int, float, float, float]], frames: int = 10
) -> NuScenesClass:
    return evaluate_scenes([(scene_of(truth, frames), tracks_of(tracks, "car"))]).classes["car"]


def still(identity: int, x: float, frames: Sequence[int] = range(10), y: float = 0.0) -> list[Row]:
    return [(frame, identity, x, y) for frame in frames]


def followed(rows: Sequence[Row], score: float = 0.5, dx: float = 0.0) -> list[tuple[int, int, float, float, float]]:
    """Give tracks that follow objects at a distance."""
    return [(frame, identity, x + dx, y, score) for frame, identity, x, y in rows]


TWO = [*still(1, 0.0), *still(2, 10.0)]


ONE = still(1, 0.0)
AWAY = [(frame, 1, 5.0 if frame in (4, 5) else 0.0, 0.0) for frame in range(10)]
CHANGED = [*still(7, 0.0, range(5)), *still(8, 0.0, range(5, 10))]
FOUND_AGAIN = [*still(7, 0.0, range(3)), *still(8, 0.0, range(7, 10))]
EXCHANGED = [(frame, one if frame < 6 else 3 - one, x, y) for frame, one, x, y in TWO]
NEW = [(frame, 100 * frame + one, x, y) for frame, one, x, y in TWO]


@pytest.mark.parametrize(
    ("truth", "tracks", "expected"),
    [
        (TWO, TWO, {"recall": 1.0, "motar": 1.0, "mota": 1.0, "motp": 0.0, "gt": 20, "tp": 20, "fp": 0, "fn": 0}),
        (TWO, TWO, {"ids": 0, "frag": 0, "mt": 2, "ml": 0, "faf": 0.0, "tid": 0.0, "lgd": 0.0, "threshold": 0.5}),
        # Two metres apart is no match any more.
        (ONE, [*ONE[:9], (9, 1, 2.0, 0.0)], {"tp": 9, "fp": 1, "fn": 1}),
        # A switch counts once and is no true positive.
        (ONE, CHANGED, {"tp": 9, "ids": 1, "fn": 0, "fp": 0, "recall": 1.0, "mota": 0.9, "motar": 1.0}),
        # It counts after a gap, however long.
        (ONE, FOUND_AGAIN, {"ids": 1, "fn": 4, "frag": 1}),
        (TWO, EXCHANGED, {"ids": 2}),
        (TWO, NEW, {"ids": 18, "tp": 2, "recall": 1.0, "mota": 0.1}),
        # A break is a fragment, and a gap of one second.
        (ONE, AWAY, {"tp": 8, "fp": 2, "fn": 2, "ids": 0, "frag": 1, "mota": 0.6, "motar": 0.75, "faf": 20.0}),
        (ONE, AWAY, {"lgd": 1.0, "tid": 0.0, "mt": 1}),
        # A track that begins late has a delay, and no fragment.
        (ONE, still(1, 0.0, range(3, 10)), {"tid": 1.5, "lgd": 1.5, "frag": 0, "fn": 3, "mt": 0, "ml": 0}),
        # Delay and gap are means over the objects that are found; the others are mostly lost.
        ([*TWO, *still(3, 20.0)], [*still(1, 0.0, range(2, 10)), *still(2, 10.0)], {"tid": 0.5, "lgd": 0.5, "ml": 1}),
        # Tracked from 80 % of the frames on, lost below 20 %; a track that ends breaks none.
        (ONE, still(1, 0.0, range(1)), {"mt": 0, "ml": 1, "frag": 0}),
        (ONE, still(1, 0.0, range(2)), {"mt": 0, "ml": 0, "frag": 0}),
        (ONE, still(1, 0.0, range(7)), {"mt": 0, "ml": 0, "frag": 0}),
        (ONE, still(1, 0.0, range(8)), {"mt": 1, "ml": 0, "frag": 0}),
    ],
)
def test_known_figures(truth: list[Row], tracks: list[Row], expected: dict[str, float]) -> None:
    """Small cases with known answers."""
    best = vars(cars(truth, followed(tracks)).best)
    assert {name: best[name] for name in expected} == pytest.approx(expected)


def test_holes_are_filled() -> None:
    """A hole in a track, and one in the truth, is no error: both are filled between their ends."""
    holes = [row for row in TWO if row[0] not in (3, 4, 7)]
    assert cars(TWO, followed(holes)).best.tp == 20
    assert cars(holes, followed(TWO)).best.gt == 20
    assert cars(holes, followed(TWO)).amota == 1.0


def test_the_threshold_with_the_best_mota_is_taken() -> None:
    """A false track of a low score does not count at the best threshold; it does where it scores above an object's."""
    truth = [*followed(still(1, 0.0), 0.9), *followed(still(2, 10.0), 0.5)]
    low = cars(TWO, [*truth, *followed(still(9, 30.0), 0.3)])
    assert (low.best.threshold, low.best.fp, low.best.mota, low.amota) == (0.5, 0, 1.0, 1.0)
    high = cars(TWO, [*truth, *followed(still(9, 30.0), 0.7)])
    # Equal MOTA at 0.9 and at 0.5: the higher recall wins.
    assert (high.best.threshold, high.best.fp, high.best.recall, high.best.mota) == (0.5, 10, 1.0, 0.5)
    # MOTAR is 1 from 0.9 on, and 1 - 10 / 20 at 0.5; in between thresholds are interpolated and hit the false track.
    points = [point.motar for point in high.curve if point]
    assert points[0] == 0.5
    assert points[-1] == 1.0


def test_unreached_recalls_count_as_the_worst() -> None:
    """With half of the truth found without errors, AMOTA is the share of recalls up to a half."""
    scores = cars(TWO, followed(still(1, 0.0)))
    reached = RECALLS <= 0.5
    assert scores.amota == pytest.approx(reached.mean())
    assert scores.amotp == pytest.approx(2.0 * (~reached).mean())
    assert [point is not None for point in scores.curve] == reached[::-1].tolist()
    assert scores.recalls == tuple(RECALLS[::-1].tolist())


def test_no_tracks_give_the_worst_figures() -> None:
    """Without tracks: zero recall and accuracy, all missed and lost, undefined figures are NaN."""
    scores = cars(TWO, [])
    assert (scores.amota, scores.amotp) == (0.0, 2.0)
    best = scores.best
    assert (best.recall, best.mota, best.motp, best.tp, best.fn, best.ml, best.mt) == (0.0, 0.0, 2.0, 0, 20, 2, 0)
    assert (best.tid, best.lgd, best.faf) == (20.0, 20.0, 500.0)
    assert all(math.isnan(value) for value in (best.fp, best.ids, best.frag, best.threshold))


def test_classes_without_truth_are_undefined_and_do_not_weigh() -> None:
    """Tracks of a class that the truth lacks change nothing, and its figures are null in JSON."""
    scene = scene_of(TWO)
    wrong = [*followed(TWO), *followed(still(50, 5.0))]
    scores = evaluate_scenes([(scene, tracks_of(wrong, ["car"] * 20 + ["bus"] * 10))])
    assert scores.overall["amota"] == 1.0
    assert math.isnan(scores.classes["bus"].amota)
    shown = json.loads(json.dumps(scores.to_json(), allow_nan=False))
    assert shown["classes"]["bus"]["amota"] is None
    assert shown["classes"]["car"]["tp"] == 20
    assert shown["overall"]["fp"] == 0
    assert shown["scenes"] == ["made"]


def test_nothing_at_all_is_undefined() -> None:
    """A scene without truth and without tracks gives undefined figures and no warning."""
    scores = evaluate_scenes([(scene_of([]), tracks_of([], "car"))])
    assert math.isnan(scores.overall["amota"])
    assert scores.overall["fp"] == 0


def test_overall_figures_are_sums_and_means() -> None:
    """Counts of errors add up over classes, everything else is averaged over the classes that the truth has."""
    stamps = 500_000 * np.arange(10, dtype=np.int64)
    walkers = boxes(still(5, 20.0), label=PEDESTRIAN)
    both = [np.concatenate(pair) for pair in zip(*(vars(part).values() for part in (boxes(TWO), walkers)), strict=True)]
    truth = TrackBoxes(*both)
    truth = truth.take(np.argsort(truth.frame, kind="stable"))
    scene = NuScenesScene("made", stamps, np.zeros((10, 2)), NO_RACKS, truth)
    overall = evaluate_scenes([(scene, tracks_of(followed(still(1, 0.0)), "car"))]).overall
    assert overall["fn"] == 10 + 10
    assert overall["ml"] == 2
    assert overall["gt"] == 15
    assert overall["recall"] == 0.25


def test_several_scenes_are_one_evaluation() -> None:
    """Counts of scenes add up, thresholds are common, and equal ids in two scenes are different tracks."""
    first = (scene_of(still(1, 0.0)), tracks_of(followed(still(7, 0.0), 0.9), "car"))
    second = (scene_of(still(1, 10.0)), tracks_of(followed(still(7, 10.0), 0.4), "car"))
    best = evaluate_scenes([first, second]).classes["car"].best
    assert (best.gt, best.tp, best.ids, best.mt, best.threshold) == (20, 20, 0, 2, 0.4)
    alone = evaluate_scenes([first, (second[0], tracks_of([], "car"))]).classes["car"].best
    assert (alone.tp, alone.fn) == (10, 10)


def pairing(truth: Sequence[Row], tracks: Sequence[Row], score: Sequence[float] | float = 0.5) -> Case:
    return pair(boxes(truth), boxes(tracks, score), CAR, 2.0)


def naive_match(truth: Sequence[Row], tracks: Sequence[tuple[Row, float]], threshold: float) -> list[tuple[int, float]]:
    """Match as the definition says, by trying all assignments; give event and distance of each truth row."""
    last: dict[int, int] = {}
    result = []
    for frame in range(10):
        objects = [row for row in truth if row[0] == frame]
        free = [row for row, score in tracks if row[0] == frame and score >= threshold]
        metres = {(o, t): math.dist(o[2:], t[2:]) for o in objects for t in free}
        chosen: dict[Row, tuple[int, Row]] = {}
        for one in objects:
            old = [t for t in free if t[1] == last.get(one[1]) and metres[one, t] < 2.0]
            if old and old[0] not in [row for _, row in chosen.values()]:
                chosen[one] = (ObjectState.MATCH, old[0])
        rest = [one for one in objects if one not in chosen]
        left = [t for t in free if t not in [row for _, row in chosen.values()]]
        best: tuple[tuple[int, float], list[tuple[Row, Row]]] = ((0, 0.0), [])
        for order in itertools.permutations([*left, *[None] * len(rest)], len(rest)):
            some = [(o, t) for o, t in zip(rest, order, strict=True) if t is not None and metres[o, t] < 2.0]
            best = min(best, ((-len(some), sum(metres[one] for one in some)), some), key=lambda pair: pair[0])
        for one, t in best[1]:
            chosen[one] = (ObjectState.SWITCH if last.get(one[1], t[1]) != t[1] else ObjectState.MATCH, t)
        for one in objects:
            event, row = chosen.get(one, (ObjectState.MISS, None))
            result.append((int(event), 0.0 if row is None else metres[one, row]))
            if row is not None:
                last[one[1]] = row[1]
    return result


@PATIENT
@given(st.integers(0, 2**32 - 1))
def test_matching_is_the_definition(seed: int) -> None:
    """Matching equals trying all assignments, at several thresholds, for objects and tracks that crowd together."""
    chance = np.random.default_rng(seed)

    def rows(first: int) -> list[Row]:
        return [
            (frame, first + one, float(chance.uniform(0, 3)), float(chance.uniform(0, 3)))
            for frame in range(5)
            for one in range(4)
            if chance.random() < 0.7
        ]

    truth, tracks = rows(0), rows(10)
    scores = {one: float(chance.random()) for one in range(10, 14)}
    made = pairing(truth, tracks, [scores[row[1]] for row in tracks])
    for threshold in (-math.inf, 0.5):
        found = ThresholdMatches.of(made, threshold)
        wanted = naive_match(truth, [(row, scores[row[1]]) for row in tracks], threshold)
        assert found.event.tolist() == [event for event, _ in wanted]
        assert found.distance == pytest.approx([metres for _, metres in wanted])
        kept = [row for row in tracks if scores[row[1]] >= threshold]
        assert found.false_positives == len(kept) - sum(event != ObjectState.MISS for event, _ in wanted)
        assert found.frames == len({row[0] for row in (*truth, *kept)})


@PATIENT
@given(
    st.dictionaries(st.tuples(st.integers(0, 9), st.integers(0, 3)), st.floats(-50, 50), max_size=30),
    st.lists(st.integers(400_000, 600_000), min_size=9, max_size=9),
)
def test_interpolation_fills_every_hole_and_moves_nothing(
    given_x: dict[tuple[int, int], float], steps: list[int]
) -> None:
    """Afterwards each id is in all frames of its life, on the line between its neighbours, and given boxes are kept."""
    stamps = np.cumsum([0, *steps])
    rows = boxes([(frame, identity, x, 2.0 * x) for (frame, identity), x in given_x.items()])
    filled = interpolate(rows, stamps)
    place = {(f, i): (x, y) for f, i, (x, y, _) in zip(filled.frame, filled.id, filled.center, strict=True)}
    assert len(place) == len(filled)
    assert (np.diff(filled.frame) >= 0).all()
    for identity in {identity for _, identity in given_x}:
        life = sorted(frame for frame, one in given_x if one == identity)
        assert sorted(frame for frame, one in place if one == identity) == list(range(life[0], life[-1] + 1))
        for left, right in itertools.pairwise(life):
            for frame in range(left + 1, right):
                weight = (stamps[right] - stamps[frame]) / (stamps[right] - stamps[left])  # as the official tools do
                x = (1 - weight) * given_x[left, identity] + weight * given_x[right, identity]
                assert place[frame, identity] == pytest.approx((x, 2.0 * x))
    assert all(place[key] == (x, 2.0 * x) for key, x in given_x.items())
    again = interpolate(filled, stamps)
    assert np.array_equal(again.center, filled.center)


def prepared(root: Path, things: list[Thing], frames: int = 3) -> NuScenesSequence:
    write_root(root, [Scene("scene-0103", [(100.0, 200.0)] * frames, things)])
    (sequence,) = NuScenesDataset(root).sequences(["scene-0103"])
    return sequence


@pytest.mark.parametrize(
    ("category", "place", "points", "kept"),
    [
        ("vehicle.car", (149.0, 200.0, 1.0), (5, 0), True),
        ("vehicle.car", (150.0, 200.0, 1.0), (5, 0), False),
        ("human.pedestrian.adult", (139.0, 200.0, 1.0), (5, 0), True),
        ("human.pedestrian.adult", (141.0, 200.0, 1.0), (5, 0), False),
        ("vehicle.car", (110.0, 200.0, 1.0), (0, 0), False),
        ("vehicle.car", (110.0, 200.0, 1.0), (0, 2), True),
        ("vehicle.construction", (110.0, 200.0, 1.0), (5, 0), False),
        ("vehicle.bicycle", (102.0, 205.0, 1.0), (5, 0), False),
        ("vehicle.motorcycle", (102.0, 205.0, 1.0), (5, 0), False),
        ("vehicle.car", (102.0, 205.0, 1.0), (5, 0), True),
        ("vehicle.bicycle", (102.0, 205.0, 5.0), (5, 0), True),
        ("vehicle.bicycle", (105.0, 202.0, 1.0), (5, 0), True),
    ],
)
def test_truth_is_filtered(
    tmp_path: Path, category: str, place: tuple[float, float, float], points: tuple[int, int], *, kept: bool
) -> None:
    """Boxes out of range, without any points, of other classes, and bicycles in a rack (here: along y) do not count."""
    rack = Thing("rack", "static_object.bicycle_rack", 0, (102.0, 203.0, 1.0), math.pi / 2, (2.0, 6.0, 2.0))
    thing = Thing("a", category, 0, place, lidar=points[0], radar=points[1])
    scene = prepare_scene(prepared(tmp_path, [rack, thing]), NuScenesConfig())
    assert len(scene.truth) == int(kept)


@pytest.mark.parametrize(("place", "held"), [((104.0, 205.0, 1.0), True), ((100.0, 205.0, 1.0), False)])
def test_racks_are_turned(tmp_path: Path, place: tuple[float, float, float], *, held: bool) -> None:
    """A rack that stands askew holds bicycles along it and none across it."""
    rack = Thing("rack", "static_object.bicycle_rack", 0, (102.0, 203.0, 1.0), math.pi / 4, (2.0, 8.0, 2.0))
    scene = prepare_scene(prepared(tmp_path, [rack, Thing("a", "vehicle.bicycle", 0, place)]), NuScenesConfig())
    assert len(scene.truth) == int(not held)


def test_tracks_are_filtered_as_the_truth_is(tmp_path: Path) -> None:
    """Tracks out of range and bicycles in a rack are dropped, in the frames in which they are."""
    rack = Thing("rack", "static_object.bicycle_rack", 1, (102.0, 203.0, 1.0), 0.0, (4.0, 4.0, 4.0))
    scene = prepare_scene(prepared(tmp_path, [rack]), NuScenesConfig())
    rows = [(frame, identity, x, y, 0.5) for frame in range(3) for identity, x, y in ((1, 151, 200), (2, 102, 203))]
    table = tracks_of(rows, ["car", "bicycle"] * 3)
    kept = scene.tracks(table, NuScenesConfig())
    # The bicycle is dropped in frame 1, and filled in again: it was there before and after.
    assert kept.id.tolist() == [2, 2, 2]
    gone = scene.tracks(table.take(table.frame < 2), NuScenesConfig())
    assert gone.frame.tolist() == [0]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scenes = [crowd("scene-0103", 1), crowd("scene-0916", 2, 12, 1_538_984_233_000_000)]
    folder = write_root(tmp_path_factory.mktemp("nuscenes"), scenes)
    write_detections(folder, "made", scenes)
    return folder


def evaluated(root: Path, out: Path, tracks: dict[str, list[Rows]]) -> NuScenesScores:
    dataset = NuScenesDataset(root)
    for sequence in dataset.sequences(sorted(tracks)):
        path = write(dataset, sequence, tracks[sequence.name], out)
    return evaluate_nuscenes(root, path)


def test_the_truth_of_whole_scenes_is_perfect(root: Path, tmp_path: Path) -> None:
    """The truth that counts, written as results, has AMOTA 1 in every class that occurs, racks and holes included."""
    sequences = NuScenesDataset(root).sequences(["all"])
    scores = evaluated(root, tmp_path, {one.name: truth_tracks(one, ignored=False) for one in sequences})
    assert scores.scenes == ("scene-0103", "scene-0916")
    for name, value in scores.classes.items():
        assert value.amota == pytest.approx(1.0), name
        assert value.amotp < 1e-5
        assert (value.best.fp, value.best.fn, value.best.ids) == (0, 0, 0)
    assert scores.overall["recall"] == 1.0


def test_results_are_drawn(root: Path, tmp_path: Path) -> None:
    """`plot` draws a scene of the folder that `track` writes, and of a result file, with the same picture."""
    dataset = NuScenesDataset(root)
    for sequence in dataset.sequences(["all"]):
        path = write(dataset, sequence, truth_tracks(sequence), tmp_path)
    data = ["--dataset", "nuscenes", "--root", str(root), "--sequences", "scene-0103"]
    for picture, tracks in (("a.png", path.parent), ("b.png", path)):
        assert run(["plot", *data, "--tracks", str(tracks), "--out", str(tmp_path / picture)]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_scenes_to_evaluate_can_be_chosen(root: Path, tmp_path: Path) -> None:
    """Scenes are taken from the file or from the argument; in memory and by files the figures are the same."""
    sequences = NuScenesDataset(root).sequences(["all"])
    tracks = {one.name: disturbed_tracks(one, 4) for one in sequences}
    both = evaluated(root, tmp_path, tracks)
    first = evaluate_nuscenes(root, tmp_path, ["scene-0103"])
    second = evaluate_nuscenes(root, tmp_path / "scenes" / "scene-0916.json")
    assert both.scenes == ("scene-0103", "scene-0916")
    assert (first.scenes, second.scenes) == (("scene-0103",), ("scene-0916",))
    assert both.classes["car"].best.gt == first.classes["car"].best.gt + second.classes["car"].best.gt


def test_results_and_truth_must_be_there(root: Path, tmp_path: Path) -> None:
    """A missing file, foreign samples, missing samples and a scene without annotations each give one clear line."""
    (sequence, _) = NuScenesDataset(root).sequences(["all"])
    with pytest.raises(DatasetError, match="No such file"):
        evaluate_nuscenes(root, tmp_path)
    path = tmp_path / "other.json"
    path.write_text(json.dumps({"meta": {}, "results": {"foreign": []}}))
    with pytest.raises(DatasetError, match="samples of scenes"):
        evaluate_nuscenes(root, path)
    path.write_text(json.dumps({"meta": {}, "results": {sequence.samples[0]: []}}))
    with pytest.raises(DatasetError, match=f"no sample {sequence.samples[1]}"):
        evaluate_nuscenes(root, path)
    bare = prepared(tmp_path / "bare", [])
    path.write_text(json.dumps({"meta": {}, "results": {token: [] for token in bare.samples}}))
    with pytest.raises(DatasetError, match="annotations of scene-0103"):
        evaluate_nuscenes(tmp_path / "bare", path)


AGREED = json.loads((Path(__file__).with_name("devkit") / "agreed.json").read_text())


def recorded(root: Path, name: str) -> tuple[NuScenesDataset, list[Rows]]:
    kind, _, which = name.partition(" ")
    dataset = NuScenesDataset(root, which if kind == "greedy" else "centerpoint")
    (sequence,) = dataset.sequences(["mini_val"])
    if kind == "greedy":
        return dataset, greedy_tracks(sequence)
    if kind == "truth":
        return dataset, truth_tracks(sequence, ignored=False)
    return dataset, disturbed_tracks(sequence, int(which))


@pytest.mark.parametrize("name", AGREED)
def test_figures_are_those_of_the_official_tools(tmp_path: Path, name: str) -> None:
    """On the recorded scene the figures still equal the official tools (devkit/)."""
    dataset, tracks = recorded(nuscenes_root(), name)
    (sequence,) = dataset.sequences(["mini_val"])
    shown = evaluate_nuscenes(nuscenes_root(), write(dataset, sequence, tracks, tmp_path)).to_json()

    def flat(part: dict[str, Any]) -> dict[str, Any]:
        return {f"{key} {name}": value for key, values in part.items() for name, value in values.items()}

    assert flat(shown["classes"]) == pytest.approx(flat(AGREED[name]["classes"]), abs=1e-6)
    assert shown["overall"] == pytest.approx(AGREED[name]["overall"], abs=1e-6)
