"""What tuning works on: the same tracks and figures as everywhere else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optipmb_tools.datasets import Dataset, open_dataset
from optipmb_tools.evaluation.ab3dmot import evaluate_ab3dmot
from optipmb_tools.evaluation.cases import ab3dmot_rules, prepare
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings
from optipmb_tools.evaluation.nuscenes import NuScenesConfig, evaluate_nuscenes, evaluate_scenes, prepare_scene
from optipmb_tools.results.kitti import read_kitti_results
from optipmb_tools.run import profiles
from optipmb_tools.run.tracking import Tracking, track
from optipmb_tools.tuning.clips import Clip, load, of_class, track_clip
from optipmb_tools.tuning.scoring import rules_of, scorer_of
from optipmb_tools.tuning.values import only
from real_data import kitti_root, nuscenes_root
from tuning_cases import Habits, recorded

import optipmb

PARAMETERS = optipmb.load_profile("kitti")


def clip_of(habits: Habits | None = None, seed: int = 0) -> Clip:
    return load(recorded(habits or Habits(), seed, frames=40), PARAMETERS, rules_of("scene"))


def test_a_class_alone_is_tracked_as_among_others() -> None:
    """The boxes of a class are the same, to the bit, whether the others are tracked with it or not."""
    rules = rules_of("scene")
    (sequence,) = open_dataset("scene", frames=40, clouds=False).sequences(["0000"])
    clip = load(sequence, PARAMETERS, rules)
    everything = track_clip(clip, PARAMETERS)
    for name in PARAMETERS.labels:
        alone = track_clip(of_class(clip, name, rules), only(PARAMETERS, name))
        together = everything.of_class(name)
        assert len(alone) > 0
        order, other = (np.lexsort((one.center[:, 0], one.frame)) for one in (alone, together))
        for column in ("frame", "center", "size", "yaw", "score"):
            assert np.array_equal(getattr(alone, column)[order], getattr(together, column)[other])


def test_frames_in_which_nothing_can_happen_are_left_out_without_effect() -> None:
    """Tracks are the same whether empty frames are stepped through or not."""
    clip = clip_of()
    empty = [replace(frame, **{key: getattr(frame, key)[:0] for key in _COLUMNS}) for frame in clip.frames[:20]]
    clip = replace(clip, frames=(*empty, *clip.frames[20:]))
    quick, whole = track_clip(clip, PARAMETERS), track_clip(clip, PARAMETERS, every_frame=True)
    assert len(quick) > 100
    for column in ("frame", "id", "center", "score"):
        assert np.array_equal(getattr(quick, column), getattr(whole, column))


_COLUMNS = ("center", "size", "yaw", "velocity", "score", "label", "source")


def tracked(dataset: Dataset, names: list[str], out: Path) -> None:
    list(track(dataset, dataset.sequences(names), out, Tracking(profiles.read_profile("kitti-paper"))))


def test_figures_of_kitti_are_those_of_its_result_files(tmp_path: Path) -> None:
    """A trial's figures are AB3DMOT's and the centre HOTA of the files that track writes, to their six decimals."""
    root, names = kitti_root(), ["0004", "0011"]
    dataset = open_dataset("kitti", root, "pointrcnn", clouds=False)
    tracked(dataset, names, tmp_path)
    parameters = optipmb.load_profile("kitti-paper")
    sequences = dataset.sequences(names)
    clips = [load(sequence, parameters, rules_of("kitti")) for sequence in sequences]
    for name in ("Car", "Pedestrian", "Cyclist"):
        scorer = scorer_of("kitti", name, sequences)
        single = [of_class(clip, name, scorer.rules) for clip in clips]
        found = scorer.figures([scorer.measure(clip, track_clip(clip, only(parameters, name))) for clip in single])
        cases = [
            prepare(clip.truth, read_kitti_results(tmp_path / f"{clip.name}.txt"), name, ab3dmot_rules(), clip.name)
            for clip in clips
        ]
        official = evaluate_ab3dmot(cases)
        assert (found["FP"], found["FN"], found["IDS"], found["FRAG"], found["GT"]) == (
            official.best.false,
            official.best.missed,
            official.best.switches,
            official.best.fragments,
            official.best.truth,
        )
        assert found["sAMOTA"] == pytest.approx(official.samota, abs=1e-6)
        assert found["AMOTA"] == pytest.approx(official.amota, abs=1e-6)
        assert found["MOTP"] == pytest.approx(official.best.motp, abs=1e-4) or official.best.true > 0
        (figures,) = evaluate_figures("kitti", load_recordings("kitti", sequences, tmp_path), [name])
        if figures.best is not None:
            assert found["HOTA"] == pytest.approx(figures.best.hota.hota, abs=1e-6)


def test_figures_of_nuscenes_are_the_official_ones_of_its_result_file(tmp_path: Path) -> None:
    """A trial's figures equal the benchmark's evaluation in memory, and of the file up to its rounding."""
    dataset = open_dataset("nuscenes", nuscenes_root(), "centerpoint", clouds=False)
    sequences = dataset.sequences(["all"])
    list(track(dataset, sequences, tmp_path, Tracking(profiles.read_profile("nuscenes-paper"))))
    official = evaluate_nuscenes(nuscenes_root(), tmp_path)
    parameters = optipmb.load_profile("nuscenes-paper")
    clips = [load(sequence, parameters, rules_of("nuscenes")) for sequence in sequences]
    for name in ("car", "pedestrian"):
        scorer = scorer_of("nuscenes", name, sequences)
        single = [of_class(clip, name, scorer.rules) for clip in clips]
        tables = [track_clip(clip, only(parameters, name)) for clip in single]
        found = scorer.figures([scorer.measure(clip, table) for clip, table in zip(single, tables, strict=True)])
        scenes = [prepare_scene(sequence, NuScenesConfig()) for sequence in sequences]
        for scores, rounding in (
            (evaluate_scenes(list(zip(scenes, tables, strict=True))), 0.0),
            (official, 1e-4),  # a threshold between two scores moves with their last digits
        ):
            wanted = scores.classes[name]
            assert found["AMOTA"] == pytest.approx(wanted.amota, abs=rounding)
            assert found["MOTA"] == pytest.approx(wanted.best.mota, abs=rounding)
            assert (found["FP"], found["FN"], found["IDS"]) == (wanted.best.fp, wanted.best.fn, wanted.best.ids)
