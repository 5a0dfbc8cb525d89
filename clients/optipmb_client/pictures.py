"""Pictures of a sequence from above, as PNG files.

Conventions: world frame, metres, x to the right and y up. Colours belong to track ids, which are written beside the
tracks too. matplotlib is an extra of the installation and is imported when the first picture is drawn.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from optipmb_schemas.installation import install_command

from optipmb_client.colours import colour_of
from optipmb_client.datasets import DataSequence, Truth
from optipmb_client.errors import ClientError
from optipmb_client.evaluation import ClearResult
from optipmb_client.geometry import Floats, box_corners, stack_poses
from optipmb_client.results import ResultTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK = "#222222"
_TRUTH = "#B5B5B5"
_MARGIN = 6.0
_BREAK = 5  # a path is not drawn across more missing frames than this


class Panel(NamedTuple):
    """Tracks of one tracker, in the world frame."""

    tracks: ResultTable
    results: Sequence[ClearResult] = ()  # CLEAR figures of the classes; their misses and identity switches are marked
    title: str = ""


def draw_tracks(path: Path, sequence: DataSequence, panels: Sequence[Panel], truth: Truth | None = None) -> None:
    """Draw the tracks of a sequence from above, those of several trackers side by side on the same axes.

    Args:
        path: the PNG file.
        sequence: what was tracked; its poses give the sensor's path.
        panels: one for each tracker.
        truth: annotations in the world frame, drawn thin below the tracks.

    Raises:
        ClientError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - matplotlib is an extra
        from matplotlib.figure import Figure  # noqa: PLC0415 - matplotlib is an extra
    except ImportError as error:
        raise ClientError(f"pictures need matplotlib, which is not installed: {install_command('plot')}") from error
    _, sensor = stack_poses(sequence.poses)
    low, high = _extent([sensor, *(panel.tracks.center for panel in panels), truth.center if truth else sensor])
    longest = 11.0 if len(panels) == 1 else 8.0
    width, height = np.maximum(longest / max(high - low) * (high - low), (7.5, 3.0)).tolist()
    # Panels of a long street lie one below the other, others side by side.
    rows, columns = (1, len(panels)) if height > 0.4 * width else (len(panels), 1)
    figure = Figure(figsize=(columns * width + 0.6, rows * height + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel().tolist()
    for axes, panel in zip(grid, panels, strict=True):
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_xlabel("x in the world frame (m)")
        axes.set_ylabel("y in the world frame (m)")
        title = panel.title or f"Sequence {sequence.name}"
        axes.set_title(f"{title}: {len(np.unique(panel.tracks.id))} tracks in {len(sequence)} frames")
        axes.grid(visible=True, color="#EEEEEE", linewidth=0.6)
        axes.set_axisbelow(True)
        if truth is not None:
            _draw_truth(axes, truth)
        _draw_sensor(axes, sensor, sequence)
        _draw_paths(axes, panel.tracks, last_frame=len(sequence) - 1)
        if truth is not None:
            _draw_failures(axes, truth, panel.results)
        axes.label_outer()
    _legend(figure, grid)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _extent(places: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return the corners (2,) of what is to be seen, at least a few metres apart."""
    points = np.vstack([place[:, :2] for place in places] + [np.zeros((1, 2))] * (not sum(len(p) for p in places)))
    low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    # A long street is to be wider than a line: the short side is at least a quarter of the long one.
    lack = np.maximum(0.25 * float(max(high - low)) - (high - low), 0.0)
    return low - 0.5 * lack, high + 0.5 * lack


def _draw_truth(axes: "Axes", truth: Truth) -> None:
    label = "truth"
    for rows in _rows_by_id(truth.id):
        axes.plot(*_broken(truth.frame[rows], truth.center[rows]), color=_TRUTH, linewidth=3.0, label=label, zorder=2)
        label = "_"


def _draw_sensor(axes: "Axes", sensor: Floats, sequence: DataSequence) -> None:
    axes.plot(sensor[:, 0], sensor[:, 1], color=_INK, linewidth=1.2, linestyle=(0, (6, 3)), label="sensor", zorder=3)
    if len(sequence):
        axes.plot(*sensor[0, :2], "o", color=_INK, markersize=4, zorder=3)
        axes.plot(*sensor[-1, :2], ">", color=_INK, markersize=6, zorder=3)


def _draw_paths(axes: "Axes", tracks: ResultTable, last_frame: int) -> None:
    label, box_label = "track (colour and number: its id)", "last box, a line to its front"
    for rows in _rows_by_id(tracks.id):
        identity = int(tracks.id[rows[0]])
        colour = colour_of(identity)
        axes.plot(*_broken(tracks.frame[rows], tracks.center[rows]), color=colour, linewidth=1.2, label=label, zorder=4)
        end = rows[-1:]
        corners = box_corners(tracks.center[end], tracks.size[end], tracks.yaw[end])[0, :4, :2]
        front, middle = 0.5 * (corners[0] + corners[1]), tracks.center[end[0], :2]
        alive = int(tracks.frame[end[0]]) == last_frame
        axes.fill(*corners.T, facecolor=colour, alpha=0.35 if alive else 0.0, zorder=5)
        axes.plot(
            *np.vstack([corners, corners[:1]]).T,
            color=colour,
            linewidth=1.0 if alive else 0.5,
            label=box_label,
            zorder=5,
        )
        axes.plot(*np.vstack([middle, front]).T, color=colour, linewidth=1.0 if alive else 0.5, zorder=5)
        axes.annotate(
            str(identity),
            (float(tracks.center[rows[0], 0]), float(tracks.center[rows[0], 1])),
            xytext=(2, 2),
            textcoords="offset points",
            color=colour,
            fontsize=7,
            zorder=7,
        )
        label = box_label = "_"


def _draw_failures(axes: "Axes", truth: Truth, results: Sequence[ClearResult]) -> None:
    place = {(int(f), int(i)): row for row, (f, i) in enumerate(zip(truth.frame, truth.id, strict=True))}
    misses = [place[miss.frame, miss.truth] for result in results for miss in result.misses]
    if misses:
        axes.plot(
            *truth.center[misses, :2].T, "x", color=_INK, markersize=3, markeredgewidth=0.6, label="miss", zorder=6
        )
    label = "change of id"
    for result in results:
        for switch in result.switches:
            x, y, _ = truth.center[place[switch.frame, switch.truth]].tolist()
            axes.plot(x, y, "o", color=_INK, markerfacecolor="none", markersize=11, label=label, zorder=8)
            axes.annotate(
                f"{switch.old} to {switch.new}", (x, y), xytext=(8, -9), textcoords="offset points", fontsize=8
            )
            label = "_"


def _legend(figure: "Figure", grid: "Sequence[Axes]") -> None:
    found = {label: one for axes in grid for one, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    columns = max(1, len(found))
    figure.legend(found.values(), found, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def _rows_by_id(identity: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each id, in the order of ids."""
    order = np.argsort(identity, kind="stable")
    bounds = np.flatnonzero(np.diff(identity[order])) + 1
    return np.split(order, bounds) if len(order) else []


def _broken(frame: np.ndarray, center: Floats) -> tuple[Floats, Floats]:
    """Return the path of one object with a NaN where it was away."""
    gaps = np.flatnonzero(np.diff(frame) > _BREAK) + 1
    return np.insert(center[:, 0], gaps, np.nan), np.insert(center[:, 1], gaps, np.nan)
