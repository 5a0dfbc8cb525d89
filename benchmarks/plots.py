"""The plots of docs/performance.md, from generated scenes alone; colours that colour-blind readers tell apart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from pathlib import Path

# Okabe and Ito's palette.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
PEER_STYLES = {"Stone Soup": (RED, "s"), "ByteTrack": (ORANGE, "^"), "norfair": (PURPLE, "D")}
DPI = 110
STAGES = ("predict", "preprocess", "detection_probability", "update", "extract")
"""The parts of a step, by the names of their functions."""


def scaling(found: dict[str, Any], path: Path) -> None:
    """Time of a step against the number of objects, with the bare arithmetic and other trackers."""
    figure = Figure(figsize=(7.5, 5.4), layout="constrained")
    axes = figure.add_subplot()
    step, floor = found["dense"]["generic"], found["dense"]["bare"]
    sizes = list(step)
    for name, times in found["peers"].items():
        colour, marker = PEER_STYLES.get(name.rpartition(" ")[0], (SKY, "v"))
        known = [int(size) for size in times]
        axes.loglog(known, [np.median(times[str(n)]) for n in known], color=colour, marker=marker, label=name)
    medians = [step[n]["median"] for n in sizes]
    axes.loglog(sizes, medians, color=BLUE, marker="o", linewidth=2, label="OptiPMB, Tracker.step, median")
    axes.fill_between(sizes, medians, [step[n]["p99"] for n in sizes], color=BLUE, alpha=0.2, label="up to its p99")
    axes.loglog(
        sizes, [floor[n]["median"] for n in sizes], color=GREEN, linestyle="--", marker="x", label="bare arithmetic"
    )
    axes.set_xticks(sizes, [str(n) for n in sizes])
    axes.minorticks_off()
    axes.set_xlabel("objects in the dense scene")
    axes.set_ylabel("time per frame, ms")
    axes.grid(visible=True, alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=DPI)


def stages(found: dict[str, Any], path: Path) -> None:
    """Where the time of a step goes: shares of the stages in scenes of several sizes."""
    figure = Figure(figsize=(7.5, 3.6), layout="constrained")
    axes = figure.add_subplot()
    colours = [BLUE, ORANGE, "#000000", SKY, "#F0E442"]
    names = list(found["stages"])
    totals = np.array([sum(found["stages"][name].values()) for name in names])
    left = np.zeros(len(names))
    for stage, colour in zip(STAGES, colours, strict=True):
        share = 100 * np.array([found["stages"][name][stage] for name in names]) / totals
        axes.barh(names, share, left=left, color=colour, label=stage, edgecolor="white")
        left += share
    for row, total in enumerate(totals):
        axes.text(101, row, f"{total / 1e3:.2f} ms", va="center")
    axes.invert_yaxis()
    axes.set_xlim(0, 115)
    axes.set_xlabel("share of the step, %")
    axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.45, 1.0), frameon=False)
    figure.savefig(path, dpi=DPI)


def clouds(found: dict[str, Any], path: Path) -> None:
    """Time of a step with 100 objects against the number of points."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for kind, colour, marker, label in (
        ("step", BLUE, "o", "whole step, 100 objects"),
        ("count", GREEN, "x", "points in boxes alone"),
    ):
        points = [int(name.split()[1]) for name in found["clouds"] if name.startswith(kind)]
        medians = [found["clouds"][f"{kind} {n}"]["median"] for n in points]
        axes.plot([n / 1e3 for n in points], medians, color=colour, marker=marker, label=label)
    axes.set_xlabel("points in the cloud, thousands")
    axes.set_ylabel("time, ms (median)")
    axes.set_ylim(bottom=0)
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=DPI)


def draw(found: dict[str, Any], folder: Path) -> None:
    """Draw all plots into a folder."""
    scaling(found, folder / "performance-scaling.png")
    stages(found, folder / "performance-stages.png")
    clouds(found, folder / "performance-clouds.png")
