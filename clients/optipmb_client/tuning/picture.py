"""Files of a parameter sweep: its figures as JSON and CSV, and a picture of them."""

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from optipmb_client.colours import colour_of
from optipmb_client.files import write_whole

__all__ = ["write_sweep"]

_DRAWN = ("AMOTA", "HOTA, all")


def write_sweep(folder: Path, result: Mapping[str, Any], *, picture: bool) -> None:
    """Write `sweep.json`, `sweep.csv` and, where matplotlib is installed, `sweep.png`.

    Args:
        folder: is made where it is not there.
        result: `sweeps` has for each parameter its `values`, those of the `profile` by class, and `figures`: by class
            a mapping for each value.
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
