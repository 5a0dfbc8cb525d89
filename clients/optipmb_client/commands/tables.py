"""The tables of `optipmb evaluate`.

Shares are printed in percent, distances in metres; a dash stands for a figure that is not defined.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from optipmb_client.evaluation import ClassResult
    from optipmb_client.evaluation.figures import ClassFigures
    from optipmb_client.evaluation.nuscenes import NuScenesScores

_CLEAR = ("MOTA", "MOTP", "precision", "recall", "GT", "FP", "FN", "IDS", "FRAG")
_PROTOCOL = ("sAMOTA", "AMOTA", "AMOTP", "score", "MOTA", "MOTP", "recall", "precision", "IDS", "FRAG", "FP", "FN")
_SHARES = ("MT", "ML")
_PLAIN = frozenset({"score"})
_NUSCENES = {
    "amota": "AMOTA",
    "amotp": "AMOTP m",
    "recall": "recall",
    "mota": "MOTA",
    "motp": "MOTP m",
    "gt": "GT",
    "tp": "TP",
    "fp": "FP",
    "fn": "FN",
    "ids": "IDS",
    "frag": "FRAG",
}
_METRES = frozenset({"amotp", "motp"})
_COUNTS = frozenset({"gt", "tp", "fp", "fn", "ids", "frag"})
SCORE = "score ≥"
_HOTA = ("HOTA", "DetA", "AssA")
_DIRECTIONS = ("along", "across", "height", "heading", "length", "width", "tall")
_GOSPA = ("GOSPA", "localisation", "missed", "false", "OSPA")


def clear_table(results: "Sequence[ClassResult]", *, metres: bool) -> RenderableType:
    """Return the CLEAR MOT figures; MOTP is in metres or in percent."""
    table = _empty(("class", SCORE, *_CLEAR))
    for result in results:
        best = result.sweep.best
        for name, threshold, figures in (
            (result.name, "all", result.total.summary()),
            ("", f"{result.sweep.thresholds[best]:.3f}", result.sweep.results[best].summary()),
        ):
            plain = {"MOTP"} if metres else set()
            table.add_row(name, threshold, *(_shown(figures[column], column in plain) for column in _CLEAR))
    return table


def nuscenes_table(scores: "NuScenesScores", names: Sequence[str]) -> RenderableType:
    """Return the figures of the benchmark of nuScenes, of some classes and overall; AMOTP and MOTP are in metres."""
    table = _empty(("class", *(_NUSCENES[name] for name in _NUSCENES)))
    rows = {name: one.to_json() for name, one in scores.classes.items() if name in names}
    for name, values in {**rows, "overall": scores.to_json()["overall"]}.items():
        shown = (_counted(values[key]) if key in _COUNTS else _shown(values[key], key in _METRES) for key in _NUSCENES)
        table.add_row(name, *shown)
    return _titled(
        "The benchmark of nuScenes: averages over 40 recalls, then the threshold with the highest MOTA", table
    )


def figure_tables(
    figures: "Sequence[ClassFigures]", cutoff: float, average: "Mapping[str, Mapping[str, float | None]] | None" = None
) -> Iterator[RenderableType]:
    """Yield the tables of all other figures that there are, with HOTA's average over classes where it is given."""
    if any(one.ab3dmot for one in figures):
        yield _titled(
            "AB3DMOT's protocol: averages over 40 recall points, then the threshold with the highest MOTA",
            _protocol(figures),
        )
    yield _titled(
        f"All tracks, and those from that score on: HOTA in percent; means over frames in metres, cut-off {cutoff:g} m",
        _sets(figures, average or {}),
    )
    if any(one.calibration for one in figures):
        yield _titled(
            "Errors of positions against their covariances: the NEES of a consistent tracker is 2", _nees(figures)
        )
        yield from _errors(figures)
        yield _titled(
            "Existence probability against the share of tracks that are objects, by tenths", _reliability(figures)
        )


def comparison_tables(trackers: "Mapping[str, Sequence[ClassFigures]]") -> Iterator[RenderableType]:
    """Yield a table for each class with the figures of several trackers, all their tracks counted."""
    for name in dict.fromkeys(one.name for figures in trackers.values() for one in figures):
        table = _empty(("tracks", *_HOTA, "LocA", *_GOSPA))
        for place, figures in trackers.items():
            for one in (one.everything for one in figures if one.name == name):
                table.add_row(
                    place,
                    *(_shown(one.hota.summary()[column]) for column in (*_HOTA, "LocA")),
                    *(_shown(one.gospa.summary()[column], plain=True) for column in _GOSPA),
                )
        yield _titled(f"{name}: HOTA of centres in percent; GOSPA and OSPA in metres", table)


def _protocol(figures: "Sequence[ClassFigures]") -> Table:
    table = _empty(("class", "IoU", *_PROTOCOL, *_SHARES))
    for one in figures:
        for place, result in enumerate(one.ab3dmot):
            values = result.summary()
            table.add_row(
                "" if place else one.name,
                f"{result.limit:g}",
                *(_shown(values[name], name in _PLAIN) for name in (*_PROTOCOL, *_SHARES)),
            )
    return table


def _sets(figures: "Sequence[ClassFigures]", average: "Mapping[str, Mapping[str, float | None]]") -> Table:
    image = any(one.everything.hota_2d for one in figures)
    heads = [*(f"2D {name}" for name in _HOTA if image), *(f"centre {name}" for name in (*_HOTA, "LocA")), *_GOSPA]
    table = _empty(("class", SCORE, *heads))
    for one in figures:
        for place, part in enumerate((one.everything, one.best)):
            if part is None:
                continue
            flat = part.hota_2d.summary() if part.hota_2d else {}
            table.add_row(
                "" if place else one.name,
                f"{part.threshold:.3f}" if place else "all",
                *(_shown(flat.get(name)) for name in _HOTA if image),
                *(_shown(part.hota.summary()[name]) for name in (*_HOTA, "LocA")),
                *(_shown(part.gospa.summary()[name], plain=True) for name in _GOSPA),
            )
    for key, values in average.items():
        table.add_row("class average" if key == "all" else "", key, *(_shown(values[name]) for name in _HOTA))
    return table


def _nees(figures: "Sequence[ClassFigures]") -> Table:
    table = _empty(
        ("class", "boxes", "objects", "NEES", "95 % of it", "consistent", "in 95 %", "error m", "expected m")
    )
    for one in figures:
        if one.calibration is None:
            continue
        found: Mapping[str, Any] = one.calibration.summary()
        table.add_row(
            one.name,
            *(_shown(found[name]) for name in ("samples", "objects")),
            _shown(found["NEES"], plain=True),
            *(_range(found[name]) for name in ("interval", "band")),
            _shown(found["coverage"]),
            *(_shown(found[name], plain=True) for name in ("error", "expected_error")),
        )
    return table


def _errors(figures: "Sequence[ClassFigures]") -> Iterator[RenderableType]:
    """Yield a table of errors by range and speed, tracks above their detections, and one of headings."""
    found = [(one.name, one.errors) for one in figures if one.errors is not None]
    boxes = _empty(("class", "boxes", "", *_DIRECTIONS))
    headings = _empty(("class", "boxes", "backward", "det. backward", "NEES", "in 95 %"))
    notes = list(dict.fromkeys(errors.without for _, errors in found if errors.without))
    for name, errors in found:
        for place, (group, rows) in enumerate(errors.groups()):
            values: Mapping[str, Any] = errors.figures(rows)
            head = f"  {group}" if place else name
            turned, heading = values["backward"], values["heading"]
            if values["boxes"]:
                for kind in ("track", "detection"):
                    label = (head, str(values["boxes"])) if kind == "track" else ("", "")
                    boxes.add_row(*label, kind[:5], *(_shown(values[kind][key], plain=True) for key in _DIRECTIONS))
            if heading["boxes"]:
                spread = (_shown(heading["NEES"], plain=True), _shown(heading["coverage"]))
                both = (_shown(heading["backward"]), _shown(turned["detection"]))
                headings.add_row(head, str(heading["boxes"]), *both, *spread)
    if boxes.row_count:
        yield _titled("Errors of tracks that exist with 50 % or more, and of their detections: m, rad", boxes)
    if headings.row_count:
        yield _titled("Headings: share that is backward, and errors against the variance (NEES 1)", headings)
    for note in notes:
        yield Text(f"No errors of detections: {note}")


def _reliability(figures: "Sequence[ClassFigures]") -> Table:
    calibrations = [(one.name, one.calibration.deciles) for one in figures if one.calibration is not None]
    used = [place for place in range(10) if any(deciles[place].count for _, deciles in calibrations)]
    heads = [f"{10 * place}-{10 * (place + 1)} %" for place in used]
    table = _empty(("class", "", *heads))
    for name, deciles in calibrations:
        table.add_row(name, "tracks", *(str(deciles[place].count) for place in used))
        table.add_row("", "predicted", *(_shown(_known(deciles[place].predicted)) for place in used))
        table.add_row("", "observed", *(_shown(_known(deciles[place].observed)) for place in used))
    return table


def _empty(columns: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="left" if name in {"class", "tracks", SCORE, ""} else "right", no_wrap=True)
    return table


def _titled(title: str, table: Table) -> RenderableType:
    return Group(Text(f"\n{title}", style="bold"), table)


def _known(value: float) -> float | None:
    return None if value != value else value  # noqa: PLR0124  NaN alone differs from itself


def _range(ends: Sequence[float | None]) -> str:
    low, high = ends
    return "-" if low is None or high is None else f"{low:.2f} to {high:.2f}"


def _counted(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _shown(value: float | None, plain: bool = False) -> str:  # noqa: FBT001, FBT002  a flag of this module's own
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value:.3f}" if plain else f"{100.0 * value:.2f}"
