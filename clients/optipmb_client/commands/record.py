"""`optipmb record`: streams into an MCAP file."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optipmb_client.commands.options import AsJson, mcap_needed, print_json, say
from optipmb_client.commands.service_options import ServiceOptions
from optipmb_client.errors import UsageError
from optipmb_client.progress import StatusLine

if TYPE_CHECKING:
    from optipmb_client.mcap_files.record import Recording


def record(
    *,
    out: Annotated[Path, typer.Option("--out", help="The MCAP file; it must not be there yet.")],
    streams: Annotated[
        list[str] | None,
        typer.Option("--streams", metavar="NAME...", help="Streams, `*` stands for any name. Default: all."),
    ] = None,
    points: Annotated[bool, typer.Option(help="Record the point clouds too.")] = True,
    duration: Annotated[
        float | None, typer.Option(min=0.1, help="End after so many seconds. Default: at SIGINT or SIGTERM.")
    ] = None,
    service: ServiceOptions,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router.")] = 5.0,
    as_json: AsJson = False,
) -> None:
    """Record everything on the keys of streams: detections, clouds, tracks, problems, and the parameters in force.

    The file opens in Foxglove, which draws the tracks, and plays back with `optipmb play`. It is written out every
    second, so that a recording that is killed still opens.
    """
    with mcap_needed():
        from optipmb_client.mcap_files.record import record as record_streams  # noqa: PLC0415  packages of an extra
    patterns = streams or ["*/*/*"]
    stop = threading.Event()
    about = {"made_by": f"optipmb {version('optipmb')}", "prefix": service.prefix, "streams": " ".join(patterns)}
    if out.exists():
        raise UsageError(f"--out: expected a new file, there is {out} already")
    with service.connection(timeout) as connection, _ended_by(stop), StatusLine() as progress:
        result = record_streams(
            connection,
            patterns,
            out,
            stop=stop,
            points=points,
            duration=duration,
            prefix=service.prefix,
            about=about,
            on_flush=lambda so_far: progress.show(_line(so_far, duration)),
        )
    if as_json:
        print_json({"command": "record", **vars(result)})
        return
    for name, counts in sorted(result.streams.items()):
        say(f"{name}: " + ", ".join(f"{count} {topic}" for topic, count in sorted(counts.items())))
    say(f"{result.messages} messages in {result.seconds:.0f} s, {result.size / 1e6:.1f} MB in {out}")
    if result.dropped:
        typer.echo(f"optipmb: {result.dropped} messages were lost, the disk is too slow", err=True)
        raise typer.Exit(1)


def _line(so_far: "Recording", duration: float | None) -> str:
    rate = so_far.messages / max(so_far.seconds, 1e-9)
    left = "" if duration is None else f", {max(0.0, duration - so_far.seconds):.0f} s left"
    return f"recording: {so_far.messages} messages, {rate:.0f} per second, {so_far.size / 1e6:.1f} MB{left}"


@contextlib.contextmanager
def _ended_by(stop: threading.Event) -> Iterator[None]:
    """Have SIGINT and SIGTERM set an event: they are how a recording ends, not errors."""
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
