"""Picture of the first seconds of data, from above: boxes, headings and moves, before anything is tracked."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb_tools.files import write_whole
from optipmb_tools.geometry import box_corners, stack_poses, to_world
from optipmb_tools.views.pictures import matplotlib_needed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optipmb_tools.datasets.interface import DetectionFrame
    from optipmb_tools.geometry import Floats

SECONDS: Final = 3.0
MOST_FRAMES: Final = 60
_POINT: Final = 0.6  # m, length and width that stand for a box without a size
_ARROW: Final = 2.5  # m, least length of the arrow of a heading


def draw_first_seconds(path: Path, name: str, frames: "Iterable[DetectionFrame]") -> None:
    """Draw the last boxes of the first seconds, arrows along their headings, and the places of boxes before them.

    x points to the right and y up, as in the world. The file appears complete, or not at all.

    Raises:
        ClientError: matplotlib is not installed.
    """
    with matplotlib_needed():
        from matplotlib.figure import Figure  # noqa: PLC0415  an extra
    shown: list[tuple[Floats, Floats, Floats, float]] = []
    for frame in frames:
        seconds = frame.stamp_ns / 1e9
        if len(shown) == MOST_FRAMES or (shown and seconds - shown[0][3] > SECONDS):
            break
        rotation, translation = stack_poses([frame.pose])
        center, yaw = to_world(rotation[0], translation[0], np.nan_to_num(frame.center), frame.yaw)
        shown.append((center, np.nan_to_num(frame.size, nan=_POINT), yaw, seconds))
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    axes = figure.subplots()
    for age, (center, _, _, _) in enumerate(reversed(shown)):
        axes.plot(*center[:, :2].T, ".", color="#0072B2", alpha=1.0 - 0.8 * age / len(shown), ms=3)
    for center, size, yaw, _ in shown[-1:]:
        corners = box_corners(center, size, np.nan_to_num(yaw))[:, :, :2]
        for box in corners:
            around = box[np.argsort(np.arctan2(*(box - box.mean(axis=0)).T))]
            axes.fill(*around.T, fill=False, color="#D55E00", lw=0.8)
        known = np.isfinite(yaw)
        along = np.maximum(0.8 * size[:, :1], _ARROW) * np.column_stack([np.cos(yaw), np.sin(yaw)])
        axes.quiver(
            *center[known, :2].T,
            *along[known].T,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            color="#D55E00",
            width=0.002,
        )
    passed = shown[-1][3] - shown[0][3] if shown else 0.0
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"{name}: the first {passed:.1f} s")
    axes.annotate("dots: places, later ones darker; arrows: headings", (0.01, 0.01), xycoords="axes fraction")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content.getvalue())
