"""`optipmb profiles` and `optipmb warm-up`: the parameter profiles that ship, and compiling the tracker."""

import time
from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.errors import UsageError
from rich.console import Group
from rich.text import Text

from optipmb_tools.commands.options import AsJson, plain_table, print_json, print_table, report, say
from optipmb_tools.files import write_whole


def profiles(
    name: Annotated[
        str | None, typer.Argument(help="Profile to show: its name, or a TOML file.", show_default=False)
    ] = None,
    *,
    copy: Annotated[
        Path | None, typer.Option("--copy", help="Write the profile into this file, to change it.", show_default=False)
    ] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Say what each field means, with its values.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the profiles that ship, show one, copy it, or explain its fields.

    A profile of your own is checked by showing it: `optipmb profiles mine.toml`.
    """
    from optipmb_tools.run import profiles as library  # noqa: PLC0415  loads the tracker and its compiler

    if name is None:
        if copy is not None or explain:
            raise UsageError("which profile? " + ", ".join(library.profiles()))
        _list(as_json=as_json)
        return
    parameters = library.read_profile(name)
    if copy is not None:
        if copy.exists():
            raise UsageError(f"--copy {copy}: it is there already")
        write_whole(copy, [library.profile_source(name)])
        say(f"{name} in {copy}; its name field is still {parameters.name!r}")
    elif as_json:
        print_json({"command": "profiles", "profile": parameters.model_dump()})
    elif explain:
        print_table(Group(*(Text(_line(*field)) for field in library.fields_of(parameters.classes))))
    else:
        say(library.profile_source(name).rstrip())


def _line(path: str, description: str, values: dict[str, float]) -> str:
    shown = ", ".join(f"{name} {value:g}" for name, value in values.items())
    return f"{path}: {description}\n    {shown}"


def _list(*, as_json: bool) -> None:
    from optipmb_tools.run import profiles as library  # noqa: PLC0415  as above

    known = {one: library.read_profile(one) for one in library.profiles()}
    if as_json:
        print_json({"command": "profiles", "profiles": {one: list(it.labels) for one, it in known.items()}})
        return
    names = ("profile", "Hz", "classes")
    table = plain_table(names, folded=names)
    table.columns[1].justify = "right"
    for one, it in known.items():
        table.add_row(one, f"{1.0 / it.nominal_period:g}", ", ".join(it.labels))
    table.add_row(library.AUTO, "any", "any: made for the data by track and tune")
    print_table(table)


def warm_up(
    *,
    everything: Annotated[
        bool, typer.Option("--all", help="Also what joins tracks over gaps, for another half minute.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Compile the tracker into its cache, as the last step of an installation or of an image."""
    from optipmb_tools.run import profiles as library  # noqa: PLC0415  the help does not load the tracker

    begun = time.monotonic()
    compiled = library.warm_up(rejoin=everything)
    seconds = round(time.monotonic() - begun, 1)
    text = f"compiled {compiled} kernels in {seconds} s" if compiled else f"all kernels were compiled ({seconds} s)"
    report({"command": "warm-up", "compiled": compiled, "seconds": seconds}, text, as_json=as_json)
