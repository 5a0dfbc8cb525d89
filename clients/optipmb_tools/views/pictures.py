"""Pictures of a sequence from above, as PNG files, and moving pictures, as GIF files.

Conventions: world frame, metres, x to the right and y up; one second of a moving picture is one second of the sequence.
Colours belong to track ids, which are written at the tracks too. matplotlib, which brings Pillow, is an extra of
the installation and is imported when the first picture is drawn.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from optipmb_client.errors import ClientError
from optipmb_schemas.installation import install_command

from optipmb_tools.datasets import DataSequence, DetectionFrame, Truth
from optipmb_tools.geometry import Floats, Ints, box_corners, rotation_of, stack_poses, to_world
from optipmb_tools.results import ResultTable, ranks
from optipmb_tools.views.colours import COLOURS, colour_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from optipmb_tools.evaluation import ClassResult
    from optipmb_tools.evaluation.clear import ClearResult

_INK, _TRUTH = "#222222", "#B5B5B5"
_MARGIN = 6.0
_MARKERS = "os^vDPX*"  # of classes
_BREAK = 5  # a path is not drawn across more missing frames than this
_NEAR_M = 2.0  # as far as tracks of an object may be in figures of centres
_ENTRY_IN = 2.6  # width of an entry of the legend

# Of moving pictures
FRAMES = 70  # of a longer sequence every second frame is drawn, or every third …
TRAIL_S = 3.0
REACH_M = 45.0  # on each side of the sensor, where the picture follows it
WIDEST_M = 140.0  # a wider scene does not fit one view: the picture follows the sensor
INSIDE = (0.03, 0.97)  # quantiles of the places of tracks between which the view lies, with a margin
MARGIN_M = 4.0
NARROWEST_M = 30.0
SCALE_M = 10.0
WIDTH_PX = 800
LEGEND = 2.0  # its width, inches, on the right
HEIGHTS = (0.45, 0.64)  # least and largest height of the view, as a share of its width
_SHADE, _DETECTION = "#8E8E8E", _INK

# Of the ground
_GROUND = {
    "pavement": "#EDEAE4",
    "road": "#CDD1D6",
    "block": "#F7F6F2",
    "building": "#B7A692",
    "crosswalk": "#FFFFFF",
    "line": "#FFFFFF",
}
_DASHES = (0, (7, 5))


class Panel(NamedTuple):
    """Tracks of one tracker, in the world frame."""

    tracks: ResultTable
    results: "Sequence[ClearResult]" = ()  # CLEAR figures of the classes; their misses and identity switches are marked
    title: str = ""
    unconfirmed: ResultTable | None = None  # rows that are left out, drawn where they explain a miss


@contextlib.contextmanager
def matplotlib_needed() -> Iterator[None]:
    """Say what to install where matplotlib is missing."""
    try:
        yield
    except ImportError as error:
        raise ClientError(f"pictures need matplotlib, which is not installed: {install_command('plot')}") from error


def draw_tracks(path: Path, sequence: DataSequence, panels: Sequence[Panel], truth: Truth | None = None) -> None:
    """Draw the tracks of a sequence from above, several trackers side by side on the same axes.

    Args:
        path: The PNG file.
        sequence: The tracked sequence; its poses give the sensor's path.
        panels: One for each tracker.
        truth: Annotations in the world frame, drawn thin below the tracks.

    Raises:
        ClientError: matplotlib is not installed.
    """
    with matplotlib_needed():
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  an extra
        from matplotlib.figure import Figure  # noqa: PLC0415  an extra
    _, sensor = stack_poses(sequence.poses)
    boxes = [*(panel.tracks for panel in panels), *([truth] if truth else [])]
    low, high = _extent([*(one.center for one in boxes), *([sensor] if sensor.any() else [])])
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
        _draw_ground(axes, sequence)
        if truth is not None:
            _draw_truth(axes, truth)
        if sensor.any():
            _draw_sensor(axes, sensor, sequence)
        _draw_paths(axes, panel.tracks, last_frame=len(sequence) - 1)
        if truth is not None:
            _draw_failures(axes, truth, panel)
        axes.label_outer()
    _legend(figure, grid)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _extent(places: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return the corners (2,) of the view, at least a few metres apart."""
    points = np.vstack([place[:, :2] for place in places] + [np.zeros((1, 2))] * (not sum(len(p) for p in places)))
    low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    # A long street is to be wider than a line: the short side is at least a quarter of the long one.
    lack = np.maximum(0.25 * float(max(high - low)) - (high - low), 0.0)
    return low - 0.5 * lack, high + 0.5 * lack


def _draw_ground(axes: "Axes", sequence: DataSequence) -> None:
    for kind, outline in sequence.areas:
        if kind == "line":
            axes.plot(*outline.T, color=_GROUND[kind], linewidth=1.0, linestyle=_DASHES, zorder=1.5)
        else:
            axes.fill(*outline.T, color=_GROUND[kind], linewidth=0.0, zorder=1.5)


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
    label, box_label, named = "track (colour and number: its id)", "last box, a line to its front", set()
    for rows in _rows_by_id(tracks.id):
        identity = int(tracks.id[rows[0]])
        colour = colour_of(identity)
        axes.plot(*_broken(tracks.frame[rows], tracks.center[rows]), color=colour, linewidth=1.2, label=label, zorder=4)
        kind = int(tracks.label[rows[0]])
        place = tracks.center[rows[0], :2].tolist()
        name = "_" if kind in named else f"start of a {tracks.labels[kind]}"
        axes.plot(*place, _MARKERS[kind % len(_MARKERS)], color=colour, markersize=4, label=name, zorder=6)
        named.add(kind)
        end = rows[-1:]
        (corners,) = _outlines(tracks, end)
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
            place,
            xytext=(2, 2),
            textcoords="offset points",
            color=colour,
            fontsize=7,
            zorder=7,
        )
        label = box_label = "_"


def _draw_failures(axes: "Axes", truth: Truth, panel: Panel) -> None:
    results = panel.results
    place = {(int(f), int(i)): row for row, (f, i) in enumerate(zip(truth.frame, truth.id, strict=True))}
    misses = [place[miss.frame, miss.truth] for result in results for miss in result.misses]
    if panel.unconfirmed is not None:
        misses = _draw_unconfirmed(axes, truth, misses, panel.unconfirmed)
    if misses:
        axes.plot(
            *truth.center[misses, :2].T, "x", color=_INK, markersize=3, markeredgewidth=0.6, label="miss", zorder=6
        )
    label = "change of id"
    for result in results:
        for switch in result.changes:
            x, y, _ = truth.center[place[switch.frame, switch.truth]].tolist()
            axes.plot(x, y, "o", color=_INK, markerfacecolor="none", markersize=11, label=label, zorder=8)
            axes.annotate(
                f"{switch.old} to {switch.new}", (x, y), xytext=(8, -9), textcoords="offset points", fontsize=8
            )
            label = "_"


def _draw_unconfirmed(axes: "Axes", truth: Truth, misses: list[int], tracks: ResultTable) -> list[int]:
    """Draw the tracks at missed objects that are not confirmed; return the misses without any."""
    rows_at: dict[int, Ints] = {int(tracks.frame[rows[0]]): rows for rows in _rows_by_id(tracks.frame)}
    used, without = [], []
    for miss in misses:
        rows = rows_at.get(int(truth.frame[miss]), np.empty(0, dtype=np.int64))
        distance = np.linalg.norm(tracks.center[rows, :2] - truth.center[miss, :2], axis=1)
        near = int(distance.argmin()) if len(rows) else 0
        if len(rows) and distance[near] <= _NEAR_M:
            used.append(int(rows[near]))
        else:
            without.append(miss)
    label = "track that is not confirmed"
    for rows in _rows_by_id(tracks.id[used]):
        mine = np.sort(np.array(used)[rows])
        path = _broken(tracks.frame[mine], tracks.center[mine])
        colour = colour_of(int(tracks.id[mine[0]]))
        axes.plot(*path, color=colour, linewidth=2.0, linestyle=(0, (1.0, 1.0)), label=label, zorder=4)
        label = "_"
    return without


def _legend(figure: "Figure", grid: "Sequence[Axes]") -> None:
    found = {label: one for axes in grid for one, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    columns = max(1, min(4, len(found), int(figure.get_figwidth() / _ENTRY_IN)))
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


def animate_tracks(path: Path, sequence: DataSequence, tracks: ResultTable, truth: Truth | None = None) -> None:
    """Draw the tracks of a sequence from above, frame after frame.

    Args:
        path: The GIF file.
        sequence: The tracked sequence; its poses give the sensor's places, its detections are drawn as crosses.
        tracks: The tracks in the world frame.
        truth: Annotations in the world frame, drawn grey below the tracks; hardly visible ones are left out.

    Raises:
        ClientError: matplotlib is not installed.
    """
    with matplotlib_needed():
        from PIL import Image  # noqa: PLC0415  an extra
    step = -(-len(sequence) // FRAMES)
    given = [frame for frame in sequence.frames() if frame.index % step == 0]
    if not given:
        raise ClientError(f"sequence {sequence.name}: expected frames to draw, received none")
    view = _View(sequence, tracks, None if truth is None else truth.take(~truth.ignored), given)
    pictures = [Image.fromarray(view.drawn(frame)) for frame in given]
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette())
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=others, duration=_durations_ms(given), loop=0, optimize=True)


def _palette() -> list[int]:
    """Return one palette for all frames, whose still parts are then stored once: tracks, ground, and their mixtures."""
    from matplotlib.colors import to_rgb  # noqa: PLC0415  an extra

    ground, tracks = (np.array([to_rgb(one) for one in colours]) for colours in ({*_GROUND.values()}, COLOURS))
    road = np.array(to_rgb(_GROUND["road"]))
    greys = np.linspace(float(np.array(to_rgb(_INK))[0]), 1.0, 12)[:, None] * np.ones(3)
    mixed = [share * tracks + (1.0 - share) * road for share in (1.0, 0.75, 0.5, 0.25)]
    return [round(255.0 * value) for value in np.vstack([greys, np.sort(ground, axis=0), *mixed]).ravel().tolist()]


def _durations_ms(given: list[DetectionFrame]) -> list[int]:
    """Return how long each picture is shown; the last one a second, before it begins again. GIF counts hundredths."""
    stamps = np.array([frame.stamp_ns for frame in given], dtype=np.int64)
    return [*np.clip(np.diff(stamps) // 10_000_000 * 10, 20, 2000).tolist(), 1000]


class _View:
    """A figure of one frame at a time."""

    def __init__(
        self, sequence: DataSequence, tracks: ResultTable, truth: Truth | None, given: list[DetectionFrame]
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  an extra
        from matplotlib.figure import Figure  # noqa: PLC0415  an extra

        self._sequence, self._tracks, self._truth = sequence, tracks, truth
        self._begin_ns = given[0].stamp_ns
        period_s = (given[-1].stamp_ns - self._begin_ns) * 1e-9 / max(1, given[-1].index - given[0].index)
        self._trail = round(TRAIL_S / period_s) if period_s > 0.0 else 1
        _, self._sensor = stack_poses(sequence.poses)
        places = tracks.center if len(tracks) else self._sensor
        low, high = np.quantile(places[:, :2], INSIDE, axis=0)
        ground = [outline for kind, outline in sequence.areas if kind == "road"]
        if ground and (np.ptp(np.vstack(ground), axis=0) < WIDEST_M).all():
            low, high = np.vstack([low[None], *ground]).min(axis=0), np.vstack([high[None], *ground]).max(axis=0)
        lack = np.maximum(NARROWEST_M - (high - low), 0.0)
        low, high = low - MARGIN_M - 0.5 * lack, high + MARGIN_M + 0.5 * lack
        self._follows = bool((high - low).max() > WIDEST_M)
        if self._follows:
            low, high = np.array([-REACH_M, -0.6 * REACH_M]), np.array([REACH_M, 0.6 * REACH_M])
        wide, tall = (high - low).tolist()
        share = min(max(tall / wide, HEIGHTS[0]), HEIGHTS[1])
        more = np.maximum((tall / share - wide, share * wide - tall), 0.0)
        self._low, self._high = low - 0.5 * more, high + 0.5 * more
        across = WIDTH_PX / 100 - LEGEND
        figure = Figure(figsize=(WIDTH_PX / 100, share * across), dpi=100)
        self._canvas: Any = FigureCanvasAgg(figure)  # two of its methods have no annotations
        self._axes: Axes = figure.add_axes((0.0, 0.0, across / (across + LEGEND), 1.0))
        self._time = figure.text(1.0 - LEGEND / (across + LEGEND) + 0.025, 0.95, "", fontsize=16, va="top", color=_INK)
        self._legend(figure)

    def drawn(self, frame: DetectionFrame) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]":
        """Return the picture of a frame, (height, width, 3)."""
        axes, sensor = self._axes, self._sensor[frame.index, :2]
        axes.clear()
        axes.set_axis_off()
        origin = sensor if self._follows else np.zeros(2)
        axes.set_xlim(self._low[0] + origin[0], self._high[0] + origin[0])
        axes.set_ylim(self._low[1] + origin[1], self._high[1] + origin[1])
        _draw_ground(axes, self._sequence)
        self._draw_truth(frame.index)
        center, _ = to_world(rotation_of(frame.pose.quaternion), frame.pose.translation, frame.center, frame.yaw)
        axes.plot(*center[:, :2].T, "+", color=_DETECTION, markersize=5, markeredgewidth=1.0, zorder=6)
        self._draw_tracks(frame)
        if self._sensor.any():
            axes.plot(*sensor, "^", color=_INK, markersize=7, zorder=7)
        seconds = (frame.stamp_ns - self._begin_ns) * 1e-9
        self._time.set_text(f"{seconds:.1f} s")
        left, bottom = self._low + origin + 0.03 * (self._high - self._low)
        axes.plot([left, left + SCALE_M], [bottom, bottom], color=_INK, linewidth=1.5)
        axes.text(left, bottom, f"{SCALE_M:.0f} m", fontsize=9, va="bottom", color=_INK)
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[:, :, :3]

    def _draw_truth(self, frame: int) -> None:
        from matplotlib.collections import PolyCollection  # noqa: PLC0415  an extra

        if self._truth is not None:
            rows = np.flatnonzero(self._truth.frame == frame)
            outlines = _outlines(self._truth, rows)
            self._axes.add_collection(PolyCollection(outlines, facecolors=_SHADE, edgecolors=_SHADE, zorder=2))

    def _draw_tracks(self, frame: DetectionFrame) -> None:
        from matplotlib.collections import LineCollection, PolyCollection  # noqa: PLC0415  an extra
        from matplotlib.patheffects import Normal, Stroke  # noqa: PLC0415  an extra

        tracks = self._tracks
        rows = np.flatnonzero(tracks.frame == frame.index)
        colours = [colour_of(int(identity)) for identity in tracks.id[rows]]
        outlines = _outlines(tracks, rows)
        fronts = [np.stack([box.mean(axis=0), 0.5 * (box[0] + box[1])]) for box in outlines]
        since = frame.index - self._trail
        recent = np.flatnonzero((tracks.frame > since) & (tracks.frame <= frame.index))
        trails = [tracks.center[recent[tracks.id[recent] == identity], :2] for identity in tracks.id[rows]]
        self._axes.add_collection(LineCollection(trails, colors=colours, linewidths=2.2, zorder=4))
        self._axes.add_collection(
            PolyCollection(outlines, facecolors=colours, edgecolors=_INK, linewidths=0.6, zorder=5)
        )
        self._axes.add_collection(LineCollection(fronts, colors="#FFFFFF", linewidths=1.2, zorder=5))
        for place, identity in zip(tracks.center[rows], tracks.id[rows].tolist(), strict=True):
            self._axes.annotate(
                str(identity),
                (float(place[0]), float(place[1])),
                xytext=(6, 5),
                textcoords="offset points",
                color=_INK,
                fontsize=10,
                fontweight="bold",
                path_effects=[Stroke(linewidth=2.5, foreground="#FFFFFF"), Normal()],
                annotation_clip=True,
                zorder=8,
            )

    def _legend(self, figure: "Figure") -> None:
        from matplotlib.lines import Line2D  # noqa: PLC0415  an extra

        colour, path = colour_of(0), f"track, path of {TRAIL_S:.0f} s"
        handles = [
            Line2D([], [], label="detection", marker="+", linestyle="", color=_DETECTION, markersize=6),
            Line2D([], [], label="truth", marker="s", linestyle="", color=_SHADE, markersize=9),
            Line2D([], [], label=path, marker="s", color=colour, linewidth=2.2, markersize=9),
            Line2D([], [], label="id of the track", marker="$7$", linestyle="", color=_INK, markersize=8),
            Line2D([], [], label="sensor", marker="^", linestyle="", color=_INK, markersize=7),
        ]
        drawn = (True, self._truth is not None, True, True, bool(self._sensor.any()))
        handles = [handle for handle, one in zip(handles, drawn, strict=True) if one]
        place = 1.0 - LEGEND * 100 / WIDTH_PX, 0.82
        figure.legend(handles=handles, loc="upper left", bbox_to_anchor=place, frameon=False, fontsize=10)


def _outlines(boxes: "Truth | ResultTable", rows: Ints) -> list[Floats]:
    """Return the corners (4, 2) of boxes from above, the front ones first."""
    return list(box_corners(boxes.center[rows], boxes.size[rows], boxes.yaw[rows])[:, :4, :2])


def draw_results(
    picture: Path,
    sequence: DataSequence,
    folders: Sequence[Path],
    results: "Sequence[Sequence[ClassResult]]",
    score: float | None = None,
    *,
    every: bool = False,
) -> None:
    """Draw the result files of a sequence from above.

    Args:
        picture: The PNG file, or the GIF file of a moving picture of the first tracker.
        sequence: The tracked sequence.
        folders: Where its result files are, or tables of tracks: one for each tracker.
        results: Figures of the classes of each tracker; their misses and identity changes are marked.
        score: Least mean score of the tracks that are shown; default: confirmed tracks; where the files do not tell,
            those from the best threshold of each class by `results` on.
        every: Whether to draw all tracks.

    Raises:
        DatasetError: There is no such result file, or it is wrong.
        ClientError: matplotlib is not installed.
    """
    from optipmb_tools.evaluation.tracks import read_tracks  # noqa: PLC0415  loads the solvers of scipy

    names = [folder.name for folder in folders]
    if len(set(names)) < len(names):
        names = [str(folder) for folder in folders]
    panels = []
    for folder, name, own in zip(folders, names, results, strict=True):
        table = read_tracks(folder, sequence).to_world(sequence.poses)
        others = None
        best = [result.sweep.results[result.sweep.best] for result in own]
        if every:
            best = [result.total for result in own]
        elif score is None and table.confirmed is not None:
            others = table.take(~table.confirmed)
            table, best = table.shown, [result.shown for result in own]
        else:
            table = _from_score(table, own, score)
        panels.append(Panel(table, best, name if len(names) > 1 else "", others))
    if picture.suffix == ".gif":
        animate_tracks(picture, sequence, panels[0].tracks, sequence.truth())
    else:
        draw_tracks(picture, sequence, panels, sequence.truth())


def _from_score(table: ResultTable, results: "Sequence[ClassResult]", score: float | None) -> ResultTable:
    """Return the tracks whose mean score reaches the threshold of their class."""
    if not len(table):
        return table
    best = {result.name: result.sweep.thresholds[result.sweep.best] for result in results}
    least = np.array([score if score is not None else best.get(label, 0.0) for label in table.labels])
    return table.take(np.asarray(ranks(table.id, table.score) >= least[table.label], dtype=np.bool_))
