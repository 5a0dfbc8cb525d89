"""Smoothing: the textbook's smoother, errors that shrink, one sign per track, and nothing else changed."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import oracle_formulas as plain
import pytest
from commands import run_here
from numpy.typing import NDArray
from optipmb_schemas import Tracks
from optipmb_tools.datasets import DataSequence, Preloaded, open_dataset
from optipmb_tools.geometry import wrap_angle
from optipmb_tools.run.profiles import read_profile
from optipmb_tools.run.smoothing import smooth
from optipmb_tools.run.tracking import Tracking, track_whole

from optipmb import load_profile, parse_parameters
from optipmb.filter.lightweight import turn_around
from optipmb.model.table import ClassTable

Array = NDArray[np.float64]
FRAMES = 60
LEVEL = {
    "memory": 0.5, "missed": 2.0, "evidence": [0.0], "existence": [0.5], "along": [0.2], "across": [0.1],
}  # fmt: skip
"""Calibration that is the same for all tracks."""


@pytest.fixture(scope="module")
def sequence() -> DataSequence:
    (one,) = open_dataset("scene", frames=FRAMES, vehicles=10, clouds=False, seed=4).sequences(["0000"])
    return one


@pytest.mark.parametrize("turned", [False, True])
def test_states_are_smoothed_as_the_article_has_it(*, turned: bool) -> None:
    """Interleaved tracks, also with a state turned by pi on the way, equal the textbook smoother."""
    rng, table = np.random.default_rng(3), ClassTable.of(load_profile("kitti"))
    times = np.cumsum(rng.uniform(0.05, 0.3, 8) * 1e9).astype(np.int64)
    starts = rng.normal((50.0, -20.0, 6.0, 2.0, 0.1, 0.3), 1.0, (3, 6))
    root = rng.normal(0.0, 0.2, (8, 3, 6, 6)) + 0.3 * np.eye(6)
    covariance = root @ root.transpose(0, 1, 3, 2)
    mean = starts + rng.normal(0.0, 0.1, (8, 3, 6)) + 0.6 * np.arange(8)[:, None, None] * [-1.0, 2.0, 0, 0, 0, 0]
    noise, tau = np.diag(table["process_noise"][0] ** 2), float(table["acceleration_time"][0])
    expected = [plain.smooth(mean[:, k], covariance[:, k], times * 1e-9, noise, tau) for k in range(3)]
    states, spreads = mean.reshape(-1, 6).copy(), covariance.reshape(-1, 6, 6).copy()
    odds = np.ones(24)
    if turned:  # the second track from its fifth state on, more sure of that than before
        for row in range(3 * 4 + 1, 24, 3):
            turn_around(states[row], spreads[row])
            odds[row] = 1.5
    told = smooth(np.tile([7, 2, 9], 8), np.repeat(times, 3), np.zeros(24, np.int64), odds, states, spreads, table)
    for k, (means, spread) in enumerate(expected):
        if turned and k == 1:
            for one, its in zip(means, spread, strict=True):
                turn_around(one, its)
        means[:, 3] = wrap_angle(means[:, 3])
        assert states[k::3] == pytest.approx(means, abs=1e-9)
        assert spreads[k::3] == pytest.approx(spread, abs=1e-9)
    assert told[1::3] == pytest.approx((1.5 * 4 - 4) / 8 if turned else 1.0)


def tracked(sequence: DataSequence, *, smooth: bool) -> dict[int, Tracks]:
    return track_whole(Tracking(read_profile("kitti"), smooth=smooth), sequence).tracks


def errors(sequence: DataSequence, tracks: dict[int, Tracks]) -> Iterator[tuple[float, float]]:
    """Give the distance from the nearest true object, m, and the error of the heading, rad, for boxes of objects."""
    truth = sequence.truth()
    assert truth is not None
    for index, one in tracks.items():
        rows = np.flatnonzero(truth.frame == index)
        for center, yaw in zip(one.center, one.yaw, strict=True):
            away = np.linalg.norm(truth.center[rows, :2] - center[:2], axis=1)
            if len(rows) and away.min() < 1.0:
                yield away.min(), abs(float(wrap_angle(yaw - truth.yaw[rows[away.argmin()]])))


def test_boxes_come_nearer_to_the_truth(sequence: DataSequence) -> None:
    """Mean square errors of positions and headings shrink by a tenth at least; ids, sizes and existence stay."""
    plain_tracks, smoothed = tracked(sequence, smooth=False), tracked(sequence, smooth=True)
    assert list(plain_tracks) == list(smoothed) == list(range(FRAMES))
    for one, other in zip(plain_tracks.values(), smoothed.values(), strict=True):
        for name in ("id", "label", "size", "score", "existence", "age", "detection"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        assert np.array_equal(one.center[:, 2], other.center[:, 2])
        assert (np.linalg.eigvalsh(other.covariance) > 0.0).all()
    before, after = (np.mean(np.square(list(errors(sequence, one))), axis=0) for one in (plain_tracks, smoothed))
    assert (after < 0.9 * before).all()


def test_a_track_keeps_one_sign(sequence: DataSequence) -> None:
    """Boxes backward in the first frames make tracks turn by pi later; smoothed, no track does, and fewer face back."""
    loaded: Any = Preloaded(sequence)
    loaded._frames = [replace(f, yaw=wrap_angle(f.yaw + np.pi)) if f.index < 4 else f for f in loaded._frames]
    turns, backward = [], []
    for smoothed in (False, True):
        tracks = tracked(loaded, smooth=smoothed)
        latest: dict[int, float] = {}
        turns.append(0)
        for one in tracks.values():
            for identity, yaw in zip(one.id.tolist(), one.yaw.tolist(), strict=True):
                turns[-1] += abs(float(wrap_angle(yaw - latest.get(identity, yaw)))) > 0.5 * np.pi
                latest[identity] = yaw
        backward.append(sum(heading > 0.5 * np.pi for _, heading in errors(loaded, tracks)))
    assert turns[0] > 0 == turns[1]
    assert backward[1] < 0.5 * backward[0]


def test_the_factors_of_a_calibration_hold_for_smoothed_states(sequence: DataSequence) -> None:
    """They scale the published deviations of speeds and turn rates, and change nothing that is smoothed."""
    factors = np.array([1.0, 1.0, 2.0, 1.0, 3.0, 1.0])
    found = []
    for speed, turn_rate in ((1.0, 1.0), (2.0, 3.0)):
        document = read_profile("kitti").model_dump()
        for own in document["classes"].values():
            own["calibration"] = (own["calibration"] or LEVEL) | {"speed": speed, "turn_rate": turn_rate}
        found.append(track_whole(Tracking(parse_parameters(document), smooth=True), sequence).tracks)
    for one, scaled in zip(*(tracks.values() for tracks in found), strict=True):
        np.testing.assert_allclose(scaled.covariance, one.covariance * np.outer(factors, factors), rtol=1e-6, atol=1e-9)
        for name in ("center", "yaw", "velocity"):
            np.testing.assert_allclose(getattr(scaled, name), getattr(one, name), rtol=1e-9)


def test_a_sequence_without_frames_has_no_tracks(sequence: DataSequence) -> None:
    """Nothing is smoothed where nothing was tracked, and frames without objects stay empty."""
    loaded: Any = Preloaded(sequence)
    none = np.zeros(0, dtype=np.int64)
    loaded._frames = [
        replace(f, label=none, center=f.center[:0], size=f.size[:0], yaw=f.yaw[:0], score=f.score[:0])
        for f in loaded._frames[:2]
    ]
    assert [len(one.id) for one in tracked(loaded, smooth=True).values()] == [0, 0]
    loaded._frames = []
    assert tracked(loaded, smooth=True) == {}


def test_every_kind_of_file_is_smoothed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A result file and a table hold the same smoothed boxes as two runs give, and others than without --smooth."""
    scene = ("track", "--dataset", "scene", "--option", "frames=20", "--option", "clouds=0")
    files = []
    for out, more in (("a", ["--smooth"]), ("b", ["--smooth"]), ("c", []), ("d.csv", ["--smooth"]), ("e.csv", [])):
        done = run_here(capsys, *scene, "--out", tmp_path / out, *more)
        assert done.returncode == 0, done.stderr
        files.append((tmp_path / out if out.endswith(".csv") else tmp_path / out / "0000.txt").read_bytes())
    folder, again, plain_folder, table, plain_table = files
    assert folder == again != plain_folder
    assert table != plain_table
    assert [len(one.splitlines()) for one in (folder, plain_folder, table, plain_table)] == [
        len(folder.splitlines()) + header for header in (0, 0, 1, 1)
    ]
