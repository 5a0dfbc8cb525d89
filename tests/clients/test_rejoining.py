"""Tracks joined over gaps: scores and matching against oracles, what columns hold, and the commands."""

import json
from pathlib import Path
from typing import Any

import gaps
import numpy as np
import pytest
from commands import result_of, run_here
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from optipmb_schemas import Tracks
from optipmb_tools.datasets import open_dataset
from optipmb_tools.run import rejoining
from optipmb_tools.run.rejoining import RejoinOptions, joins, matching, tracklets
from optipmb_tools.table_files import read_table
from scipy.linalg import expm
from scipy.optimize import Bounds, LinearConstraint, milp

from optipmb import Parameters, generic_parameters
from optipmb.joining import evidence
from optipmb.joining.decision import Kinds
from optipmb.model.lost_objects import Tracklets

Array = NDArray[np.float64]
GENERIC = generic_parameters(gaps.CLASSES, 0.1)


CAR = np.array(evidence.motion_of("car"))


def score_of(seconds: float, **known: Any) -> float:
    """Return the score of a gap of an object that moves along at 5 m/s."""
    values = {"offset": (0.0, 0.0), "later": (np.nan, np.nan), "later_variance": np.nan} | known
    return evidence.motion_score(
        values["offset"], (5.0, 0.0), 0.04, values["later"], values["later_variance"], seconds, CAR
    )


@pytest.mark.parametrize("seconds", [0.3, 2.0, 30.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_motion_models_are_those_of_their_differential_equations(seconds: float, axis: int) -> None:
    """Factors and covariances equal the matrix exponentials of Van Loan (1978)."""
    motion = evidence.motion_of("car")
    noise = (motion.keeps_along, motion.keeps_across)[axis], (motion.wanders_along, motion.wanders_across)[axis]
    models = evidence.keeps(seconds, 0.04, noise[0]), evidence.wanders(seconds, 0.04, noise[1], motion.memory)
    for model, rate, density in zip(
        models, (0.0, 1.0 / motion.memory), (noise[0] ** 2, 2.0 * noise[1] ** 2 / motion.memory), strict=True
    ):
        drift, block = np.array([[0.0, 1.0], [0.0, -rate]]), np.zeros((4, 4))
        block[:2, :2], block[2:, 2:], block[1, 3] = -drift, drift.T, density
        whole = expm(block * seconds)
        step = whole[2:, 2:].T
        spread = step @ whole[:2, 2:] + step @ np.diag((0.0, 0.04)) @ step.T
        expected = (step[0, 1], step[1, 1], spread[0, 0], spread[0, 1], spread[1, 1])
        assert model == pytest.approx(expected, rel=1e-9)


def test_the_density_of_places_is_that_of_sampled_paths() -> None:
    """Of paths that are simulated step by step, as many end in a region as the density says."""
    rng, count, steps, seconds = np.random.default_rng(1), 20_000, 60, 3.0
    motion, dt, farthest = evidence.motion_of("car"), seconds / 60, 35.0 * seconds + 3.0
    mode = rng.choice(4, count, p=evidence.WEIGHTS[1])
    place, speed = np.zeros((count, 2)), np.array((5.0, 0.0)) + 0.2 * rng.standard_normal((count, 2))
    keeps = np.array((motion.keeps_along, motion.keeps_across))
    wanders = np.array((motion.wanders_along, motion.wanders_across))
    for _ in range(steps):
        place += dt * speed
        white = np.sqrt(dt) * rng.standard_normal((count, 2))
        wandering = -dt * speed / motion.memory + wanders * np.sqrt(2.0 / motion.memory) * white
        speed += np.where((mode == 1)[:, None], keeps * white, wandering)
    place[mode == 0] = 0.0
    angle, radius = rng.uniform(-np.pi, np.pi, count), farthest * np.sqrt(rng.random(count))
    anywhere = np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))
    place = np.where(
        (mode == 3)[:, None], anywhere, place + np.sqrt(2.0) * motion.noise * rng.standard_normal((count, 2))
    )
    for low, high in (((-2, -2), (2, 2)), ((10, -2), (20, 2)), ((2, -1), (10, 1)), ((0, 2), (40, 20))):
        across = [np.arange(a + 0.125, b, 0.25) for a, b in zip(low, high, strict=True)]
        spots = [(x, y) for x in across[0].tolist() for y in across[1].tolist()]
        expected = 0.0625 * sum(np.exp(score_of(seconds, offset=spot)) for spot in spots)
        assert ((place > low) & (place < high)).all(axis=1).mean() == pytest.approx(expected, abs=0.012)


def test_velocities_that_agree_are_evidence() -> None:
    """A later track with the velocity of the earlier one scores higher than one against it or with none."""
    scores = [
        score_of(2.0, offset=(10.0, 0.0), later=later, later_variance=variance)
        for later, variance in (((5.0, 0.0), 0.04), ((np.nan, np.nan), np.nan), ((-5.0, 0.0), 0.04))
    ]
    assert scores == sorted(scores, reverse=True)


def best(pairs: list[tuple[int, int, float]]) -> float:
    """Return the largest sum of a matching, by enumeration."""
    usable = [one for one in pairs if one[2] > 0.0]
    found = {frozenset(): 0.0}
    for i, j, score in usable:
        for used, total in list(found.items()):
            if ("i", i) not in used and ("j", j) not in used:
                key = used | {("i", i), ("j", j)}
                found[key] = max(found.get(key, 0.0), total + score)
    return max(found.values())


PAIRS = st.dictionaries(st.tuples(st.integers(0, 5), st.integers(0, 5)), st.integers(-4, 12), min_size=1, max_size=14)


@given(scores=PAIRS)
def test_matching_and_margins_are_those_of_enumeration(scores: dict[tuple[int, int], int]) -> None:
    """The sum is the largest one; margins and odds compare it with sums without a pair, and with and without a node."""
    pairs = [(i, j, float(score)) for (i, j), score in scores.items()]
    before, after, score = (np.array(column) for column in zip(*pairs, strict=True))
    chosen, margin, nodes, odds = matching(before, after, score)
    assert len(set(before[chosen].tolist())) == len(set(after[chosen].tolist())) == len(chosen)
    assert score[chosen].sum() == best(pairs)
    for k, loss in zip(chosen.tolist(), margin.tolist(), strict=True):
        assert loss == best(pairs) - best(pairs[:k] + pairs[k + 1 :])
    assert nodes.tolist() == sorted({j for _, j, s in pairs if s > 0.0})
    for node, difference in zip(nodes.tolist(), odds.tolist(), strict=True):
        usable = [one for one in pairs if one[2] > 0.0]
        others = [[one for one in usable if one[1] != node and one[0] != i] for i, j, _ in usable if j == node]
        scores = [s for _, j, s in usable if j == node]
        forced = max(s + best(rest) for s, rest in zip(scores, others, strict=True))
        assert difference == forced - best([one for one in usable if one[1] != node])


def test_the_matching_is_that_of_a_linear_program() -> None:
    """Of 40 ends and 50 beginnings the sum equals the optimum of an integer program."""
    rng = np.random.default_rng(2)
    before, after = (one.ravel() for one in np.meshgrid(np.arange(40), np.arange(50)))
    kept = rng.random(len(before)) < 0.2
    before, after = before[kept], after[kept]
    score = np.round(rng.normal(1.0, 3.0, len(before)) * 1024) / 1024
    rows = [before == one for one in range(40)] + [after == one for one in range(50)]
    program = milp(
        -score, constraints=LinearConstraint(np.array(rows, dtype=float), ub=1.0), integrality=1, bounds=Bounds(0, 1)
    )
    assert score[matching(before, after, score)[0]].sum() == pytest.approx(-program.fun)


@pytest.fixture(scope="module", params=["street", "square"])
def tracks(request: pytest.FixtureRequest) -> dict[int, Tracks]:
    return gaps.tracked(gaps.record(request.param, 7, 40.0).frames, GENERIC)


def rows_of(tracks: dict[int, Tracks], how: RejoinOptions) -> list[tuple[Tracks, Any, Any]]:
    objects = how.objects(tracks, GENERIC)
    found = []
    for one in tracks.values():
        columns = objects.columns(one.id, np.full(len(one.id), one.stamp_ns))
        found.append((one, columns["object"], columns["object_probability"]))
    return found


def test_an_object_is_one_track_in_a_frame(tracks: dict[int, Tracks]) -> None:
    """An object is a confirmed track of no higher id, once in a frame, and with a product of sure joins."""
    rows = rows_of(tracks, RejoinOptions(min_probability=0.6))
    confirmed = {int(n) for one in tracks.values() if one.confirmed is not None for n in one.id[one.confirmed > 0]}
    first = {int(n) for one, *_ in reversed(rows) for n in one.id}
    assert first
    joined, seen = 0, {}
    for one, number, probability in rows:
        shown = number >= 0
        assert len(np.unique(number[shown])) == shown.sum()
        assert (number <= one.id).all()
        assert set(number[shown].tolist()) <= confirmed
        assert set(one.id[shown].tolist()) <= confirmed
        assert np.isnan(probability[~shown]).all()
        assert (probability[shown & (number == one.id)] == 1.0).all()
        assert (probability[shown & (number != one.id)] < 1.0).all()
        joined += int((number != one.id)[shown].sum())
        for identity, value in zip(one.id.tolist(), number.tolist(), strict=True):
            before = seen.setdefault(identity, [])
            if not before or before[-1] != value:
                before.append(value)
    assert joined
    assert all(len(values) == 1 or (len(values) == 2 and values[1] == -1) for values in seen.values())


def pairs_of(tracks: dict[int, Tracks], parameters: Parameters = GENERIC) -> dict[tuple[int, int], float]:
    found = tracklets(tracks, parameters.labels)
    before, after, probability = joins(found, Kinds.of(parameters), 60.0)
    return dict(
        zip(zip(found.id[before].tolist(), found.id[after].tolist(), strict=True), probability.tolist(), strict=True)
    )


def test_joins_do_not_depend_on_axes_origin_and_names(tracks: dict[int, Tracks]) -> None:
    """In another world frame, at another time and with other names of classes the joins are the same."""
    angle = 2.0
    turn = np.array(((np.cos(angle), -np.sin(angle), 0.0), (np.sin(angle), np.cos(angle), 0.0), (0.0, 0.0, 1.0)))
    names = ("vehicle.car", "human.pedestrian.adult", "Cyclist")
    moved = {
        k: one.model_copy(
            update={
                "center": one.center @ turn.T + (300.0, -100.0, 5.0),
                "yaw": np.angle(np.exp(1j * (one.yaw + angle))),
                "stamp_ns": one.stamp_ns + 1_700_000_000 * 10**9,
            }
        )
        for k, one in tracks.items()
    }
    plain, other = pairs_of(tracks), pairs_of(moved, generic_parameters(names, 0.1))
    assert plain
    assert other.keys() == plain.keys()
    assert list(other.values()) == pytest.approx(list(plain.values()), abs=1e-4)


def test_a_car_behind_a_building_is_the_same_object() -> None:
    """A car that is hidden for four seconds and goes on as before is joined; its first id is the object."""
    rows = rows_of(gaps.tracked(gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0))), GENERIC), RejoinOptions())
    one, number, _ = rows[-1]
    assert one.id.tolist() == [2]
    assert number.tolist() == [1]


def test_of_two_equal_candidates_none_is_joined() -> None:
    """Of two cars that appear as mirror images ahead of where one was lost, neither is it."""
    frames = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 2.5), (8, 0)), (7, 10, (0, -2.5), (8, 0)))
    (probability,) = pairs_of(gaps.tracked(frames, GENERIC)).values()
    assert probability == pytest.approx(0.5, abs=0.01)


def test_a_gap_beyond_the_limit_is_not_joined() -> None:
    """A gap of four seconds is not joined where three are allowed."""
    tracks = gaps.tracked(gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0))), GENERIC)
    objects = RejoinOptions(gap_s=3.0).objects(tracks, GENERIC)
    assert (objects.object == objects.id).all()


def test_what_is_unknown_of_a_box_counts_nothing() -> None:
    """Points without size and heading are joined by their places."""
    frames = gaps.cars((0, 3, (0, 0), (8, 0)), (7, 10, (0, 0), (8, 0)))
    for one in frames:
        del one["size"], one["yaw"]
    found = gaps.tracked(frames, GENERIC)
    short = tracklets(found, GENERIC.labels)
    assert np.isnan(short.size[:, :2]).all()
    objects = RejoinOptions(min_probability=0.9).objects(found, GENERIC)
    assert len(set(objects.object.tolist())) < len(objects.id)


def test_sizes_count_from_the_first_known_one() -> None:
    """A track whose first boxes have no size has the size of the others, as while tracking."""
    frames = gaps.cars((0, 3, (0, 0), (8, 0)))
    for one in frames[:10]:
        del one["size"]
    short = tracklets(gaps.tracked(frames, GENERIC), GENERIC.labels)
    assert np.exp(short.size[0, :2]) == pytest.approx([4.5, 1.9], rel=0.1)


def test_sizes_of_an_object_agree() -> None:
    """Equal sizes are evidence in a class of many sizes, another size is evidence against, and bounds hold."""
    rng = np.random.default_rng(4)
    size = np.log(gaps.SIZES[0]) + 0.15 * rng.standard_normal((200, 3))
    count, mean, square = np.full(3, 200.0), size.mean(axis=0), 200.0 * size.var(axis=0)
    others = size[0] + 0.01, size[0] + 0.5, np.full(3, np.nan)
    same, other, unknown = (evidence.size_score(size[0], one, count, mean, square, 2) for one in others)
    assert 0.0 < same <= evidence.SIZE_BOUNDS[1]
    assert other == evidence.SIZE_BOUNDS[0]
    assert unknown == 0.0


def test_where_others_begin_a_join_needs_more() -> None:
    """The rate of new objects is higher around other beginnings, and lower where these were no new objects."""
    place = np.array(((0.0, 0.0), (1.0, 0.0), (50.0, 0.0)))
    found = Tracklets.of(np.zeros(3 * Tracklets.width))
    zero, found.begin[:] = np.zeros(3, np.int64), place
    found.first_ns[:] = np.array((0, 10, 20)) * 10**9
    found.last_ns[:] = found.first_ns + 10**9
    near, _, far = rejoining.rates(found, zero, np.full(3, 1e4), np.ones(3))
    assert near > 5.0 * far
    assert rejoining.rates(found, zero, np.full(3, 1e4), np.full(3, 0.1))[0] < 0.2 * near


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Return a table of detections of a car that is hidden for four seconds, with its truth."""
    lines = ["t,x,y,z,l,w,h,yaw,score,class,id"]
    for k in range(100):
        if not 30 <= k < 70:
            lines.append(f"{k / 10},{0.8 * k},0,0.8,4.4,1.85,1.55,0,0.9,car,1")
        lines.append(f"{k / 10},{40 + 0.01 * (k % 2)},20,0.8,4.4,1.85,1.55,0,0.9,car,2")
    path = tmp_path / "boxes.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_says_which_tracks_are_one_object(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`track --rejoin` adds two columns and changes no other byte; by object no identity switches."""
    for name, more in (("plain", ()), ("joined", ("--rejoin", "30", "--min-probability", "0.9"))):
        assert run_here(capsys, "track", table, *more, "--out", tmp_path / f"{name}.csv").returncode == 0
    plain, joined = (read_table(tmp_path / f"{name}.csv", {}) for name in ("plain", "joined"))
    assert list(joined) == [*plain, "object", "object_probability"]
    for name, column in plain.items():
        assert np.array_equal(column, joined[name], equal_nan=column.dtype.kind == "f")
    assert set(joined["id"].tolist()) - set(joined["object"].tolist())
    switches = []
    for by in ("id", "object"):
        words = ("evaluate", table, "--truth", table, "--tracks", tmp_path / "joined.csv", "--by", by, "--json")
        switches.append(result_of(run_here(capsys, *words))["classes"]["car"]["all"]["IDS"])
    assert switches == [1, 0]


def test_results_may_have_objects_as_ids(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With `--ids object` the car has one id in a table and in OpenLABEL, and the command says how many objects are."""
    words = ("track", table, "--rejoin", "30", "--min-probability", "0.9", "--ids", "object")
    done = run_here(capsys, *words, "--out", tmp_path / "tracks.csv")
    assert "3 confirmed tracks are 2 objects" in done.stdout + done.stderr
    columns = read_table(tmp_path / "tracks.csv", {})
    assert "object" not in columns
    for frame in np.unique(columns["frame"]).tolist():
        identity = columns["id"][columns["frame"] == frame]
        assert np.diff(identity).min(initial=1) > 0
    assert len(set(columns["id"][columns["confirmed"] > 0].tolist())) == 2
    assert run_here(capsys, *words, "--out", tmp_path / "t.openlabel.json").returncode == 0
    objects = json.loads((tmp_path / "t.openlabel.json").read_text())["openlabel"]["objects"]
    assert len(objects) == 2


def test_columns_of_a_table_are_attributes(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tracks have the text with most evidence of each named column, also where their detection has none."""
    head, *lines = table.read_text().splitlines()
    known = ["8B 1,07" if k == 0 else "" if k % 3 == 0 else "AB 1,07" for k in range(len(lines))]
    rows = [f"{line},{text or ','}" for line, text in zip(lines, known, strict=True)]
    table.write_text("\n".join([f"{head},attributes.plate,number", *rows]))
    words = ("track", table, "--out", tmp_path / "tracks.csv")
    assert run_here(capsys, *words, "--option", "attributes=attributes.plate, number").returncode == 0
    columns = read_table(tmp_path / "tracks.csv", {"attributes": "attributes.number"})
    assert set(columns["attributes.plate"][columns["age"] > 1.0].tolist()) == {"AB 1"}
    assert set(columns["attributes.number"][columns["age"] > 1.0].tolist()) == {"07"}
    done = run_here(capsys, *words, "--option", "attributes=colour")
    assert done.returncode == 2
    assert "a column colour (--option attributes)" in done.stderr


EXIT = '[rejoin."*"]\nexits = [[[20, -2], [30, -2], [30, 2], [20, 2]]]\n'
WAY = """
[[rejoin."*".passages]]
from = [[20, -2], [30, -2], [30, 2], [20, 2]]
to = [[15, 34], [25, 34], [25, 46], [15, 46]]
s = [2, 8]
"""


@pytest.mark.parametrize(("text", "path", "expected"), [
    (EXIT, (0, 0, 8, 0), [1, 2]),
    (EXIT.replace("20,", "90,").replace("30,", "99,"), (0, 0, 8, 0), [1, 1]),
    (WAY, (20, 104, 0, -8), [1, 1]),
    (WAY.replace("[2, 8]", "[6, 8]"), (20, 104, 0, -8), [1, 2]),
])  # fmt: skip
def test_places_hold_for_recordings(text: str, path: Any, expected: list[int], tmp_path: Path) -> None:
    """Objects lost in an exit of the file are not joined; a passage joins its ends within its time."""
    (tmp_path / "settings.toml").write_text(text)
    frames = gaps.cars((0, 3, (0, 0), (8, 0)), (8, 10, path[:2], path[2:]))
    how = RejoinOptions(60.0, 0.9, *rejoining.places_in(tmp_path / "settings.toml"))
    assert how.objects(gaps.tracked(frames, GENERIC), GENERIC).object.tolist() == expected


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("track", "{table}", "--places", "{table}", "--out", "{out}.csv"), "expected --rejoin"),
        (("track", "{table}", "--rejoin", "--places", "{table}", "--out", "{out}.csv"), "one table [rejoin.PATTERN]"),
        (("track", "{table}", "--rejoin", "--out", "{out}"), "--rejoin: expected --ids object or a table as --out"),
        (("track", "{table}", "--ids", "object", "--out", "{out}.csv"), "expected track, or object with --rejoin"),
        (("track", "{table}", "--rejoin", "0", "--out", "{out}.csv"), "expected a time in (0, 600] s, received 0"),
        (("track", "{table}", "--rejoin", "601", "--out", "{out}.csv"), "received 601"),
        (
            ("track", "{table}", "--min-probability", "0.9", "--out", "{out}.csv"),
            "--min-probability 0.9: expected --rejoin",
        ),
        (
            ("track", "{table}", "--rejoin", "--min-probability", "1", "--out", "{out}.csv"),
            "expected a number in [0.5, 1), received 1",
        ),
        (("evaluate", "{table}", "--truth", "{table}", "--tracks", "{table}", "--by", "object"), "the column object"),
        (("evaluate", "{table}", "--truth", "{table}", "--tracks", "{table}", "--by", "x"), "expected id or object"),
    ],
)
def test_wrong_options_are_named(
    words: tuple[str, ...], text: str, table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A value out of its bounds, or an option that could do nothing, ends the command with status 2 and a line."""
    done = run_here(capsys, *(word.format(table=table, out=tmp_path / "out") for word in words))
    assert done.returncode == 2
    assert text in done.stderr


def test_tracks_in_axes_that_move_are_not_joined(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Boxes without poses, whose sensor is found to move, are refused, and the line says that poses are needed."""
    (scene,) = open_dataset("scene", frames=100, vehicles=40, clouds=False, seed=3).sequences(["0000"])
    lines = ["t,x,y,z,l,w,h,yaw,score,class"]
    for one in scene.frames():
        values = np.column_stack((one.center, one.size, one.yaw, one.score)).tolist()
        names = [one.labels[k] for k in one.label.tolist()]
        lines += [",".join(map(str, (one.index / 10, *row, name))) for row, name in zip(values, names, strict=True)]
    table = tmp_path / "boxes.csv"
    table.write_text("\n".join(lines) + "\n")
    done = run_here(capsys, "track", table, "--rejoin", "--out", tmp_path / "tracks.csv")
    assert done.returncode == 2
    assert "--rejoin: sequence boxes: expected boxes in a world frame, or poses of the sensor" in done.stderr


def test_objects_of_a_scene_last() -> None:
    """With `lasting` an object of a generated scene has one id, also where it was hidden for long."""
    plain, lasting = (
        open_dataset("scene", frames=300, clouds=False, seed=3, lasting=one).sequences(["0000"])[0].truth()
        for one in (0, 1)
    )
    assert plain is not None
    assert lasting is not None
    assert len(np.unique(lasting.id)) < len(np.unique(plain.id))
    for truth, longest in ((plain, 21), (lasting, 300)):
        seen = [np.sort(truth.frame[(truth.id == one) & (truth.points > 0)]) for one in np.unique(truth.id)]
        assert 10 < max(np.diff(frames).max(initial=0) for frames in seen) <= longest
    seen = [np.sort(lasting.frame[(lasting.id == one) & (lasting.points > 0)]) for one in np.unique(lasting.id)]
    assert sum((np.diff(frames) > 21).any() for frames in seen) >= 5
