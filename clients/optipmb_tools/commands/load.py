"""`optipmb load`: how much a running service carries."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.errors import UsageError

from optipmb_tools.commands.options import AsJson, DatasetOptions, Profile, print_json, print_table, say
from optipmb_tools.commands.service_options import ServiceOptions
from optipmb_tools.run.load import Frames, Load, Run, draw_runs, find_limit, generated, recorded, run_load, table_of
from optipmb_tools.views.progress import FrameProgress


@dataclass(frozen=True, kw_only=True)
class RecordedOptions(DatasetOptions):
    """Options of recorded frames to send."""

    dataset: Annotated[str | None, typer.Option("--dataset", help="Recorded frames in the place of generated.")] = None


@dataclass(frozen=True, kw_only=True)
class GeneratedOptions:
    """Options of how much is sent, and of generated frames."""

    streams: Annotated[int, typer.Option(min=1, max=10_000, help="Sensors.")] = 10
    rate: Annotated[float, typer.Option(min=0.1, max=10_000, help="Frames per second of each.")] = 10.0
    objects: Annotated[int, typer.Option(min=0, max=5000, help="Objects in a generated frame.")] = 40
    points: Annotated[int, typer.Option(min=0, max=1_000_000, help="Points of a generated cloud; 0: no clouds.")] = 0


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of the runs."""

    clouds: Annotated[bool, typer.Option("--clouds/--no-clouds", help="Send the clouds of recorded frames.")] = True
    profile: Profile = None
    seconds: Annotated[float, typer.Option(min=1.0, help="How long one run takes.")] = 20.0
    limit: Annotated[bool, typer.Option("--find-limit", help="Look for the highest rate that holds.")] = False
    latency_ms: Annotated[
        float | None, typer.Option(min=0.1, help="What 99 of 100 frames must not exceed; 20 with --find-limit.")
    ] = None
    plot: Annotated[Path | None, typer.Option("--plot", help="Picture of latency against throughput, a file.")] = None


def load(
    *, made: GeneratedOptions, data: RecordedOptions, how: RunOptions, service: ServiceOptions, as_json: AsJson = False
) -> None:
    """Send frames of many sensors through a running service, and show how long their tracks take and how many are lost.

    Ends with status 1 when frames were lost, or the latency that was asked for was not held.
    """
    latency_ms = how.latency_ms or (20.0 if how.limit else None)
    material: Frames | None = None
    profile = how.profile
    if data.dataset is not None:
        opened = data.open()
        material, profile = recorded(opened.sequences, clouds=how.clouds), profile or opened.dataset.profile
        if not len(material):
            raise UsageError("--sequences: they have no frames")

    def measure(at: float) -> Run:
        frames = generated(made.objects, made.points, at) if material is None else material
        one = Load(made.streams, at, how.seconds, profile)
        with (
            service.connection() as connection,
            FrameProgress(f"load at {at:.1f} Hz", one.frames * made.streams) as progress,
        ):
            result = run_load(connection, one, frames, prefix=service.prefix, on_frame=progress.advance)
            progress.note(
                f"{at:.1f} Hz: {result.throughput:.0f} frames/s, lost {result.lost},"
                f" p50 {result.p50_ms:.2f} ms, p99 {result.p99_ms:.2f} ms"
            )
        return result

    highest, runs = (
        find_limit(measure, made.rate, latency_ms) if how.limit and latency_ms else (None, [measure(made.rate)])
    )
    if how.plot is not None:
        draw_runs(how.plot, runs, latency_ms)
    if as_json:
        rows = [{**vars(run), "lost": run.lost, "throughput": run.throughput} for run in runs]
        print_json({"command": "load", "latency_ms": latency_ms, "highest_hz": highest, "runs": rows})
    else:
        print_table(table_of(runs, latency_ms))
        if highest is not None:
            total = highest * made.streams
            say(f"highest rate that holds {latency_ms:g} ms: {highest:.1f} Hz each, {total:.0f} frames/s")
    if highest == 0 or (highest is None and (runs[0].lost or not runs[0].holds(latency_ms or float("inf")))):
        raise typer.Exit(1)
