"""Tracking in process: repeatable files, classes, profiles, and refused input."""

import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from optipmb_client.errors import UsageError
from optipmb_schemas import PATHS
from optipmb_tools.datasets import Dataset, Preloaded, open_dataset, selected_frames
from optipmb_tools.evaluation.tracks import read_tracks
from optipmb_tools.results.output import Results, track_columns
from optipmb_tools.run import tracking
from optipmb_tools.run.profiles import read_profile
from optipmb_tools.run.tracking import Tracking, decided, track, track_whole
from optipmb_tools.spool import BLOCK, SpooledTracks
from optipmb_tools.table_files import Columns, joined, write_table

from optipmb.learning.hindsight import with_hindsight


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return open_dataset("scene", frames=20, vehicles=6, pedestrians=3, cyclists=2)


@pytest.mark.parametrize("smooth", [False, True])
def test_predicted_paths_are_written_with_all_columns(dataset: Dataset, tmp_path: Path, *, smooth: bool) -> None:
    """With horizons in the profile the file of all columns has a path for each row; the result file is as without."""
    sequences, parameters = dataset.sequences(["0000"]), read_profile("kitti")
    asking = parameters.model_copy(update={"horizons": (0.1, 2.0)})
    (plain,) = track(dataset, sequences, tmp_path / "a", Tracking(parameters, full=True, smooth=smooth))
    (found,) = track(dataset, sequences, tmp_path / "b", Tracking(asking, full=True, smooth=smooth))
    assert plain.file.read_bytes() == found.file.read_bytes()
    without, columns = (np.load(one.file.with_suffix(".npz")) for one in (plain, found))
    assert set(columns) - set(without) == set(PATHS)
    assert columns["horizons"].tolist() == [0.1, 2.0]
    assert columns["path_covariance"].shape == (len(columns["id"]), 2, 2, 2)
    ahead = columns["center"][:, :2] + 0.1 * columns["velocity"]
    np.testing.assert_allclose(columns["path_position"][:, 0], ahead, atol=0.2)
    assert (np.trace(columns["path_covariance"][:, 1], axis1=1, axis2=2)
            > np.trace(columns["path_covariance"][:, 0], axis1=1, axis2=2)).all()  # fmt: skip


@pytest.mark.parametrize("how", [{"hindsight_s": 0.5}, {"show": 0.3}, {"hindsight_s": 0.5, "show": 0.9}], ids=str)
@pytest.mark.parametrize("together", [tracking.ROWS, 40])
def test_tracks_are_confirmed_as_asked(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch, how: dict[str, float], together: int
) -> None:
    """Existence, `confirmed` and velocity are in hindsight, where there is one, by any number of rows."""
    monkeypatch.setattr(tracking, "ROWS", together)
    (sequence,), parameters = dataset.sequences(["0000"]), read_profile("scene")
    plain = track_whole(Tracking(parameters), sequence)
    found, shown = decided(plain, Tracking(parameters, **how)), how.get("show")
    columns = with_hindsight(list(plain.tracks.values()), parameters, velocity_s=0.5, show=shown)
    for (index, one), changed in zip(found.items(), columns, strict=True):
        own = plain.tracks[index]
        update = changed if "hindsight_s" in how else {"confirmed": own.existence >= 0.3}
        assert one == own.model_copy(update=update | {"confirmed": update["confirmed"].astype(np.int64)})
    assert any(one != plain.tracks[index] for index, one in found.items())


def test_result_files_come_with_those_of_the_tracks_that_are_shown(dataset: Dataset, tmp_path: Path) -> None:
    """The same file in a folder beside it has the confirmed rows, by which an evaluation tells them."""
    (sequence,), how = dataset.sequences(["0000"]), Tracking(read_profile("scene"), hindsight_s=1.0)
    (result,) = track(dataset, [sequence], tmp_path, how)
    found = decided(track_whole(how, sequence), how)
    wanted = [(k, i) for k, one in found.items() for i in one.id[one.confirmed > 0].tolist()]
    every, shown = (
        [tuple(map(int, line.split()[:2])) for line in path.read_text().splitlines()]
        for path in (result.file, tmp_path / "shown" / "0000.txt")
    )
    assert shown == wanted
    assert 0 < len(shown) < len(every)
    table = read_tracks(tmp_path, sequence)
    assert table.confirmed is not None
    rows = zip(table.frame.tolist(), table.id.tolist(), table.confirmed.tolist(), strict=True)
    assert {(k, i) for k, i, told in rows if told} == set(wanted)


def test_what_is_reported_is_what_was_written(dataset: Dataset, tmp_path: Path) -> None:
    """Frames, clouds, track identities and durations of the report agree with the file and the sequence."""
    seen: list[int] = []
    (result,) = track(
        dataset,
        dataset.sequences(["0000"]),
        tmp_path,
        Tracking(read_profile("kitti")),
        on_frame=lambda: seen.append(1),
    )
    rows = [line.split() for line in result.file.read_text().splitlines()]
    assert (result.name, result.frames, result.clouds, len(seen)) == ("0000", 20, 20, 20)
    assert 0 < result.tracks <= len({row[1] for row in rows})
    assert 0 <= result.unconfirmed_rows < len(rows)
    assert result.step is not None
    assert 0.0 < result.step.p50_ms <= result.step.p99_ms <= result.step.max_ms
    assert result.seconds > 0.0


def test_chosen_classes_are_the_only_ones() -> None:
    """With classes given, frames keep their number and lose the other objects, in all columns alike."""
    (sequence,) = open_dataset("scene", frames=20, vehicles=6, pedestrians=3, velocity=True).sequences(["0000"])
    everything = list(sequence.frames())
    chosen = list(selected_frames(sequence, ["Car", "Cyclist"]))
    assert len(chosen) == len(everything)
    for part, whole in zip(chosen, everything, strict=True):
        rows = [row for row, label in enumerate(whole.label) if whole.labels[label] in {"Car", "Cyclist"}]
        for column in ("label", "center", "size", "yaw", "score", "velocity"):
            assert np.array_equal(getattr(part, column), getattr(whole, column)[rows])
        assert (part.stamp_ns, part.cloud is None) == (whole.stamp_ns, whole.cloud is None)
    assert sum(len(frame.label) for frame in chosen) < sum(len(frame.label) for frame in everything)


def test_a_class_that_the_data_lack_is_refused(dataset: Dataset) -> None:
    """The error names the class and the known ones."""
    (sequence,) = dataset.sequences(["0000"])
    with pytest.raises(UsageError, match=r"'Tram'.*Car"):
        next(selected_frames(sequence, ["Tram"]))


def test_a_profile_may_be_a_file(tmp_path: Path) -> None:
    """A name, or the path of a TOML file; anything else is one clear line that names the option."""
    assert "Car" in read_profile("kitti").classes
    path = tmp_path / "own.toml"
    path.write_text("not = [toml")
    for wrong in ("nonsense", str(path), str(tmp_path)):
        with pytest.raises(UsageError, match=r"^--profile ") as caught:
            read_profile(wrong)
        assert "\n" not in str(caught.value)


def test_values_that_the_tracker_refuses_are_placed(dataset: Dataset) -> None:
    """A score of 2 is refused with the sequence, the frame and the element."""
    (sequence,) = dataset.sequences(["0000"])
    loaded = Preloaded(sequence)
    loaded._frames[3] = replace(loaded._frames[3], score=loaded._frames[3].score + 1.0)
    with pytest.raises(UsageError, match=r"sequence 0000, frame 3: score"):
        track_whole(Tracking(read_profile("kitti")), loaded)


def test_spooled_tracks_are_those_that_were_added(dataset: Dataset) -> None:
    """In a file and in memory, in any order, with other values of a column, and as a table."""
    (sequence,), parameters = dataset.sequences(["0000"]), read_profile("scene")
    frames = list(track_whole(Tracking(parameters), sequence).tracks.values())
    spooled, count = SpooledTracks(), 2 * BLOCK + 90
    for index in reversed(range(count)):
        spooled.add(index, frames[index % len(frames)])
    assert list(spooled) == list(range(count))
    for index in (0, BLOCK, count - 1, 5, BLOCK - 1):
        assert spooled[index] == frames[index % len(frames)]
    score = spooled.columns({"score": lambda one: 0.5 * one.score})["score"]
    changed = spooled.with_columns({"score": score})
    for index in (count - 1, BLOCK, 3):
        assert changed[index].score.tolist() == (0.5 * spooled[index].score).tolist()
    table = joined(track_columns("a", changed))
    assert table["id"].tolist() == [number for one in spooled.values() for number in one.id.tolist()]
    assert table["frame"].tolist() == [k for k, one in spooled.items() for _ in one.id]


def test_rows_of_a_table_are_in_memory_block_by_block(dataset: Dataset, tmp_path: Path) -> None:
    """Texts that need quotes, and other types in a later recording, give the table of all rows at once."""
    loaded = Preloaded(dataset.sequences(["0000"])[0])
    blocks = [
        {"sequence": np.array(["b"]), "id": np.array([3.5])},
        {"sequence": np.array(["a"]), "id": np.array([1])},
        {"sequence": np.array(["a, the end"]), "id": np.array([2])},
    ]
    results = Results(dataset, tmp_path / "t.csv")
    alive: list[weakref.ref[NDArray[Any]]] = []

    def given(*numbers: int) -> Iterator[Columns]:
        for number in numbers:
            assert sum(one() is not None for one in alive) <= 1
            values = blocks[number]["id"].copy()
            alive.append(weakref.ref(values))
            yield blocks[number] | {"id": values}
            del values

    for name, numbers in (("b", (0,)), ("a", (1, 2))):
        loaded.name = name
        assert results.take(loaded, given(*numbers))
    assert not any(one() is not None for one in alive)
    results.close([loaded])
    text = (tmp_path / "t.csv").read_text()
    assert text == '"sequence","id"\n"a",1\n"a, the end",2\n"b",3.5\n'
    write_table(tmp_path / "whole.csv", joined([blocks[1], blocks[2], blocks[0]]))
    assert (tmp_path / "whole.csv").read_text() == text
