"""`optipmb status`: what runs."""

import json
from typing import Annotated

import typer
from optipmb_schemas import PREFIX, encode_json

from optipmb_client.commands.options import AsJson, Config, Connect, Prefix, print_json, print_table
from optipmb_client.errors import ServiceUnavailable
from optipmb_client.sessions import find_services
from optipmb_client.status import render
from optipmb_client.transport import Connection


def status(
    connect: Connect = None,
    config: Config = None,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router, and for a service.")] = 2.0,
    prefix: Prefix = PREFIX,
    *,
    as_json: AsJson = False,
) -> None:
    """Show the services that are alive, their streams, rates and latencies, and their newest problems."""
    with Connection(connect, config=config, timeout=timeout) as connection:
        services = find_services(connection, prefix=prefix, patience_s=timeout)
    if not services:
        raise ServiceUnavailable(f"no tracking service is alive at {connection.where} (prefix {prefix})")
    if as_json:
        print_json({"command": "status", "services": [json.loads(encode_json(service)) for service in services]})
        return
    print_table(render(services))
