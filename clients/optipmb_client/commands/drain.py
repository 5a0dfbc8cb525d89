"""`optipmb drain`: all streams of a service to the others."""

from typing import Annotated

import typer

from optipmb_client.commands.options import AsJson, print_json, say
from optipmb_client.commands.service_options import ServiceOptions
from optipmb_client.sessions import drain_service, only_service


def drain(
    member: Annotated[
        str | None, typer.Argument(help="Name of the service, or of a worker of it; default: the only one there is.")
    ] = None,
    *,
    service: ServiceOptions,
    undo: Annotated[bool, typer.Option("--undo", help="Let it take its share of the streams again.")] = False,
    as_json: AsJson = False,
) -> None:
    """Give all streams of a service to the others, each with its state; it takes none until it ends, or --undo."""
    with service.connection(2.0) as connection:
        name = member or only_service(connection, "MEMBER", prefix=service.prefix)
        drain_service(connection, name, drains=not undo, prefix=service.prefix)
    if as_json:
        print_json({"command": "drain", "member": name, "drain": not undo})
    else:
        say(f"{name} {'takes its share of the streams again' if undo else 'holds no streams'}")
