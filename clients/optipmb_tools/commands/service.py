"""Commands that ask a running service: `status`, `tracks`, `set`, `move` and `drain`."""

import contextlib
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.errors import ConnectionFailed, ServiceUnavailable, UsageError
from optipmb_client.sessions import (
    drain_service,
    find_services,
    kept_tracks,
    move_stream,
    only_service,
    session_state,
    set_parameters,
)
from optipmb_client.zenoh import Connection
from optipmb_schemas import SessionParameters, encode_json
from rich.console import Console
from rich.live import Live

from optipmb_tools.commands.options import AsJson, Digits, Origin, print_json, print_table, report, warn
from optipmb_tools.commands.service_options import ServiceOptions
from optipmb_tools.datasets.interface import digits_of, georeference_of
from optipmb_tools.table_files import SUFFIXES
from optipmb_tools.views.terminal import StatusView, status_tables

SECOND = 1_000_000_000
STREAM = typer.Argument(help="Name of the stream, site/node/sensor.")


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
        services = find_services(
            connection,
            prefix=service.prefix,
            patience_s=timeout,
            on_silent=lambda name: warn(f"{name} is alive and does not answer: it starts, or is overloaded"),
        )
    if not services:
        raise ServiceUnavailable(f"no tracking service answers at {connection.where} (prefix {service.prefix})")
    if as_json:
        print_json({"command": "status", "services": [json.loads(encode_json(one)) for one in services]})
        return
    print_table(status_tables(services))


def _watch(connection: Connection, prefix: str, interval_s: float) -> None:
    """Draw until Ctrl-C; a service or router that goes away is shown so, and looked for again."""
    console = Console()
    view = StatusView(connection.where)
    with (
        contextlib.suppress(KeyboardInterrupt),
        Live(console=console, screen=console.is_terminal, auto_refresh=False) as live,
    ):
        while True:
            began = time.monotonic()
            try:
                services = find_services(connection, prefix=prefix, patience_s=0.0)
            except ConnectionFailed:
                services = []
            view.take(services, time.monotonic())
            live.update(view.render(console.height, console.width), refresh=True)
            time.sleep(max(0.05, interval_s - (time.monotonic() - began)))


@dataclass(frozen=True, kw_only=True)
class TimeOptions:
    """Options of a time of a stream."""

    from_ns: Annotated[int, typer.Option("--from", min=0, metavar="STAMP", help="First stamp, nanoseconds.")] = 0
    to_ns: Annotated[
        int | None, typer.Option("--to", min=0, metavar="STAMP", help="Last stamp. Default: up to the newest.")
    ] = None
    last: Annotated[float | None, typer.Option(min=0.0, help="Instead: seconds up to the newest frame.")] = None


def tracks(
    stream: Annotated[str, STREAM],
    *,
    when: TimeOptions,
    out: Annotated[Path | None, typer.Option(help="Write a table: .csv, .parquet, .jsonl or .feather.")] = None,
    origin: Origin = None,
    digits: Digits = "unit",
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Get the tracks of a stream that the service still has: some seconds, or an hour where there is a log."""
    from_ns, last = when.from_ns, when.last
    if last is not None and (from_ns or when.to_ns is not None):
        raise UsageError("--last: not together with --from and --to")
    if out is not None and out.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--out: a table such as tracks.csv or tracks.parquet, not {out}")
    georeference, digits = None if origin is None else georeference_of(origin), digits_of(digits)
    with service.connection(2.0) as connection:
        if last is not None:
            state = session_state(connection, stream, prefix=service.prefix)
            if state is None or state.stamp_ns is None:
                raise ServiceUnavailable(f"no session of {stream} is there, so --last says nothing: give --from")
            from_ns = max(0, state.stamp_ns - round(last * SECOND))
        found = list(kept_tracks(connection, stream, from_ns, when.to_ns, prefix=service.prefix))
    if out is not None:
        from optipmb_tools.results.output import track_columns, write_tracks  # noqa: PLC0415  only with --out

        write_tracks(out, lambda: track_columns(stream, dict(enumerate(found)), georeference=georeference), digits)
    stamps = [found[0].stamp_ns, found[-1].stamp_ns] if found else []
    text = f"{stream}: no tracks are kept of this time"
    if found:
        text = f"{stream}: {len(found)} frames, stamps {stamps[0]} to {stamps[1]}" + (f", in {out}" if out else "")
    shown = {"command": "tracks", "stream": stream, "frames": len(found), "stamps_ns": stamps, "out": out}
    report(shown, text, as_json=as_json)


def set_profile(
    stream: Annotated[str, STREAM],
    profile: Annotated[str, typer.Option("--profile", metavar="NAME", help="Profile of the service.")],
    *,
    restart: Annotated[
        bool, typer.Option("--restart", help="Restart a session that has tracked frames: its tracks end, ids continue.")
    ] = False,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Track a stream with another profile, in place of the one in its checkpoint or in the settings."""
    wanted = SessionParameters(profile=profile, restart=restart)
    with service.connection(2.0) as connection:
        in_force = set_parameters(connection, stream, wanted, prefix=service.prefix)
    shown = {"command": "set", "stream": stream, "profile": in_force.profile, "session": in_force.session}
    report(shown, f"{stream} is tracked with {in_force.profile}", as_json=as_json)


def move(
    stream: Annotated[str, STREAM],
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
    shown = {"command": "move", "instance": name, "stream": stream, "worker": to}
    report(shown, f"{stream} is with worker {to} of {name}", as_json=as_json)


def drain(
    member: Annotated[
        str | None, typer.Argument(help="Name of the service, or of a worker of it; default: the only one there is.")
    ] = None,
    *,
    service: ServiceOptions,
    undo: Annotated[bool, typer.Option("--undo", help="Let it take its share of the streams again.")] = False,
    wait: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="How long the others may need to take all streams.")
    ] = 120.0,
    as_json: AsJson = False,
) -> None:
    """Give all streams of a service to the others, each with its state, and wait until they have them.

    It takes none until it ends, or --undo.
    """
    with service.connection(2.0) as connection:
        name = member or only_service(connection, "MEMBER", prefix=service.prefix)
        drain_service(
            connection,
            name,
            drains=not undo,
            prefix=service.prefix,
            patience_s=wait,
            on_wait=lambda status: warn(f"{name} still holds streams: {len(status.sessions)}"),
        )
    text = f"{name} {'takes its share of the streams again' if undo else 'holds no streams'}"
    report({"command": "drain", "member": name, "drain": not undo}, text, as_json=as_json)
