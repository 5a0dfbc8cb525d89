"""Compare this project's figures by AB3DMOT's protocol with the published evaluation.

The published evaluation lives in an environment of its own:

    python3 -m venv /tmp/ab3dmot
    /tmp/ab3dmot/bin/pip install eval-ab-3d-mot

Then, in the environment of this project, from its root:

    export PYTHONPATH=tests/support
    python tests/clients/devkit/compare_ab3dmot.py --tool /tmp/ab3dmot/bin/python [--root KITTI --tracks FOLDER]

Compared are generated benchmarks, with all that the rules name, and with a root and a folder of result files also
those. Ends with status 1 when any figure differs by more than 1e-9. With `--keep` and no such difference, the figures
of the generated benchmarks are written to `ab3dmot.json`, which the tests hold on to.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from evaluation_cases import write_kitti
from optipmb_tools.datasets import open_dataset
from optipmb_tools.evaluation.evaluate import evaluate_figures, load_recordings

TOLERANCE = 1e-9
SEEDS = 4
KEPT = Path(__file__).with_name("ab3dmot.json")

Figures = dict[str, dict[str, Any]]


def ours(root: Path, results: Path) -> tuple[Figures, list[str]]:
    dataset = open_dataset("kitti", root)
    chosen = [one for one in dataset.sequences(["all"]) if (results / f"{one.name}.txt").exists()]
    figures = evaluate_figures("kitti", load_recordings("kitti", chosen, results), ("Car", "Pedestrian", "Cyclist"))
    found = {f"{one.name} {result.limit:g}": result.summary() for one in figures for result in one.ab3dmot}
    return found, [f"{one.name}={len(one)}" for one in chosen]


def differences(root: Path, results: Path, tool: str) -> tuple[Figures, list[str]]:
    found, sequences = ours(root, results)
    script = Path(__file__).with_name("run_ab3dmot.py")
    command = [tool, str(script), str(root / "training" / "label_02"), str(results), *sequences]
    told = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    lines = []
    for key, theirs in told.items():
        for name, value in theirs.items():
            mine = found[key][name]
            same = mine == value if mine is None or value is None else abs(mine - value) <= TOLERANCE
            if not same:
                lines.append(f"{key} {name}: {mine} here, {value} there")
    return found, lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tool", required=True, help="Python of the environment with eval-ab-3d-mot")
    parser.add_argument("--root", type=Path, help="KITTI tracking root")
    parser.add_argument("--tracks", type=Path, help="result files for it")
    parser.add_argument("--keep", action="store_true", help="write the figures of the generated benchmarks")
    given = parser.parse_args()
    kept: dict[str, Figures] = {}
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        cases = {}
        for seed in range(SEEDS):
            place = Path(folder) / str(seed)
            cases[str(seed)] = (write_kitti(place, place / "results", seed), place / "results")
        if given.root is not None:
            cases["root"] = (given.root, given.tracks)
        for name, (root, results) in cases.items():
            found, lines = differences(root, results, given.tool)
            sys.stdout.write("".join(f"{name}: {line}\n" for line in lines) or f"{name}: the same\n")
            wrong += len(lines)
            if name != "root":
                kept[name] = found
    if wrong:
        sys.exit(1)
    if given.keep:
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
