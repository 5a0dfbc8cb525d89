"""`optipmb status`: what runs, once or as it goes on."""

import contextlib
import json
import time
from typing import Annotated

import typer
from optipmb_schemas import encode_json
from rich.console import Console
from rich.live import Live

from optipmb_client.board import Board
from optipmb_client.commands.options import AsJson, print_json, print_table
from optipmb_client.commands.service_options import ServiceOptions
from optipmb_client.errors import ConnectionFailed, ServiceRefused, ServiceUnavailable, UsageError
from optipmb_client.sessions import find_services
from optipmb_client.status import render
from optipmb_client.zenoh import Connection


def status(
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router, and for a service.")] = 2.0,
    *,
    service: ServiceOptions,
    watch: Annotated[bool, typer.Option("--watch", help="Update until Ctrl-C, the worst streams on top.")] = False,
    interval: Annotated[float, typer.Option(min=0.1, help="Seconds between updates, with --watch.")] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Show the services that are alive, their streams, rates and latencies, and their newest problems."""
    if watch and as_json:
        raise UsageError("--watch: draws for people; for programs ask again and again with --json")
    with service.connection(timeout) as connection:
        if watch:
            _watch(connection, service.prefix, interval)
            return
        services = find_services(connection, prefix=service.prefix, patience_s=timeout)
    if not services:
        raise ServiceUnavailable(f"no tracking service is alive at {connection.where} (prefix {service.prefix})")
    if as_json:
        print_json({"command": "status", "services": [json.loads(encode_json(one)) for one in services]})
        return
    print_table(render(services))


def _watch(connection: Connection, prefix: str, interval_s: float) -> None:
    """Draw until Ctrl-C; a service or router that goes away is shown so, and looked for again."""
    console = Console()
    board = Board(connection.where)
    with (
        contextlib.suppress(KeyboardInterrupt),
        Live(console=console, screen=console.is_terminal, auto_refresh=False) as live,
    ):
        while True:
            began = time.monotonic()
            try:
                services = find_services(connection, prefix=prefix, patience_s=0.0)
            except (ConnectionFailed, ServiceRefused):
                services = []
            board.take(services, time.monotonic())
            live.update(board.render(console.height, console.width), refresh=True)
            time.sleep(max(0.05, interval_s - (time.monotonic() - began)))
