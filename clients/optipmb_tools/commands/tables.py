"""The tables of `optipmb evaluate`.

Shares are printed in percent, distances in metres; a dash stands for a figure that is not defined.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from optipmb_tools.evaluation.figures import FIGURES, cell, defined

if TYPE_CHECKING:
    from optipmb_tools.evaluation import ClassResult
    from optipmb_tools.evaluation.evaluate import ClassFigures
    from optipmb_tools.evaluation.nuscenes import NuScenesScores

T = TypeVar("T")
Compared: TypeAlias = "tuple[Mapping[str, Mapping[str, float | None]], Sequence[ClassFigures]]"
"""MOTA and identity switches by class, and the other figures."""

_CLEAR = ("MOTA", "MOTP", "precision", "recall", "GT", "FP", "FN", "IDS", "FRAG")
_PROTOCOL = ("sAMOTA", "AMOTA", "AMOTP", "score", "MOTA", "MOTP", "recall", "precision", "IDS", "FRAG", "FP", "FN")
_SHARES = ("MT", "ML")
_NUSCENES = ("amota", "amotp", "recall", "mota", "motp", "gt", "tp", "fp", "fn", "ids", "frag")
_HOTA = ("HOTA", "DetA", "AssA")
_DIRECTIONS = ("along", "across", "height", "heading", "length", "width", "tall")
_GOSPA = ("GOSPA", "localisation", "missed", "false", "OSPA")
_COMPARED = ("AMOTA", "MOTA", "IDS", "IDF1", "HOTA", "DetA", "AssA", "LocA", "GOSPA", "OSPA", "localisation", "missed",
             "false", "velocity_error", "NEES", "coverage")  # fmt: skip
_DRAWN = ("AMOTA", "MOTA", "IDF1", "HOTA", "DetA", "AssA")
SETS = "tracks"  # which of them a row is about


def clear_table(results: "Sequence[ClassResult]", *, metres: bool, every: bool) -> RenderableType:
    """Return the CLEAR MOT figures; MOTP is in metres or in percent."""
    table = _empty(("class", SETS, *_CLEAR))
    for one in results:
        best = one.sweep.best
        sets = _named_sets(one.confirmed, one.total, one.sweep.results[best], one.sweep.thresholds[best], every=every)
        for place, (which, figures) in enumerate(sets.items()):
            cells = _cells(figures.summary(), _CLEAR, metres=metres)
            table.add_row("" if place else one.name, which, *cells)
    return _titled("Confirmed tracks; those from the score on that gives the highest MOTA", table)


def shown_table(figures: "Sequence[ClassFigures]") -> Iterator[RenderableType]:
    """Yield the CLEAR MOT figures of the confirmed tracks, where the files tell them; MOTP is in metres."""
    table = _empty(("class", *_CLEAR))
    for one in figures:
        if one.clear is not None:
            table.add_row(one.name, *_cells(one.clear.summary(), _CLEAR, metres=True))
    if table.row_count:
        yield _titled("Confirmed tracks, which people see; an object within 2 m is found", table)


def _named_sets(confirmed: T | None, everything: T, best: T | None, least: float, *, every: bool) -> dict[str, T]:
    """Return the sets of tracks that have a row: confirmed tracks, tracks from a score on, and all if asked."""
    sets = {"confirmed": confirmed, f"≥ {least:.3f}": best, "all": everything if every or confirmed is None else None}
    first = ("all",) if confirmed is None else ()
    return {name: found for name in (*first, *sets) if (found := sets[name]) is not None}


def nuscenes_table(scores: "NuScenesScores", names: Sequence[str]) -> RenderableType:
    """Return the figures of the benchmark of nuScenes, of some classes and overall; AMOTP and MOTP are in metres."""
    table = _empty(("class", *(FIGURES[name].title for name in _NUSCENES)))
    rows = {name: one.to_json() for name, one in scores.classes.items() if name in names}
    for name, values in {**rows, "overall": scores.to_json()["overall"]}.items():
        table.add_row(name, *_cells(values, _NUSCENES))
    return _titled(
        "The benchmark of nuScenes: averages over 40 recalls, then the threshold with the highest MOTA", table
    )


def figure_tables(
    figures: "Sequence[ClassFigures]",
    cutoff: float,
    average: "Mapping[str, Mapping[str, float | None]] | None" = None,
    *,
    every: bool = False,
) -> Iterator[RenderableType]:
    """Yield the tables of all other figures that there are, with HOTA's average over classes where it is given."""
    if any(one.ab3dmot for one in figures):
        yield _titled(
            "AB3DMOT's protocol: averages over 40 recall points, then the threshold with the highest MOTA",
            _protocol(figures),
        )
    yield _titled(
        f"HOTA of the same tracks in percent, GOSPA and OSPA in metres, cut off at {cutoff:g} m",
        _sets(figures, average or {}, every=every),
    )
    if any(one.calibration for one in figures):
        yield _titled(
            "Errors of positions against their covariances: the NEES of a consistent tracker is 2", _nees(figures)
        )
        yield from _errors(figures)
        yield _titled(
            "Existence probability against the share of tracks that are objects, by tenths", _reliability(figures)
        )


def comparison_tables(trackers: "Mapping[str, Compared]") -> Iterator[RenderableType]:
    """Yield a table for each class with the figures of several trackers, of the tracks that a picture shows.

    Columns that no tracker has a figure for are left out.
    """
    for name, rows in _compared(trackers).items():
        heads = [one for one in _COMPARED if any(values[one] is not None for values in rows.values())]
        table = _empty(("tracks", *(FIGURES[one].title for one in heads)))
        for place, values in rows.items():
            table.add_row(place, *_cells(values, heads))
        yield _titled(f"{name}: shares in percent, HOTA and IDF1 of centres; GOSPA and OSPA in metres", table)


def shares(trackers: "Mapping[str, Compared]") -> dict[str, dict[str, dict[str, float | None]]]:
    """Return the shares by class, tracker and name, for a picture of them."""
    return {
        name: {place: {one: values[one] for one in _DRAWN if values[one] is not None} for place, values in rows.items()}
        for name, rows in _compared(trackers).items()
    }


def _compared(trackers: "Mapping[str, Compared]") -> "dict[str, dict[str, Mapping[str, float | None]]]":
    """Return the figures of `_COMPARED` by class and tracker."""
    found: dict[str, dict[str, Mapping[str, float | None]]] = {}
    for place, (clear, figures) in trackers.items():
        for one in figures:
            tracks = one.confirmed or one.best or one.everything
            protocol = one.ab3dmot[0].summary() if one.ab3dmot else {}
            calibration: Mapping[str, Any] = one.calibration.summary() if one.calibration else {}
            known = {**clear[one.name], **tracks.hota.summary(), **tracks.gospa.summary(), **tracks.identity.summary()}
            known |= {"AMOTA": protocol.get("AMOTA", clear[one.name]["AMOTA"]), "velocity_error": one.velocity_error}
            known |= {name: calibration.get(name) for name in ("NEES", "coverage")}
            values = {name: None if value is None else defined(value) for name, value in known.items()}
            found.setdefault(one.name, {})[place] = values
    return found


def _protocol(figures: "Sequence[ClassFigures]") -> Table:
    table = _empty(("class", "IoU", *_PROTOCOL, *_SHARES))
    for one in figures:
        for place, result in enumerate(one.ab3dmot):
            cells = _cells(result.summary(), (*_PROTOCOL, *_SHARES))
            table.add_row("" if place else one.name, f"{result.limit:g}", *cells)
    return table


def _sets(
    figures: "Sequence[ClassFigures]", average: "Mapping[str, Mapping[str, float | None]]", *, every: bool
) -> Table:
    image = any(one.everything.hota_2d for one in figures)
    centre = "centre " if image else ""
    heads = [*(f"2D {name}" for name in _HOTA if image), *(f"{centre}{name}" for name in (*_HOTA, "LocA")), *_GOSPA]
    table = _empty(("class", SETS, *heads))
    for one in figures:
        least = one.best.threshold if one.best else 0.0
        sets = _named_sets(one.confirmed, one.everything, one.best, least, every=every)
        for place, (which, part) in enumerate(sets.items()):
            flat = part.hota_2d.summary() if part.hota_2d else dict.fromkeys(_HOTA)
            table.add_row(
                "" if place else one.name,
                which,
                *(_cells(flat, _HOTA) if image else ()),
                *_cells(part.hota.summary(), (*_HOTA, "LocA")),
                *_cells(part.gospa.summary(), _GOSPA),
            )
    for key, values in average.items():
        table.add_row("class average" if key == "all" else "", key, *_cells(values, _HOTA))
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
            *_cells(found, ("samples", "objects", "NEES")),
            *(_range(found[name]) for name in ("interval", "band")),
            *_cells(found, ("coverage", "error", "expected_error")),
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
                    boxes.add_row(*label, kind[:5], *_cells(values[kind], _DIRECTIONS))
            if heading["boxes"]:
                both = (cell("backward", heading["backward"]), cell("backward", turned["detection"]))
                headings.add_row(head, str(heading["boxes"]), *both, *_cells(heading, ("NEES", "coverage")))
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
        table.add_row("", "predicted", *(cell("predicted", deciles[place].predicted) for place in used))
        table.add_row("", "observed", *(cell("observed", deciles[place].observed) for place in used))
    return table


def _empty(columns: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="left" if name in {"class", SETS, "IoU", ""} else "right", no_wrap=True)
    return table


def _titled(title: str, table: Table) -> RenderableType:
    return Group(Text(f"\n{title}", style="bold"), table)


def _cells(values: "Mapping[str, float | None]", names: Sequence[str], *, metres: bool = False) -> list[str]:
    return [cell(name, values[name], metres=metres) for name in names]


def _range(ends: Sequence[float | None]) -> str:
    low, high = ends
    return "-" if low is None or high is None else f"{low:.2f} to {high:.2f}"
