"""Variants of the tracker, each measured on the same data: the paper's ablation (Section V.C) and parameter sweeps.

All classes are tracked together, as in use. Frames per second are those of the tracker's steps, for frames that are in
memory: neither reading nor detecting is in them.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

from optipmb import Modules, Parameters, warm_up
from optipmb_client.tuning.figures import Figures
from optipmb_client.tuning.material import track_clip
from optipmb_client.tuning.run import Source
from optipmb_client.tuning.scoring import Scorer, scorer_of
from optipmb_client.tuning.values import with_values

__all__ = ["ROWS", "Row", "Variant", "ablation", "measure_variants", "sweep"]

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
class Variant:
    """A tracker to measure."""

    parameters: Parameters
    modules: Modules


@dataclass(frozen=True)
class Row:
    """Figures of a variant."""

    variant: Variant
    classes: dict[str, Figures]
    overall: Figures
    """Means over the classes; counts are sums."""
    frames_per_second: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "frames_per_second": self.frames_per_second,
            "overall": self.overall.to_json(),
            "classes": {name: figures.to_json() for name, figures in self.classes.items()},
        }


def ablation(parameters: Parameters) -> list[Variant]:
    """Return the sixteen choices of modules, all with the same parameters."""
    return [Variant(parameters, Modules(**{name: name in on for name in (_ADP, _HABM, _RPP, _OTE)})) for on in ROWS]


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


def measure_variants(source: Source, variants: Sequence[Variant], on_clip: Callable[[int], None]) -> Iterator[Row]:
    """Track everything once with each variant; yield its row when it is done.

    Args:
        source: the data; its classes are reported, all classes of the parameters are tracked.
        variants: with the classes of the source's clips.
        on_clip: called with the frames of each clip of each variant when it is tracked.

    """
    scorers = [scorer_of(source.dataset, name, source.sequences) for name in source.classes]
    warm_up()
    for variant in variants:
        yield _row(source, variant, scorers, on_clip)


def _row(source: Source, variant: Variant, scorers: Sequence[Scorer], on_clip: Callable[[int], None]) -> Row:
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
    return Row(variant, figures, _overall(list(figures.values())), frames / seconds if seconds else math.nan)


def _overall(figures: Sequence[Figures]) -> Figures:
    values = {}
    for item in fields(Figures):
        known = [value for one in figures if math.isfinite(value := getattr(one, item.name))]
        total = math.fsum(known)
        values[item.name] = total if item.name in _SUMMED else total / len(known) if known else math.nan
    return Figures(**values)
