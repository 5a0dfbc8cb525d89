"""What profiles that ship reach on real data: figures of each class, computed once in a process."""

import re
from functools import cache
from pathlib import Path

from optipmb_tools.datasets import DataSequence, open_dataset
from optipmb_tools.results import FullTable
from optipmb_tools.tuning.clips import Clip, load, of_class, track_clip
from optipmb_tools.tuning.scoring import Figures, Scorer, rules_of, scorer_of
from optipmb_tools.tuning.values import only
from real_data import kitti_root, nuscenes_root

import optipmb


@cache
def sequences_of(dataset: str, detections: str) -> list[DataSequence]:
    root = kitti_root() if dataset == "kitti" else nuscenes_root()
    options = {"z_bottom": True} if detections == "pointpillars" else {}
    return list(open_dataset(dataset, root, detections, clouds=False, **options).sequences(["all"]))


@cache
def material(dataset: str, detections: str) -> tuple[dict[str, Scorer], dict[str, list[Clip]]]:
    sequences = sequences_of(dataset, detections)
    rules = rules_of(dataset)
    clips = [load(one, optipmb.load_profile(dataset), rules) for one in sequences]
    labelled = {str(name) for clip in clips for name in clip.truth.names[~clip.truth.ignored]}
    names = [name for name in optipmb.load_profile(dataset).labels if name in labelled]
    return (
        {name: scorer_of(dataset, name, sequences) for name in names},
        {name: [of_class(clip, name, rules) for clip in clips] for name in names},
    )


@cache
def tracked(profile: str, detections: str, name: str) -> list[FullTable]:
    _, clips = material(profile.removesuffix("-paper"), detections)
    parameters = only(optipmb.load_profile(profile), name)
    return [track_clip(clip, parameters) for clip in clips[name]]


@cache
def figures(profile: str, detections: str, name: str) -> Figures:
    scorers, clips = material(profile.removesuffix("-paper"), detections)
    tracks = zip(clips[name], tracked(profile, detections, name), strict=True)
    return scorers[name].figures([scorers[name].measure(clip, table) for clip, table in tracks])


def without_motion(profile: Path) -> bytes:
    """Return a profile without the factors of speed and turn rate, which were set for each detector by hand."""
    return re.sub(rb"(?m)^(calibration = .*?)(, (?:speed|turn_rate) = [0-9.]+)+ }$", rb"\1 }", profile.read_bytes())
