"""What each module of the tracker is worth: the sixteen rows of the paper's ablation (Section V.C) on any dataset.

All classes are tracked together, as in use. Frames per second are those of the tracker's steps, for frames that are in
memory: neither reading nor detecting is in them.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

from optipmb import Modules, Parameters, warm_up
from optipmb_client.datasets import DataSequence
from optipmb_client.tuning.figures import Figures
from optipmb_client.tuning.material import Clip, track_clip
from optipmb_client.tuning.scoring import Scorer, scorer_of

__all__ = ["ROWS", "Row", "ablate"]

_ADP, _HABM, _RPP, _OTE = "adp", "habm", "rpp", "ote"
ROWS: tuple[frozenset[str], ...] = tuple(
    frozenset(row)
    for row in (
        (),
        (_ADP,),
        (_RPP,),
        (_OTE,),
        (_HABM,),
        (_ADP, _RPP),
        (_RPP, _OTE),
        (_ADP, _OTE),
        (_ADP, _HABM),
        (_HABM, _RPP),
        (_HABM, _OTE),
        (_ADP, _RPP, _OTE),
        (_ADP, _HABM, _RPP),
        (_HABM, _RPP, _OTE),
        (_ADP, _HABM, _OTE),
        (_ADP, _HABM, _RPP, _OTE),
    )
)
"""The modules that are on, in the order of the paper's table."""
_SUMMED = ("ids", "frag", "fp", "fn", "gt")


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    modules: Modules
    classes: dict[str, Figures]
    overall: Figures
    """Means over the classes; counts are sums."""
    frames_per_second: float

    def to_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {
            "modules": {name: getattr(self.modules, name) for name in (_ADP, _HABM, _RPP, _OTE)},
            "frames_per_second": self.frames_per_second,
            "overall": self.overall.to_json(),
            "classes": {name: figures.to_json() for name, figures in self.classes.items()},
        }


def ablate(
    dataset: str,
    sequences: Sequence[DataSequence],
    clips: Sequence[Clip],
    parameters: Parameters,
    classes: Sequence[str],
    on_clip: Callable[[], None] = lambda: None,
) -> Iterator[Row]:
    """Track everything once for each row; yield each row when it is done.

    Args:
        dataset: its name.
        sequences: of the dataset.
        clips: the same sequences with all classes of the parameters.
        parameters: the same for all rows.
        classes: those that are reported; all are tracked.
        on_clip: called after each clip of each row.

    """
    scorers = [scorer_of(dataset, name, sequences) for name in classes]
    warm_up()
    for on in ROWS:
        modules = Modules(**{name: name in on for name in (_ADP, _HABM, _RPP, _OTE)})
        yield _row(clips, parameters, modules, scorers, on_clip)


def _row(
    clips: Sequence[Clip],
    parameters: Parameters,
    modules: Modules,
    scorers: Sequence[Scorer],
    on_clip: Callable[[], None],
) -> Row:
    seconds, frames = 0.0, 0
    measured: dict[str, list[Any]] = {scorer.name: [] for scorer in scorers}
    for clip in clips:
        begun = time.perf_counter()
        tracks = track_clip(clip, parameters, modules, every_frame=True)
        seconds += time.perf_counter() - begun
        frames += len(clip.frames)
        for scorer in scorers:
            measured[scorer.name].append(scorer.measure(clip, tracks))
        on_clip()
    figures = {scorer.name: scorer.figures(measured[scorer.name]) for scorer in scorers}
    return Row(modules, figures, _overall(list(figures.values())), frames / seconds if seconds else math.nan)


def _overall(figures: Sequence[Figures]) -> Figures:
    values = {}
    for item in fields(Figures):
        known = [value for one in figures if math.isfinite(value := getattr(one, item.name))]
        total = math.fsum(known)
        values[item.name] = total if item.name in _SUMMED else total / len(known) if known else math.nan
    return Figures(**values)
