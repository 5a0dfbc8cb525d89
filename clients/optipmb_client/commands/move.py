"""`optipmb move`: a stream to another worker process."""

from typing import Annotated

import typer
from optipmb_schemas import PREFIX

from optipmb_client.commands.options import AsJson, Config, Connect, Prefix, print_json, say
from optipmb_client.sessions import move_stream, only_service
from optipmb_client.zenoh import Connection


def move(
    stream: Annotated[str, typer.Argument(help="Name of the stream, site/node/sensor.")],
    to: Annotated[int, typer.Option("--to", min=0, help="Number of the worker, as `optipmb status` shows it.")],
    instance: Annotated[str | None, typer.Option(help="Which service; default: the only one there is.")] = None,
    connect: Connect = None,
    config: Config = None,
    prefix: Prefix = PREFIX,
    *,
    as_json: AsJson = False,
) -> None:
    """Move a stream to another worker process of a service; tracks and ids continue."""
    with Connection(connect, config=config, timeout=2.0) as connection:
        name = instance or only_service(connection, "--instance", prefix=prefix)
        move_stream(connection, name, stream, to, prefix=prefix)
    if as_json:
        print_json({"command": "move", "instance": name, "stream": stream, "worker": to})
    else:
        say(f"{stream} is with worker {to} of {name}")
