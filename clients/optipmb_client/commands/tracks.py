"""`optipmb tracks`: what was tracked a while ago."""

from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from optipmb_client.commands.options import AsJson, print_json, say
from optipmb_client.commands.service_options import ServiceOptions
from optipmb_client.errors import ServiceUnavailable, UsageError
from optipmb_client.results.table import track_columns
from optipmb_client.sessions import kept_tracks, session_state
from optipmb_client.table_files import SUFFIXES, write_table

SECOND = 1_000_000_000


class _Kept(NamedTuple):
    name: str


def tracks(
    stream: Annotated[str, typer.Argument(help="Name of the stream, site/node/sensor.")],
    from_ns: Annotated[int, typer.Option("--from", min=0, metavar="STAMP", help="First stamp, nanoseconds.")] = 0,
    to_ns: Annotated[
        int | None, typer.Option("--to", min=0, metavar="STAMP", help="Last stamp. Default: up to the newest.")
    ] = None,
    last: Annotated[float | None, typer.Option(min=0.0, help="Instead: seconds up to the newest frame.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write a table: .csv, .parquet, .jsonl or .feather.")] = None,
    *,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Get the tracks of a stream that the service still has: some seconds, or an hour where there is a log."""
    if last is not None and (from_ns or to_ns is not None):
        raise UsageError("--last: not together with --from and --to")
    if out is not None and out.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--out: a table such as tracks.csv or tracks.parquet, not {out}")
    with service.connection(2.0) as connection:
        if last is not None:
            state = session_state(connection, stream, prefix=service.prefix)
            if state is None or state.stamp_ns is None:
                raise ServiceUnavailable(f"no session of {stream} is there, so --last says nothing: give --from")
            from_ns = max(0, state.stamp_ns - round(last * SECOND))
        found = list(kept_tracks(connection, stream, from_ns, to_ns, prefix=service.prefix))
    if out is not None:
        write_table(out, track_columns(_Kept(stream), dict(enumerate(found))))
    stamps = [found[0].stamp_ns, found[-1].stamp_ns] if found else []
    if as_json:
        print_json({"command": "tracks", "stream": stream, "frames": len(found), "stamps_ns": stamps, "out": out})
    elif not found:
        say(f"{stream}: no tracks are kept of this time")
    else:
        say(f"{stream}: {len(found)} frames, stamps {stamps[0]} to {stamps[1]}" + (f", in {out}" if out else ""))
