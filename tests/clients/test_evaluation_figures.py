"""All figures together: from files, by the command, and of the real truth."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import result_of, run_here
from evaluation_cases import write_kitti
from optipmb_tools.cli import run
from optipmb_tools.datasets import DatasetError, open_dataset
from optipmb_tools.datasets.kitti import KittiSequence
from optipmb_tools.evaluation import default_rules, evaluate_files
from optipmb_tools.evaluation.evaluate import FigureOptions, evaluate_figures, load_recordings
from optipmb_tools.results.kitti import LEAST_SHOWN, read_kitti_results
from optipmb_tools.table_files import write_table
from real_data import kitti_root, nuscenes_root

CLASSES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("kitti")
    return write_kitti(root, root / "results", 1), root / "results"


def test_the_real_truth_scores_a_hundred(tmp_path: Path) -> None:
    """The truth of real sequences, as result files, is perfect by every measure; with other ids, its sets still are."""
    lines = {}
    sequences = open_dataset("kitti", kitti_root()).sequences(["0000", "0011"])
    for sequence in sequences:
        text = (kitti_root() / "training" / "label_02" / f"{sequence.name}.txt").read_text()
        lines[sequence.name] = [
            line.split() for line in text.splitlines() if "DontCare" not in line and " Van " not in line
        ]
        (tmp_path / f"{sequence.name}.txt").write_text(
            "".join(" ".join([*line, "0.9\n"]) for line in lines[sequence.name])
        )
    for one in evaluate_figures("kitti", load_recordings("kitti", sequences, tmp_path), ("Car", "Pedestrian")):
        for result in one.ab3dmot:
            figures = result.summary()
            assert [figures[name] for name in ("sAMOTA", "AMOTA", "MOTA")] == pytest.approx([1.0] * 3)
            assert [figures[name] for name in ("FP", "FN", "IDS")] == [0, 0, 0]
        assert one.everything.hota.hota == pytest.approx(1.0)
        if one.everything.hota_2d is not None:
            assert one.everything.hota_2d.hota == pytest.approx(1.0)
        assert one.everything.gospa.gospa == pytest.approx(0.0, abs=1e-6)
    for result in evaluate_files(sequences, tmp_path, ("Car", "Pedestrian", "Tram"), default_rules("kitti")):
        assert result.name != "Tram", "it occurs nowhere"
        assert (result.total.mota, result.sweep.results[result.sweep.best].mota) == (1.0, 1.0)
        assert set(result.sequences) == {"0000", "0011"}
    for sequence in sequences:
        fresh = [
            " ".join([line[0], str(number), *line[2:], "0.9\n"]) for number, line in enumerate(lines[sequence.name])
        ]
        (tmp_path / f"{sequence.name}.txt").write_text("".join(fresh))
    for one in evaluate_figures("kitti", load_recordings("kitti", sequences, tmp_path), ("Car", "Pedestrian")):
        assert one.ab3dmot[0].best.switches > 0.5 * one.ab3dmot[0].best.truth
        assert one.everything.hota.deta == pytest.approx(1.0)
        assert one.everything.hota.assa < 0.05
        assert one.everything.gospa.gospa == pytest.approx(0.0, abs=1e-6)


def test_neither_figures_nor_pictures_need_detections(
    kitti: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a root without any, `evaluate` gives the figures of all classes of the benchmark, and `plot` its picture."""
    data = ("--dataset", "kitti", "--root", str(kitti[0]), "--tracks", str(kitti[1]))
    assert run(["evaluate", *data, "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["classes"]) == set(CLASSES)
    assert run(["plot", *data, "--sequences", "0000", "--out", str(tmp_path / "0000.png")]) == 0
    assert (tmp_path / "0000.png").read_bytes().startswith(b"\x89PNG")
    assert run(["track", *data[:4], "--out", str(tmp_path)]) == 2
    assert "the name of a detector, or just one in detections/, received none" in capsys.readouterr().err


def test_empty_results_score_zero(kitti: tuple[Path, Path], tmp_path: Path) -> None:
    """Result files without a line give zeros, or nothing where a figure is not defined, and no error."""
    sequences = open_dataset("kitti", kitti[0]).sequences(["all"])
    for sequence in sequences:
        (tmp_path / f"{sequence.name}.txt").write_text("")
    for one in evaluate_figures("kitti", load_recordings("kitti", sequences, tmp_path), CLASSES):
        assert {(result.samota, result.amota, result.best.mota) for result in one.ab3dmot} == {(0.0, 0.0, 0.0)}
        assert one.everything.hota.hota == 0.0
        assert one.everything.gospa.false == 0.0 < one.everything.gospa.missed
        assert one.best is None


def test_the_best_threshold_serves_all_figures(kitti: tuple[Path, Path]) -> None:
    """Without the tracks below the best threshold fewer are false; another threshold may be given."""
    recordings = load_recordings("kitti", open_dataset("kitti", kitti[0]).sequences(["all"]), kitti[1])
    (cars,) = evaluate_figures("kitti", recordings, ("Car",))
    assert cars.best is not None
    assert cars.best.threshold == cars.ab3dmot[0].threshold
    assert cars.best.gospa.false < cars.everything.gospa.false
    (given,) = evaluate_figures("kitti", recordings, ("Car",), FigureOptions(limits=(0.5,)), {"Car": 2.0})
    assert [result.limit for result in given.ab3dmot] == [0.5]
    assert given.best is not None
    assert given.best.hota.hota == 0.0


def test_the_command_shows_and_prints_the_figures_of_kitti(
    kitti: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """Tables name every class and every limit; JSON holds what the API gives, and no NaN."""
    given = ("evaluate", "--dataset", "kitti", "--root", str(kitti[0]), "--tracks", str(kitti[1]), "--class", *CLASSES)
    assert run([*given]) == 0
    shown = capsys.readouterr().out
    for text in ("sAMOTA", "AMOTP", "centre HOTA", "GOSPA", "0.25", "0.7", *CLASSES):
        assert text in shown
    assert run([*given, "--json"]) == 0
    classes = json.loads(capsys.readouterr().out, parse_constant=lambda text: pytest.fail(f"{text} in JSON"))["classes"]
    recordings = load_recordings("kitti", open_dataset("kitti", kitti[0]).sequences(["all"]), kitti[1])
    for one in evaluate_figures("kitti", recordings, CLASSES):
        assert classes[one.name]["ab3dmot"]["0.25"] == one.ab3dmot[0].summary()
        assert classes[one.name]["hota_centre"]["all"] == one.everything.hota.summary()
        assert classes[one.name]["calibration"] is None
    assert run([*given, "--iou", "0.4", "--cutoff", "1", "--json"]) == 0
    chosen = json.loads(capsys.readouterr().out)["classes"]["Car"]
    assert list(chosen["ab3dmot"]) == ["0.4"]
    assert chosen["gospa"]["all"]["OSPA"] < 1.0


def rewritten(kitti: tuple[Path, Path], folder: Path, change: Callable[[list[str]], list[str]]) -> Path:
    folder.mkdir()
    for path in kitti[1].glob("*.txt"):
        lines = [" ".join(change(line.split())) for line in path.read_text().splitlines()]
        (folder / path.name).write_text("\n".join(lines))
    return folder


def figures_of(kitti: tuple[Path, Path], results: Path, capsys: pytest.CaptureFixture[str]) -> tuple[Any, str]:
    asked = ("evaluate", "--dataset", "kitti", "--root", kitti[0], "--tracks", results, "--class", *CLASSES, "--json")
    done = run_here(capsys, *asked)
    classes = result_of(done)["classes"]
    for one in classes.values():
        one["best"].pop("score")
        for result in one["ab3dmot"].values():
            result.pop("score")
    return classes, done.stderr


def test_results_without_image_boxes_are_projected(
    kitti: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With -1 or 0 in place of all image boxes, figures use projected boxes, and a line says so."""
    shown = tmp_path / "shown"
    shown.mkdir()
    for one in open_dataset("kitti", kitti[0]).sequences(["all"]):
        assert isinstance(one, KittiSequence)
        lines = (kitti[1] / f"{one.name}.txt").read_text().splitlines()
        lines.sort(key=lambda line: int(line.split()[0]))
        boxes = read_kitti_results(kitti[1] / f"{one.name}.txt")
        image, _ = one.camera.boxes(boxes.center, boxes.size, boxes.yaw, least_shown=LEAST_SHOWN)
        parts = [(line.split(), box.tolist()) for line, box in zip(lines, image, strict=True)]
        text = "\n".join(" ".join([*line[:6], *(f"{pixel:.6f}" for pixel in box), *line[10:]]) for line, box in parts)
        (shown / f"{one.name}.txt").write_text(text)
    expected, said = figures_of(kitti, shown, capsys)
    assert said == ""
    assert expected["Car"]["ab3dmot"]["0.25"]["FP"] > 0
    for text in ("-1", "0", "table"):
        bare = rewritten(kitti, tmp_path / text, lambda line, text=text: [*line[:6], *[text] * 4, *line[10:]])  # type: ignore[misc]  # its default
        if text == "table":
            bare = as_table(kitti, tmp_path / "tracks.parquet")
        found, said = figures_of(kitti, bare, capsys)
        assert "boxes without an image box: their 3D boxes are projected into the image" in said
        for name in CLASSES:
            for limit, result in expected[name]["ab3dmot"].items():
                assert found[name]["ab3dmot"][limit] == pytest.approx(result)
            assert found[name]["hota_2d"]["all"] == pytest.approx(expected[name]["hota_2d"]["all"], abs=1e-4)


def as_table(kitti: tuple[Path, Path], path: Path) -> Path:
    parts: list[dict[str, Any]] = []
    for one in open_dataset("kitti", kitti[0]).sequences(["all"]):
        boxes = read_kitti_results(kitti[1] / f"{one.name}.txt").to_world(one.poses)
        names = np.array(boxes.labels)[boxes.label]
        columns = {"sequence": np.full(len(names), one.name), "id": boxes.id, "class": names, "score": boxes.score}
        columns |= {"stamp_ns": boxes.frame * 100_000_000, "yaw": boxes.yaw}
        columns |= dict(zip("xyz", boxes.center.T, strict=True)) | dict(zip("lwh", boxes.size.T, strict=True))
        parts.append(columns)
    write_table(path, {name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    return path


def test_classes_of_kitti_are_matched_without_case(
    kitti: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Results of `car` and `bicycle` have the figures of `Car` and `Cyclist`; vans stay vans."""
    names = {"Car": "car", "Cyclist": "bicycle", "Pedestrian": "PEDESTRIAN"}
    other = rewritten(kitti, tmp_path / "other", lambda line: [*line[:2], names.get(line[2], line[2]), *line[3:]])
    found, said = figures_of(kitti, other, capsys)
    assert found == figures_of(kitti, kitti[1], capsys)[0]
    assert "car as Car" in said
    vans = rewritten(kitti, tmp_path / "vans", lambda line: [*line[:2], "Van", *line[3:]])
    assert figures_of(kitti, vans, capsys)[0]["Car"]["all"]["TP"] == 0


def test_a_shift_of_all_scores_changes_no_figure_of_kitti(
    kitti: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No track is deleted at its own threshold: 1e-6 more for every score changes the thresholds alone.

    Tracks of one score and of several lengths have means that differ in the last place unless they are rounded.
    """

    def figures(shift: float) -> Any:
        def change(line: list[str]) -> list[str]:
            return [*line[:-1], f"{0.1 + 0.1 * (int(line[1]) % 7) + shift:.6f}"]

        return figures_of(kitti, rewritten(kitti, tmp_path / f"{shift}", change), capsys)[0]

    assert figures(0.0) == figures(1e-6) == figures(2e-6)


def test_a_track_at_its_own_threshold_is_kept(kitti: tuple[Path, Path], tmp_path: Path) -> None:
    """A threshold of more decimals than means are rounded to keeps the tracks that have it as their mean."""
    score = 0.1234567890123456
    even = rewritten(kitti, tmp_path / "even", lambda line: [*line[:-1], str(score)])
    recordings = load_recordings("kitti", open_dataset("kitti", kitti[0]).sequences(["all"]), even)
    (cars,) = evaluate_figures("kitti", recordings, ("Car",), thresholds={"Car": score})
    assert cars.best is not None
    assert cars.best.hota.summary() == cars.everything.hota.summary()


def test_the_command_tests_the_calibration_of_full_tracks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of tracks that were written with --full the NEES and the reliability are shown."""
    data = ("--dataset", "scene", "--option", "frames=30", "--option", "clouds=0")
    assert run(["track", *data, "--out", str(tmp_path), "--full", "--json"]) == 0
    assert run(["evaluate", *data, "--tracks", str(tmp_path)]) == 0
    assert "NEES" in capsys.readouterr().out
    assert run(["evaluate", *data, "--tracks", str(tmp_path), "--json"]) == 0
    car = json.loads(capsys.readouterr().out)["classes"]["Car"]["calibration"]
    assert car["samples"] > 50
    assert sum(tenth["count"] for tenth in car["existence"]) >= car["samples"]
    assert 0.0 < car["coverage"] <= 1.0


def test_the_command_knows_the_benchmark_of_nuscenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of nuScenes the official figures come with HOTA of centres, GOSPA and the calibration."""
    data = ("--dataset", "nuscenes", "--root", str(nuscenes_root()), "--detections", "centerpoint")
    assert run(["track", *data, "--option", "clouds=0", "--out", str(tmp_path), "--full", "--json"]) == 0
    capsys.readouterr()
    assert run(["evaluate", *data, "--tracks", str(tmp_path), "--class", "car", "pedestrian"]) == 0
    shown = capsys.readouterr().out
    assert "AMOTA" in shown
    assert "class average" in shown
    assert run(["evaluate", *data, "--tracks", str(tmp_path), "--class", "car", "pedestrian", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    car = report["classes"]["car"]
    assert list(report["classes"]) == ["car", "pedestrian"]
    assert 0.5 < car["nuscenes"]["amota"] < 1.0
    assert 0.3 < car["hota_centre"]["all"]["HOTA"] < car["hota_centre"]["best"]["HOTA"] < 1.0
    assert car["calibration"]["samples"] > 100
    for key in ("all", "best"):
        parts = [one["hota_centre"][key] for one in report["classes"].values()]
        for name, value in report["overall"]["hota_centre"][key].items():
            assert value == pytest.approx(sum(part[name] for part in parts) / 2)
    assert run(["evaluate", *data, "--tracks", str(tmp_path), "--iou", "0.5"]) == 2


def test_results_must_be_there(kitti: tuple[Path, Path], tmp_path: Path) -> None:
    """A missing result file is named, and so is one with frames that the sequence does not have."""
    sequences = open_dataset("kitti", kitti[0]).sequences(["0000"])
    with pytest.raises(DatasetError, match=r"0000\.txt"):
        load_recordings("kitti", sequences, tmp_path)
    line = (kitti[1] / "0000.txt").read_text().splitlines()[0].split()
    (tmp_path / "0000.txt").write_text(" ".join(["999", *line[1:]]) + "\n")
    with pytest.raises(DatasetError, match="frame 999"):
        load_recordings("kitti", sequences, tmp_path)
