"""`optipmb sweep`: how the figures depend on single parameters of a profile, as in Figure 5 of the paper."""

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from optipmb_client.commands.ablate import by_class, cells_of, measured, print_rows
from optipmb_client.commands.options import (
    AsJson,
    Classes,
    LabelledOptions,
    Profile,
    open_sequences,
    print_json,
    say,
    warn,
)
from optipmb_client.errors import UsageError
from optipmb_client.extras import to_install

FIGURE_5 = ("survival=0.9,0.95,0.99,0.999,1", "clutter_rate=0.1,0.3,1,3,10,30", "extract_misses=1,2,3,4,5,6")
SHOWN = ("sAMOTA", "AMOTA", "MOTA", "HOTA", "HOTA, all", "IDS", "FP", "FN")


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
    from optipmb_client import tuning  # noqa: PLC0415  loads the tracker and its compiler
    from optipmb_client.offline import profile_compared  # noqa: PLC0415  as above

    wanted = [_values(text) for text in parameter or FIGURE_5]
    asked = data.asked()
    opened, chosen = open_sequences(asked, data.sequences)
    name = profile or opened.profile
    parameters = profile_compared(name, chosen)
    source = tuning.Source.of(asked.name, asked.detections, chosen, parameters, classes)
    variants = [tuning.sweep(parameters, source.classes, path, values) for path, values in wanted]
    rows = iter(measured("sweep", source, [one for each in variants for one in each]))
    swept: list[dict[str, Any]] = []
    for path, values in wanted:
        found = [next(rows) for _ in values]
        own = {label: tuning.value_of(parameters, label, path) for label in source.classes}
        tried = [tuning.value_of(row.variant.parameters, source.classes[0], path) for row in found]
        figures = {label: [tuning.plain_figures(one) for one in each] for label, each in by_class(found)}
        swept.append({"parameter": path, "profile": own, "values": tried, "figures": figures})
        for label, each in [] if as_json else by_class(found):
            now = f" (profile: {own[label]})" if label in own else ""
            cells = [[str(value), *cells_of(one, SHOWN)] for value, one in zip(tried, each, strict=True)]
            print_rows(f"{label}, {path}{now}", [path], SHOWN, cells)
    result = {
        "command": "sweep",
        "dataset": asked.name,
        "profile": name,
        "sequences": [sequence.name for sequence in chosen],
        "sweeps": swept,
    }
    if out is not None:
        picture = find_spec("matplotlib") is not None
        tuning.write_sweep(out, result, picture=picture)
        if not picture:
            warn(str(to_install("matplotlib", "sweep.png")))
    if as_json:
        print_json(result)
    elif out is not None:
        say(f"figures in {out}")


def _values(text: str) -> tuple[str, list[str]]:
    path, _, values = text.partition("=")
    found = [value.strip() for value in values.split(",")]
    if not path or not all(found):
        raise UsageError(f"--parameter: expected NAME=VALUE,VALUE,..., received {text!r}")
    return path, found
