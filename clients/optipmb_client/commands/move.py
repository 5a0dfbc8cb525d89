"""`optipmb move`: a stream to another worker process."""

from typing import Annotated

import typer
from optipmb_schemas import PREFIX

from optipmb_client.commands.options import AsJson, Config, Connect, Prefix, print_json, say
from optipmb_client.errors import ServiceUnavailable, UsageError
from optipmb_client.sessions import find_services, move_stream
from optipmb_client.transport import Connection


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
        names = [instance] if instance else [found.instance for found in find_services(connection, prefix=prefix)]
        if not names:
            raise ServiceUnavailable(f"no tracking service is alive at {connection.where} (prefix {prefix})")
        if len(names) > 1:
            raise UsageError(f"--instance: one of {', '.join(names)}")
        move_stream(connection, names[0], stream, to, prefix=prefix)
    if as_json:
        print_json({"command": "move", "instance": names[0], "stream": stream, "worker": to})
    else:
        say(f"{stream} is with worker {to} of {names[0]}")
