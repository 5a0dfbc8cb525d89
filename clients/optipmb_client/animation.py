"""Moving pictures of a sequence from above, as GIF files.

Conventions: world frame, metres, x to the right and y up; one second of the picture is one second of the sequence.
Colours belong to track ids, as in `pictures`. matplotlib and Pillow, which it brings, are an extra of the installation.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from optipmb_schemas.installation import install_command

from optipmb_client.colours import colour_of
from optipmb_client.datasets import DataSequence, DetectionFrame, Truth
from optipmb_client.errors import ClientError
from optipmb_client.geometry import Floats, Ints, box_corners, rotation_of, stack_poses, to_world
from optipmb_client.results import ResultTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FRAMES: Final = 70  # of a longer sequence every second frame is drawn, or every third …
TRAIL_S: Final = 3.0
REACH_M: Final = 45.0  # on each side of the sensor, where the picture follows it
WIDEST_M: Final = 140.0  # what is wider than this does not fit one view: the picture follows the sensor
INSIDE: Final = (0.03, 0.97)  # the view is as wide as these quantiles of the places of tracks, and
MARGIN_M: Final = 4.0
NARROWEST_M: Final = 30.0
SCALE_M: Final = 10.0
WIDTH_PX: Final = 560
COLOURS: Final = 16
WHITE: Final = 250
_INK, _TRUTH, _DETECTION = "#222222", "#C4C4C4", "#5A5A5A"


def animate_tracks(path: Path, sequence: DataSequence, tracks: ResultTable, truth: Truth | None = None) -> None:
    """Draw the tracks of a sequence from above, frame after frame.

    Args:
        path: the GIF file.
        sequence: what was tracked; its poses give the sensor's places, its detections are drawn as crosses.
        tracks: the tracks in the world frame.
        truth: annotations in the world frame, drawn grey below the tracks; hardly visible ones are left out.

    Raises:
        ClientError: matplotlib is not installed.
    """
    try:
        from PIL import Image  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ClientError(f"pictures need matplotlib, which is not installed: {install_command('plot')}") from error
    step = -(-len(sequence) // FRAMES)
    given = [frame for frame in sequence.frames() if frame.index % step == 0]
    if not given:
        raise ClientError(f"sequence {sequence.name}: expected frames to draw, received none")
    view = _View(sequence, tracks, None if truth is None else truth.take(~truth.ignored), given)
    pictures = [Image.fromarray(view.drawn(frame)) for frame in given]
    # One palette for all frames: what does not move has the same bytes in each, and is stored once.
    sample = Image.new("RGB", (pictures[0].width, 3 * pictures[0].height))
    for place, chosen in enumerate((pictures[0], pictures[len(pictures) // 2], pictures[-1])):
        sample.paste(chosen, (0, place * chosen.height))
    found = sample.quantize(COLOURS, dither=Image.Dither.NONE).getpalette() or []
    shades = np.array(found, dtype=np.int64).reshape(-1, 3)
    shades[shades.min(axis=1) >= WHITE] = 255  # the ground; an entry beside white would take its place
    palette = Image.new("P", (1, 1))
    palette.putpalette(shades.ravel().tolist())
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=others, duration=_durations_ms(given), loop=0, optimize=True)


def _durations_ms(given: list[DetectionFrame]) -> list[int]:
    """Return how long each picture is shown; the last one a second, before it begins again. GIF counts hundredths."""
    stamps = np.array([frame.stamp_ns for frame in given], dtype=np.int64)
    return [*np.clip(np.diff(stamps) // 10_000_000 * 10, 20, 2000).tolist(), 1000]


class _View:
    """A figure of one frame at a time."""

    def __init__(
        self, sequence: DataSequence, tracks: ResultTable, truth: Truth | None, given: list[DetectionFrame]
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - matplotlib is an extra
        from matplotlib.figure import Figure  # noqa: PLC0415 - matplotlib is an extra

        self._tracks, self._truth = tracks, truth
        self._begin_ns = given[0].stamp_ns
        period_s = (given[-1].stamp_ns - self._begin_ns) * 1e-9 / max(1, given[-1].index - given[0].index)
        self._trail = round(TRAIL_S / period_s) if period_s > 0.0 else 1
        _, self._sensor = stack_poses(sequence.poses)
        places = tracks.center if len(tracks) else self._sensor
        low, high = np.quantile(places[:, :2], INSIDE, axis=0)
        lack = np.maximum(NARROWEST_M - (high - low), 0.0)
        low, high = low - MARGIN_M - 0.5 * lack, high + MARGIN_M + 0.5 * lack
        self._follows = bool((high - low).max() > WIDEST_M)
        if self._follows:
            low, high = np.array([-REACH_M, -0.6 * REACH_M]), np.array([REACH_M, 0.6 * REACH_M])
        wide, tall = high - low
        figure = Figure(figsize=(WIDTH_PX / 100, WIDTH_PX / 100 * tall / wide + 0.3), dpi=100)
        self._canvas: Any = FigureCanvasAgg(figure)  # two of its methods have no annotations
        share = 0.3 / figure.get_figheight()
        self._axes: Axes = figure.add_axes((0.0, share, 1.0, 1.0 - share))
        self._low, self._high = low, high
        self._legend(figure)

    def drawn(self, frame: DetectionFrame) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]":
        """Return the picture of a frame, (height, width, 3)."""
        axes, sensor = self._axes, self._sensor[frame.index, :2]
        axes.clear()
        axes.set_axis_off()
        origin = sensor if self._follows else np.zeros(2)
        axes.set_xlim(self._low[0] + origin[0], self._high[0] + origin[0])
        axes.set_ylim(self._low[1] + origin[1], self._high[1] + origin[1])
        self._draw_truth(frame.index)
        center, _ = to_world(rotation_of(frame.pose.quaternion), frame.pose.translation, frame.center, frame.yaw)
        axes.plot(*center[:, :2].T, "+", color=_DETECTION, markersize=4, markeredgewidth=0.8, zorder=6)
        self._draw_tracks(frame)
        axes.plot(*sensor, "^", color=_INK, markersize=7, zorder=7)
        seconds = (frame.stamp_ns - self._begin_ns) * 1e-9
        axes.text(0.012, 0.975, f"{seconds:.1f} s", transform=axes.transAxes, fontsize=12, va="top", color=_INK)
        left, bottom = self._low + origin + 0.03 * (self._high - self._low)
        axes.plot([left, left + SCALE_M], [bottom, bottom], color=_INK, linewidth=1.5)
        axes.text(left, bottom, f"{SCALE_M:.0f} m", fontsize=9, va="bottom", color=_INK)
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[:, :, :3]

    def _draw_truth(self, frame: int) -> None:
        from matplotlib.collections import PolyCollection  # noqa: PLC0415 - matplotlib is an extra

        if self._truth is not None:
            rows = np.flatnonzero(self._truth.frame == frame)
            outlines = _outlines(self._truth, rows)
            self._axes.add_collection(PolyCollection(outlines, facecolors=_TRUTH, edgecolors=_TRUTH, zorder=2))

    def _draw_tracks(self, frame: DetectionFrame) -> None:
        from matplotlib.collections import LineCollection, PolyCollection  # noqa: PLC0415 - matplotlib is an extra

        tracks = self._tracks
        rows = np.flatnonzero(tracks.frame == frame.index)
        colours = [colour_of(int(identity)) for identity in tracks.id[rows]]
        outlines = _outlines(tracks, rows)
        fronts = [np.stack([box.mean(axis=0), 0.5 * (box[0] + box[1])]) for box in outlines]
        since = frame.index - self._trail
        recent = np.flatnonzero((tracks.frame > since) & (tracks.frame <= frame.index))
        trails = [tracks.center[recent[tracks.id[recent] == identity], :2] for identity in tracks.id[rows]]
        self._axes.add_collection(LineCollection(trails, colors=colours, linewidths=1.6, zorder=4))
        faces = [f"{colour}66" for colour in colours]
        self._axes.add_collection(
            PolyCollection(outlines, facecolors=faces, edgecolors=colours, linewidths=1.2, zorder=5)
        )
        self._axes.add_collection(LineCollection(fronts, colors=colours, linewidths=1.2, zorder=5))
        for place, identity, colour in zip(tracks.center[rows], tracks.id[rows].tolist(), colours, strict=True):
            self._axes.annotate(
                str(identity),
                (float(place[0]), float(place[1])),
                xytext=(6, 5),
                textcoords="offset points",
                color=colour,
                fontsize=8,
                annotation_clip=True,
                zorder=8,
            )

    def _legend(self, figure: "Figure") -> None:
        from matplotlib.lines import Line2D  # noqa: PLC0415 - matplotlib is an extra

        colour, path = colour_of(0), f"track: box, id, path of {TRAIL_S:.0f} s"
        handles = [
            Line2D([], [], label="detection", marker="+", linestyle="", color=_DETECTION, markersize=6),
            Line2D([], [], label="truth", marker="s", linestyle="", color=_TRUTH, markersize=8),
            Line2D([], [], label=path, marker="s", color=colour, markerfacecolor=f"{colour}66"),
            Line2D([], [], label="sensor", marker="^", linestyle="", color=_INK, markersize=7),
        ]
        if self._truth is None:
            del handles[1]
        figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=9)


def _outlines(boxes: "Truth | ResultTable", rows: Ints) -> list[Floats]:
    """Return the corners (4, 2) of boxes from above, the front ones first."""
    return list(box_corners(boxes.center[rows], boxes.size[rows], boxes.yaw[rows])[:, :4, :2])
