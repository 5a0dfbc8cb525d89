"""Variants of the tracker, each measured on the same data: the paper's ablation (Section V.C) and parameter sweeps.

All classes are tracked together, as in use. Frames per second count the tracker's steps alone, for frames that are in
memory: neither reading nor detecting is included.
"""

import csv
import io
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optipmb import Modules, Parameters, warm_up
from optipmb_tools.evaluation.figures import overall
from optipmb_tools.files import write_whole
from optipmb_tools.tuning.clips import track_clip
from optipmb_tools.tuning.run import TuningData
from optipmb_tools.tuning.scoring import Figures, Scorer, plain_figures, scorer_of
from optipmb_tools.tuning.values import with_values
from optipmb_tools.views.colours import colour_of

_MODULES = ("adp", "habm", "rpp", "ote")
_ROWS = (
    *("", "adp", "rpp", "ote", "habm", "adp rpp", "rpp ote", "adp ote", "adp habm", "habm rpp", "habm ote"),
    *("adp rpp ote", "adp habm rpp", "habm rpp ote", "adp habm ote", "adp habm rpp ote"),
)
ROWS = tuple(frozenset(row.split()) for row in _ROWS)  # the modules that are on, in the order of the paper's table


@dataclass(frozen=True)
class Variant:
    """A tracker to measure."""

    parameters: Parameters
    modules: Modules


@dataclass(frozen=True)
class Row:
    """Figures of a variant."""

    variant: Variant
    classes: dict[str, Figures]
    overall: Figures  # means over the classes; counts are sums
    frames_per_second: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "frames_per_second": self.frames_per_second,
            "overall": plain_figures(self.overall),
            "classes": {name: plain_figures(figures) for name, figures in self.classes.items()},
        }


def ablation(parameters: Parameters) -> list[Variant]:
    """Return the sixteen choices of modules, all with the same parameters."""
    return [Variant(parameters, Modules(**{name: name in on for name in _MODULES})) for on in ROWS]


def sweep(parameters: Parameters, classes: Sequence[str], path: str, values: Sequence[str]) -> list[Variant]:
    """Return a variant for each value of a parameter, the same for all these classes.

    Raises:
        UsageError: there is no such parameter, or a value is not allowed.
    """
    variants = []
    for value in values:
        changed = parameters
        for name in classes:
            changed = with_values(changed, name, {path: value})
        variants.append(Variant(changed, Modules()))
    return variants


def measure_variants(source: TuningData, variants: Sequence[Variant], on_clip: Callable[[int], None]) -> Iterator[Row]:
    """Track everything once with each variant; yield its row when it is done.

    The classes of the source are reported, all classes of the parameters are tracked; `on_clip` gets the frames of each
    clip of each variant when it is tracked.
    """
    scorers = [scorer_of(source.dataset, name, source.sequences) for name in source.classes]
    warm_up()
    for variant in variants:
        yield _row(source, variant, scorers, on_clip)


def _row(source: TuningData, variant: Variant, scorers: Sequence[Scorer], on_clip: Callable[[int], None]) -> Row:
    seconds, frames = 0.0, 0
    measured: dict[str, list[Any]] = {scorer.name: [] for scorer in scorers}
    for clip in source.clips:
        begun = time.perf_counter()
        tracks = track_clip(clip, variant.parameters, variant.modules, every_frame=True)
        seconds += time.perf_counter() - begun
        frames += len(clip.frames)
        for scorer in scorers:
            measured[scorer.name].append(scorer.measure(clip, tracks))
        on_clip(len(clip.frames))
    figures = {scorer.name: scorer.figures(measured[scorer.name]) for scorer in scorers}
    return Row(variant, figures, overall(list(figures.values())), frames / seconds if seconds else math.nan)


_DRAWN = ("AMOTA", "HOTA, all")


def write_sweep(folder: Path, result: Mapping[str, Any], *, picture: bool) -> None:
    """Write `sweep.json`, `sweep.csv` and, where matplotlib is installed, `sweep.png`.

    Args:
        folder: is made where it is not there.
        result: `sweeps` has for each parameter its `values`, the profile's own by class (`profile`), and `figures`: by
            class a mapping for each value.
        picture: whether to draw.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [
        {"parameter": one["parameter"], "value": value, "class": label, **figures}
        for one in result["sweeps"]
        for label, each in one["figures"].items()
        for value, figures in zip(one["values"], each, strict=True)
    ]
    lines = io.StringIO()
    table = csv.DictWriter(lines, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    for name, text in (("sweep.json", json.dumps(result, indent=1) + "\n"), ("sweep.csv", lines.getvalue())):
        write_whole(folder / name, [text])
    if picture:
        _draw(folder / "sweep.png", result["sweeps"])


def _draw(path: Path, sweeps: list[dict[str, Any]]) -> None:
    """Draw a column for each parameter, a row for each figure and a line for each class."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - matplotlib is an extra
    from matplotlib.figure import Figure  # noqa: PLC0415 - matplotlib is an extra

    figure = Figure(figsize=(1.0 + 3.6 * len(sweeps), 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(_DRAWN), len(sweeps), squeeze=False, sharex="col", sharey="row")
    for column, one in enumerate(sweeps):
        ticks = list(map(str, one["values"]))
        for row, name in enumerate(_DRAWN):
            axes = grid[row][column]
            for number, (label, figures) in enumerate(one["figures"].items(), start=1):
                heights = [float("nan") if each[name] is None else each[name] for each in figures]
                whole = label not in one["profile"]
                style = {"color": "#222222", "linestyle": "--"} if whole else {"color": colour_of(number)}
                axes.plot(ticks, heights, marker=".", label=label, **style)
                if not whole and one["profile"][label] in one["values"]:
                    place = one["values"].index(one["profile"][label])
                    axes.plot(ticks[place], heights[place], "o", markersize=10, markerfacecolor="none", **style)
            axes.grid(visible=True, color="#EEEEEE", linewidth=0.6)
            axes.set_ylabel(name if column == 0 else "")
        axes.set_xlabel(one["parameter"])
    handles, labels = grid[0][0].get_legend_handles_labels()
    title = "rings: the profile's value"
    figure.legend(handles, labels, title=title, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
