"""`optipmb links`: which objects of several streams are one."""

import json
from typing import TYPE_CHECKING, Annotated

import typer
from optipmb_client.sessions import links_of
from optipmb_schemas import encode_json
from rich.console import Group
from rich.table import Table
from rich.text import Text

from optipmb_tools.commands.options import AsJson, print_json, print_table
from optipmb_tools.commands.service_options import ServiceOptions

if TYPE_CHECKING:
    from optipmb_schemas import LinkedObject


def links(
    area: Annotated[str, typer.Argument(help="Name of the area in the settings of `optipmb-service link`.")],
    *,
    service: ServiceOptions,
    ended: Annotated[bool, typer.Option("--ended", help="Show objects that are not tracked any more, too.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show which objects of several streams are one: a line for each, with its tracks and the least sure link."""
    with service.connection(2.0) as connection:
        message = links_of(connection, area, prefix=service.prefix)
    if as_json:
        print_json({"command": "links"} | json.loads(encode_json(message)))
        return
    groups: dict[bytes, list[LinkedObject]] = {}
    for one in message.objects:
        groups.setdefault(one.global_id, []).append(one)
    shown = {identity: group for identity, group in groups.items() if ended or not all(one.ended for one in group)}
    table = Table(box=None, pad_edge=False)
    table.add_column("object", no_wrap=True)
    table.add_column("tracks", overflow="fold", max_width=52)
    table.add_column("by", no_wrap=True)
    table.add_column("sure", justify="right", no_wrap=True)
    for identity, group in sorted(shown.items()):
        tracks = (f"{one.stream} {one.object}{' (ended)' if one.ended else ''}" for one in group)
        least = min(group, key=lambda one: one.probability)
        table.add_row(identity.hex()[:8], ", ".join(tracks), least.kind, f"{least.probability:.3f}")
    print_table(Group(table, Text(f"{len(shown)} objects of {area}")))
