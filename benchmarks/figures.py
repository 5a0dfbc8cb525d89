"""All figures of docs/performance.md in one run: `python benchmarks/figures.py [--peers PYTHON] [--docs]`.

Every figure that is compared with another is measured in turns with it, so that what else the machine does hits both.
Prints the tables; `--docs` draws the plots of the page. `--peers` names the interpreter of an environment
with the trackers of `peers.py`. Recorded sequences are left out where their data are not there.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from lower_bound import arguments, bare
from plots import STAGES, draw
from settled import PROFILES, recorded, settled
from turns import CALLS, CLOCK, ROUNDS, in_turns, summary

import optipmb
from optipmb.filter.detection_probability import points_in_boxes

if TYPE_CHECKING:
    from collections.abc import Callable

FOLDER = Path(__file__).resolve().parent
IMAGES = FOLDER.parent / "docs" / "images"
OBJECTS = (10, 20, 50, 100, 200, 400, 800)
POINTS = (0, 30_000, 120_000)
BOXES = 100


def dense() -> dict[str, Any]:
    """Steps of growing scenes by both profiles, and the bare arithmetic of the same frames, of the tuned one."""
    tasks: dict[str, Callable[[], object]] = {}
    for objects in OBJECTS:
        for profile in PROFILES:
            tracker, density, frame = settled(objects, profile=profile)
            tasks[f"{profile} {objects}"] = lambda t=tracker, d=density, f=frame: t.step(d, f)
        given = arguments(tracker.parameters, density, frame)
        tasks[f"bare {objects}"] = lambda a=given: bare(*a)
    times = in_turns(tasks)
    return {kind: {n: summary(times[f"{kind} {n}"]) for n in OBJECTS} for kind in (*PROFILES, "bare")}


def growth(steps: dict[int, dict[str, float]]) -> float:
    """The exponent b of time = a objects^b from 100 to 800 objects, by least squares over the logarithms."""
    sizes = [n for n in OBJECTS if n >= 100]
    return float(np.polyfit(np.log(sizes), np.log([steps[n]["median"] for n in sizes]), 1)[0])


def clouds() -> dict[str, Any]:
    """Points in a hundred boxes, alone and as part of a step."""
    tasks: dict[str, Callable[[], object]] = {}
    for points in POINTS:
        tracker, density, frame = settled(BOXES, points, PROFILES[0])
        tasks[f"step {points}"] = lambda t=tracker, d=density, f=frame: t.step(d, f)
        if frame.cloud is not None:
            boxes = density.bernoulli
            center = np.column_stack([boxes.mean[:, :2], boxes.auxiliary[:, 3]])
            size, yaw = boxes.auxiliary[:, :3].copy(), boxes.mean[:, 3].copy()
            box = frame.cloud, center[:BOXES], size[:BOXES], yaw[:BOXES]
            tasks[f"count {points}"] = lambda b=box: points_in_boxes(*b)
    return {name: summary(times) for name, times in in_turns(tasks).items()}


def sequences() -> dict[str, Any]:
    """Recorded sequences, frame by frame: the step alone, and with the check of its detections before it."""
    found = {}
    for dataset in ("kitti", "nuscenes"):
        try:
            parameters, runs = recorded(dataset)
        except pytest.skip.Exception as reason:
            print(f"{dataset}: {reason}")
            continue
        tracker = optipmb.Tracker(parameters)
        step, whole = [], []
        for _ in range(3 if dataset == "kitti" else 30):
            for run in runs:
                density = tracker.initial()
                for given in run:
                    begun = CLOCK()
                    frame, _ = optipmb.make_frame(parameters, **given | {"pose": optipmb.Pose(*given["pose"])})
                    checked = CLOCK()
                    density = tracker.step(density, frame).density
                    done = CLOCK()
                    step.append(done - checked)
                    whole.append(done - begun)
        frames = [len(given["label"]) for run in runs for given in run]
        found[dataset] = {
            "frames": len(frames),
            "detections": float(np.mean(frames)),
            "step": summary(np.array(step) / 1e6),
            "whole": summary(np.array(whole) / 1e6),
        }
    return found


def stages() -> dict[str, dict[str, float]]:
    """Median microseconds of each stage of a step."""
    found, spent = {}, dict.fromkeys(STAGES, 0)

    def clocked(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            begun = CLOCK()
            result = function(*arguments, **named)
            spent[stage] = CLOCK() - begun
            return result

        return timed

    for objects, points in ((10, 0), (100, 0), (800, 0), (100, 30_000)):
        tracker, density, frame = settled(objects, points, PROFILES[0])
        taken = []
        with pytest.MonkeyPatch.context() as patch:
            for stage in STAGES:
                patch.setattr(optipmb.tracker, stage, clocked(stage, getattr(optipmb.tracker, stage)))
            for _ in range(ROUNDS * CALLS):
                tracker.step(density, frame)
                taken.append(tuple(spent.values()))
        name = f"{objects} objects" + (f", {points // 1000},000 points" if points else "")
        found[name] = dict(zip(STAGES, np.median(taken, axis=0) / 1e3, strict=True))
    return found


def share_of_kernels() -> dict[int, dict[str, float]]:
    """Microseconds of a step spent in compiled code, in calling it, and in numpy and the interpreter."""
    from profiled import shares  # noqa: PLC0415 - it replaces functions of the tracker, after everything else

    return {objects: shares(*settled(objects, profile=PROFILES[0])) for objects in (10, 100, 800)}


def peers(python: str) -> dict[str, dict[str, list[float]]]:
    """The times of other trackers on the same scenes."""
    done = subprocess.run([python, FOLDER / "peers.py"], stdout=subprocess.PIPE, check=True)  # noqa: S603 - our own
    return dict(json.loads(done.stdout))


def conditions() -> str:
    """What the figures were measured on."""
    with Path("/proc/cpuinfo").open(encoding="utf-8") as info:
        models = {line.split(":")[1].strip() for line in info if line.startswith("model name")}
    load = os.getloadavg()[0]
    return (
        f"{', '.join(sorted(models)) or platform.machine()}, {os.cpu_count()} cores, CPython "
        f"{platform.python_version()}, processor time of one thread, load average {load:.1f} before the run"
    )


def tables(found: dict[str, Any]) -> str:
    """All figures as Markdown."""
    lines = [f"Measured on: {found['conditions']}.", ""]
    others = found["peers"]
    lines += [
        "| objects | median ms | p99 ms | least ms | us per object | `kitti` ms | ratio to it "
        "| bare arithmetic ms | ratio |" + "".join(f" {n} ms | ratio |" for n in others)
    ]
    lines += ["| ---: " * (9 + 2 * len(others)) + "|"]
    for n in OBJECTS:
        step, tuned, floor = (found["dense"][kind][n] for kind in (*PROFILES, "bare"))
        row = (
            f"| {n} | {step['median']:.3f} | {step['p99']:.3f} | {step['least']:.3f} | {1e3 * step['median'] / n:.1f} "
        )
        row += f"| {tuned['median']:.3f} | {step['median'] / tuned['median']:.2f} "
        row += f"| {floor['median']:.3f} | {tuned['median'] / floor['median']:.1f} |"
        for times in others.values():
            median = np.median(times[str(n)]) if str(n) in times else None
            row += f" {median:.1f} | {median / step['median']:.0f} |" if median else " | |"
        lines.append(row)
    lines += ["", f"Growth from 100 to 800 objects: time goes with objects to the power of {found['growth']:.2f}.", ""]
    lines += ["| 100 objects | median ms | p99 ms | least ms |", "| --- | ---: | ---: | ---: |"]
    words = {"step": "whole step with", "count": "points in boxes alone,"}
    for name, one in found["clouds"].items():
        kind, points = name.split()
        lines.append(
            f"| {words[kind]} {int(points):,} points | {one['median']:.3f} | {one['p99']:.3f} | {one['least']:.3f} |"
        )
    lines += [
        "",
        "| recorded | frames | detections per frame | step ms | frames/s | with check, median ms | p99 ms | frames/s |",
    ]
    lines += ["| --- " + "| ---: " * 7 + "|"]
    for name, one in found["sequences"].items():
        step, whole = one["step"]["median"], one["whole"]["median"]
        label = {"kitti": "KITTI, cars", "nuscenes": "nuScenes keyframes, score filter and NMS"}[name]
        lines.append(
            f"| {label} | {one['frames']} | {one['detections']:.0f} | {step:.3f} | {1e3 / step:,.0f} "
            f"| {whole:.3f} | {one['whole']['p99']:.3f} | {1e3 / whole:,.0f} |"
        )
    lines += [
        "",
        "| us per step | " + " | ".join(found["stages"]) + " |",
        "| --- " + "| ---: " * len(found["stages"]) + "|",
    ]
    for stage in STAGES:
        lines.append(f"| `{stage}` | " + " | ".join(f"{one[stage]:.0f}" for one in found["stages"].values()) + " |")
    lines += ["", "| objects | kernels us | calls of kernels us | interpreter and numpy us |"]
    lines += ["| ---: | ---: | ---: | ---: |"]
    for n, one in found["shares"].items():
        lines.append(f"| {n} | " + " | ".join(f"{one[k]:.0f}" for k in ("kernels", "calls", "python")) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print, and draw the plots if asked."""
    parser = argparse.ArgumentParser(description="All figures of docs/performance.md in one run.")
    parser.add_argument("--peers", metavar="PYTHON", help="interpreter of an environment with other trackers")
    parser.add_argument("--docs", action="store_true", help="draw the plots of docs/performance.md")
    parser.add_argument("--json", type=Path, help="also write all figures to this file")
    chosen = parser.parse_args()
    optipmb.warm_up()
    found: dict[str, Any] = {"conditions": conditions()}
    for name, part in (("dense", dense), ("clouds", clouds), ("sequences", sequences), ("stages", stages)):
        print(f"measuring: {name}", flush=True)
        found[name] = part()
    found["growth"] = growth(found["dense"][PROFILES[0]])
    found["peers"] = peers(chosen.peers) if chosen.peers else {}
    found["shares"] = share_of_kernels()
    print(tables(found))
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    if chosen.docs:
        draw(found, IMAGES)


if __name__ == "__main__":
    main()
