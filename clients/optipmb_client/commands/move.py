"""`optipmb move`: a stream to another worker process."""

from typing import Annotated

import typer

from optipmb_client.commands.options import AsJson, print_json, say
from optipmb_client.commands.service_options import ServiceOptions
from optipmb_client.sessions import move_stream, only_service


def move(
    stream: Annotated[str, typer.Argument(help="Name of the stream, site/node/sensor.")],
    to: Annotated[int, typer.Option("--to", min=0, help="Number of the worker, as `optipmb status` shows it.")],
    instance: Annotated[str | None, typer.Option(help="Which service; default: the only one there is.")] = None,
    *,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Move a stream to another worker process of a service; tracks and ids continue."""
    with service.connection(2.0) as connection:
        name = instance or only_service(connection, "--instance", prefix=service.prefix)
        move_stream(connection, name, stream, to, prefix=service.prefix)
    if as_json:
        print_json({"command": "move", "instance": name, "stream": stream, "worker": to})
    else:
        say(f"{stream} is with worker {to} of {name}")
