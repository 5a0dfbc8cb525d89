"""`optipmb ablate` and `optipmb sweep`: the figures of variants of the tracker on a data set."""

from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from optipmb_client.errors import UsageError

from optipmb_tools.commands.options import (
    AsJson,
    Classes,
    Data,
    LabelledOptions,
    Profile,
    plain_table,
    print_json,
    print_table,
    report,
    say,
    warn,
)
from optipmb_tools.extras import to_install
from optipmb_tools.views.progress import FrameProgress

if TYPE_CHECKING:
    from collections.abc import Sequence as Many

    from optipmb_tools import tuning
    from optipmb_tools.tuning import Figures, Row, Variant

MODULES = ("adp", "habm", "rpp", "ote")
ABLATION_COLUMNS = ("AMOTA", "AMOTP", "FN", "FP", "IDS", "sAMOTA", "MOTA", "MOTP", "HOTA", "HOTA, all")
SWEEP_COLUMNS = ("sAMOTA", "AMOTA", "MOTA", "HOTA", "HOTA, all", "IDS", "FP", "FN")
FIGURE_5 = ("survival=0.9,0.95,0.99,0.999,1", "clutter_rate=0.1,0.3,1,3,10,30", "extract_misses=1,2,3,4,5,6")


def ablate(
    data: LabelledOptions,
    *,
    profile: Profile = None,
    classes: Classes = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as Markdown.")] = False,
    as_json: AsJson = False,
) -> None:
    """Track a dataset with every choice of the four modules on and off: the sixteen rows of the paper's ablation.

    All classes of the profile are tracked, those named are shown. FPS are frames per second of the tracker alone.
    """
    from optipmb_tools import tuning  # noqa: PLC0415  loads the tracker and its compiler

    opened = data.open()
    name, parameters, source = _source(opened, profile, classes)
    rows = _measured("ablation", source, tuning.ablation(parameters))
    if as_json:
        shown = [{"modules": asdict(row.variant.modules)} | row.to_json() for row in rows]
        print_json(_head("ablate", opened, name) | {"rows": shown})
        return
    marks = [[("x" if getattr(row.variant.modules, one) else "") for one in MODULES] for row in rows]
    speed = [f"{row.frames_per_second:.0f}" for row in rows]
    for title, figures in _by_class(rows):
        each = zip(marks, figures, speed, strict=True)
        cells = [[*left, *cells_of(one, ABLATION_COLUMNS, opened.name), fps] for left, one, fps in each]
        columns = [*(one.upper() for one in MODULES), *ABLATION_COLUMNS, "FPS"]
        _print_rows(title, columns, cells, marked=len(MODULES) if markdown else None)


def sweep(
    data: LabelledOptions,
    *,
    profile: Profile = None,
    classes: Classes = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE,...",
            help="A parameter of a class, such as process_noise.speed, and its values; several times for several, each "
            f"on its own. Default: those of Figure 5 of the paper, {'; '.join(FIGURE_5)}.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for sweep.csv, sweep.json and sweep.png.")] = None,
    as_json: AsJson = False,
) -> None:
    """Track a dataset with several values of a parameter, the others as in the profile, and show the figures of each.

    The parameter is changed in the classes named, by default in all that are labelled.
    """
    from optipmb_tools import tuning  # noqa: PLC0415  loads the tracker and its compiler

    wanted = [_values(text) for text in parameter or FIGURE_5]
    opened = data.open()
    name, parameters, source = _source(opened, profile, classes)
    variants = [tuning.sweep(parameters, source.classes, path, values) for path, values in wanted]
    rows = iter(_measured("sweep", source, [one for each in variants for one in each]))
    swept: list[dict[str, Any]] = []
    for path, values in wanted:
        found = [next(rows) for _ in values]
        own = {label: tuning.value_of(parameters, label, path) for label in source.classes}
        tried = [tuning.value_of(row.variant.parameters, source.classes[0], path) for row in found]
        figures = {label: [tuning.plain_figures(one) for one in each] for label, each in _by_class(found)}
        swept.append({"parameter": path, "profile": own, "values": tried, "figures": figures})
        for label, each in [] if as_json else _by_class(found):
            now = f" (profile: {own[label]})" if label in own else ""
            cells = [
                [str(value), *cells_of(one, SWEEP_COLUMNS, opened.name)] for value, one in zip(tried, each, strict=True)
            ]
            _print_rows(f"{label}, {path}{now}", [path, *SWEEP_COLUMNS], cells)
    result = _head("sweep", opened, name) | {"sweeps": swept}
    if out is not None:
        picture = find_spec("matplotlib") is not None
        tuning.write_sweep(out, result, picture=picture)
        if not picture:
            warn(str(to_install("matplotlib", "sweep.png")))
    report(result, *([] if out is None else [f"figures in {out}"]), as_json=as_json)


def _source(opened: Data, profile: str | None, classes: list[str] | None) -> "tuple[str, Any, tuning.TuningData]":
    """Return the name of the profile, its parameters, and the data to measure."""
    from optipmb_tools import tuning  # noqa: PLC0415  loads the tracker and its compiler
    from optipmb_tools.run.profiles import profile_compared  # noqa: PLC0415  as above

    name = profile or opened.dataset.profile
    parameters = profile_compared(name, opened.sequences)
    detections = opened.dataset.arguments.detections
    return name, parameters, tuning.TuningData.of(opened.name, detections, opened.sequences, parameters, classes)


def _head(command: str, opened: Data, profile: str) -> dict[str, Any]:
    return {"command": command, "dataset": opened.name, "profile": profile, "sequences": opened.names}


def _measured(title: str, source: "tuning.TuningData", variants: "Many[Variant]") -> "list[Row]":
    """Measure variants of the tracker, with a progress bar."""
    from optipmb_tools.tuning import measure_variants  # noqa: PLC0415  as above

    with FrameProgress(title, sum(len(clip.frames) for clip in source.clips) * len(variants)) as progress:
        return list(measure_variants(source, variants, progress.advance))


def _by_class(rows: "Many[Row]") -> "list[tuple[str, list[Figures]]]":
    """Return the figures of all rows for each class, and of all classes where there are several."""
    tables = [(label, [row.classes[label] for row in rows]) for label in rows[0].classes]
    return tables if len(tables) == 1 else [*tables, ("all classes", [row.overall for row in rows])]


def cells_of(figures: "Figures", names: "Many[str]", dataset: str) -> list[str]:
    """Return figures as tables print them; KITTI matches boxes by overlap, other data by metres."""
    from optipmb_tools.evaluation.figures import cell  # noqa: PLC0415  as above

    return [cell(name, figures[name], metres=dataset != "kitti") for name in names]


def _print_rows(title: str, columns: "Many[str]", cells: "Many[Many[str]]", *, marked: int | None = None) -> None:
    """Print a table; as Markdown if a number is given, of the columns that are aligned to the left."""
    if marked is not None:
        lines = [f"{title}:", "", "| " + " | ".join(columns) + " |"]
        lines.append("|" + " --- |" * marked + " ---: |" * (len(columns) - marked))
        say("\n".join([*lines, *("| " + " | ".join(row) + " |" for row in cells), ""]))
        return
    table = plain_table((), columns, title=title)
    for row in cells:
        table.add_row(*row)
    print_table(table)


def _values(text: str) -> tuple[str, list[str]]:
    path, _, values = text.partition("=")
    found = [value.strip() for value in values.split(",")]
    if not path or not all(found):
        raise UsageError(f"--parameter: expected NAME=VALUE,VALUE,..., received {text!r}")
    return path, found
