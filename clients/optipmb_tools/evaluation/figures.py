"""Table of the evaluation figures: their column titles, how they are printed, and how classes are summed up.

`optipmb evaluate`, `tune`, `sweep` and `ablate` take all of this from `FIGURES`. A figure that is not defined is NaN in
computations, None in JSON and a dash in tables.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

__all__ = ["FIGURES", "Figure", "cell", "defined", "overall", "ratio"]

Kind = Literal["share", "count", "metres", "match", "plain"]
"""Unit of a figure; `match` is the mean similarity of matched boxes: an overlap, or a distance in metres."""


class Figure(NamedTuple):
    """One evaluation figure."""

    title: str  # title of its column
    kind: Kind
    summed: bool = False  # over several classes it is the sum; otherwise the mean of the classes that have it


def _named(kind: Kind, *names: str, summed: bool = False) -> dict[str, Figure]:
    return {name: Figure(name, kind, summed) for name in names}


FIGURES: Mapping[str, Figure] = {
    **_named("share", "sAMOTA", "AMOTA", "MOTA", "precision", "recall", "MT", "ML"),
    **_named("match", "AMOTP", "MOTP"),
    **_named("count", "GT", "TP", "FP", "FN", "IDS", "FRAG", summed=True),
    **_named("share", "HOTA", "DetA", "AssA", "LocA", "IDF1", "HOTA, all"),
    **_named("metres", "GOSPA", "localisation", "missed", "false", "OSPA"),
    **_named("plain", "score", "threshold", "NEES"),
    # The benchmark of nuScenes, by its own names.
    "amota": Figure("AMOTA", "share"),
    "amotp": Figure("AMOTP m", "metres"),
    "mota": Figure("MOTA", "share"),
    "motp": Figure("MOTP m", "metres"),
    "gt": Figure("GT", "count"),  # the benchmark averages it
    **{name: Figure(name.upper(), "count", summed=True) for name in ("tp", "fp", "fn", "ids", "frag", "mt", "ml")},
    # Calibration and errors of boxes.
    "samples": Figure("boxes", "count"),
    "objects": Figure("objects", "count"),
    "coverage": Figure("in 95 %", "share"),
    "error": Figure("error m", "metres"),
    "expected_error": Figure("expected m", "metres"),
    "velocity_error": Figure("velocity m/s", "plain"),
    "backward": Figure("backward", "share"),
    "predicted": Figure("predicted", "share"),
    "observed": Figure("observed", "share"),
    **_named("plain", "along", "across", "height", "heading", "length", "width", "tall"),
}
"""By their names in JSON."""


def defined(value: float) -> float | None:
    """Return a figure, or None if it is not defined."""
    return value if math.isfinite(value) else None


def ratio(part: float, whole: float) -> float:
    """Return part / whole, NaN for a whole of zero."""
    return part / whole if whole else math.nan


def overall(classes: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the figures of several classes together."""
    total = {}
    for name in classes[0] if classes else ():
        known = [one[name] for one in classes if math.isfinite(one[name])]
        figure = FIGURES.get(name)
        if figure is not None and figure.summed:
            total[name] = math.fsum(known)
        else:
            total[name] = math.fsum(known) / len(known) if known else math.nan
    return total


def cell(name: str, value: float | None, *, metres: bool = False) -> str:
    """Return a figure as tables print it: shares in percent; `metres`: matches are distances."""
    kind = FIGURES[name].kind
    if value is None or math.isnan(value):
        return "-"
    if kind == "count":
        return f"{value:.0f}"
    return f"{100.0 * value:.2f}" if kind == "share" or (kind == "match" and not metres) else f"{value:.3f}"
