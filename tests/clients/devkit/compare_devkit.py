"""Compare this project's nuScenes figures with the official tools on the same result files.

The official tools need numpy 1, so they live in an environment of their own:

    python3 -m venv /tmp/devkit
    /tmp/devkit/bin/pip install nuscenes-devkit "motmetrics==1.4.0" "pandas<3" "numpy<2"

Then, in the environment of this project, from its root:

    export PYTHONPATH=tests/support
    python tests/clients/devkit/compare_devkit.py --root NUSCENES --devkit /tmp/devkit/bin/python

NUSCENES is a root with `v1.0-mini` of scene-0103 and detections by CenterPoint. Compared are the truth itself,
disturbed truth of several seeds, the greedy tracker on each detector, tracks in one frame only, and disturbed truth of
generated pairs of scenes, with bicycle racks, unseen objects and uneven stamps. Ends with status 1 when any figure of
any class, overall, at the best threshold or along the curve, differs by more than 1e-6. With `--keep` and no such
difference, some of our figures are written to `agreed.json`, which the tests hold on to.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from nuscenes_cases import COLUMNS, Rows, disturbed_tracks, greedy_tracks, truth_tracks, write
from nuscenes_tables import crowd, write_detections, write_root
from optipmb_tools.datasets.nuscenes import NuScenesDataset
from optipmb_tools.evaluation.nuscenes import NuScenesScores, evaluate_nuscenes

TOLERANCE = 1e-6
SPLIT = "mini_val"
SEEDS = 8
KEPT = ("truth", "disturbed 0", "disturbed 1", "greedy centerpoint", "greedy pointpillars")
"""Cases whose figures the tests hold on to."""
AGREED = Path(__file__).with_name("agreed.json")


@dataclass(frozen=True)
class Case:
    name: str
    root: Path
    detector: str
    tracks: dict[str, list[Rows]]
    tolerance: float = TOLERANCE


def cases(root: Path, folder: Path) -> Iterator[Case]:
    (sequence,) = NuScenesDataset(root, "centerpoint").sequences([SPLIT])
    scene = sequence.name
    # The official tools take distances by |a|^2 - 2 ab + |b|^2, which loses half of the digits near zero.
    yield Case("truth", root, "centerpoint", {scene: truth_tracks(sequence, ignored=False)}, 1e-4)
    for seed in range(SEEDS):
        yield Case(f"disturbed {seed}", root, "centerpoint", {scene: disturbed_tracks(sequence, seed)})
    for path in sorted((root / "detections").glob("*.json")):
        (detected,) = NuScenesDataset(root, path.stem).sequences([SPLIT])
        yield Case(f"greedy {path.stem}", root, path.stem, {scene: greedy_tracks(detected)})
    rows = disturbed_tracks(sequence, 0)
    nothing = [replace(one, **{name: getattr(one, name)[:0] for name in COLUMNS}) for one in rows]
    # Of no box at all the official tools make an error.
    yield Case("one frame", root, "centerpoint", {scene: [*nothing[:9], rows[9], *nothing[10:]]})
    for seed in range(SEEDS):
        scenes = [crowd("scene-0103", seed), crowd("scene-0916", 100 + seed, 22, 1_538_984_233_000_000)]
        made = write_root(folder / f"made-{seed}", scenes)
        write_detections(made, "none", scenes)
        tracks = {one.name: disturbed_tracks(one, seed) for one in NuScenesDataset(made).sequences([SPLIT])}
        yield Case(f"made {seed}", made, "none", tracks)


def official(python: Path, root: Path, results: Path) -> dict[str, Any]:
    script = Path(__file__).with_name("run_devkit.py")
    command = [python, script, root, "v1.0-mini", SPLIT, results]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=900)
    return dict(json.loads(done.stdout))


def differences(ours: NuScenesScores, theirs: dict[str, Any], tolerance: float) -> Iterator[str]:
    pairs = [("all", name, ours.overall[name], value) for name, value in theirs["overall"].items()]
    for label, values in theirs["classes"].items():
        scores = ours.classes[label]
        known = {"amota": scores.amota, "amotp": scores.amotp, **vars(scores.best)}
        pairs += [(label, name, known[name], value) for name, value in values.items()]
    for label, curve in theirs["curves"].items():
        points = ours.classes[label].curve
        if not any(points):
            continue
        for name, values in curve.items():
            if name == "recall_hypo":
                continue
            wanted = "threshold" if name == "confidence" else name
            for i, value in enumerate(values):
                point = points[i]
                got = math.nan if point is None else getattr(point, wanted)
                pairs.append((label, f"{name}[{i}]", got, value))
    for label, name, mine, value in pairs:
        if not np.isclose(mine, value, rtol=0.0, atol=tolerance, equal_nan=True):
            yield f"{label} {name}: {mine!r}, official {value!r}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--devkit", type=Path, required=True, help="the python of the other environment")
    parser.add_argument("--keep", action="store_true", help="write the figures that the tests hold on to")
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case in cases(arguments.root, folder):
            dataset = NuScenesDataset(case.root, case.detector)
            for sequence in dataset.sequences([SPLIT]):
                path = write(dataset, sequence, case.tracks[sequence.name], folder / case.name)
            ours = evaluate_nuscenes(case.root, path)
            found = list(differences(ours, official(arguments.devkit, case.root, path), case.tolerance))
            wrong += len(found)
            amota, ids = ours.overall["amota"], ours.overall["ids"]
            print(f"{case.name}: AMOTA {amota:.6f}, IDS {ids:.0f}, {len(found)} differences")  # noqa: T201  a command
            for line in found[:20]:
                print(f"  {line}")  # noqa: T201  a command
            if case.name in KEPT:
                figures[case.name] = ours.to_json()
    if arguments.keep and not wrong:
        AGREED.write_text(json.dumps(figures, indent=1) + "\n")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
