"""Picture of several trackers side by side: bars of the figures of each class."""

import io
from collections.abc import Mapping
from pathlib import Path

from optipmb_tools.files import write_whole
from optipmb_tools.views.pictures import matplotlib_needed

_WIDTH = 0.8  # of all bars of a figure


def draw_comparison(
    path: Path,
    classes: Mapping[str, Mapping[str, Mapping[str, float | None]]],
    switches: Mapping[str, Mapping[str, float | None]],
) -> None:
    """Draw shares by class, tracker and name of the figure, and identity switches by class and tracker.

    The file appears complete, or not at all.

    Raises:
        ClientError: matplotlib is not installed.
    """
    with matplotlib_needed():
        from matplotlib.figure import Figure  # noqa: PLC0415  an extra
    figure = Figure(figsize=(10.0, 2.6 * len(classes)), layout="constrained")
    grid = figure.subplots(len(classes), 2, squeeze=False, width_ratios=(5, 1))
    for (axes, counts), (name, trackers) in zip(grid, classes.items(), strict=True):
        names = list(dict.fromkeys(one for values in trackers.values() for one in values))
        width = _WIDTH / len(trackers)
        for place, (tracker, values) in enumerate(trackers.items()):
            left = [at - 0.5 * _WIDTH + (place + 0.5) * width for at in range(len(names))]
            axes.bar(left, [100.0 * (values.get(one) or 0.0) for one in names], width, label=tracker)
        axes.set_xticks(range(len(names)), names)
        axes.set_ylabel(f"{name}, %")
        for place, tracker in enumerate(trackers):
            count = switches[name].get(tracker)
            bar = counts.bar(place, count or 0, _WIDTH)
            counts.bar_label(bar, ["-" if count is None else f"{count:g}"], fontsize="small")
        counts.set(xticks=[], xlim=(-0.5, len(trackers) - 0.5), ylabel="identity switches")
        counts.set_ylim(0, max(1.0, 1.2 * max((one or 0.0) for one in switches[name].values())))
        counts.yaxis.get_major_locator().set_params(integer=True)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content.getvalue())
