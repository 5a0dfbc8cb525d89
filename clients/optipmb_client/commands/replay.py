"""`optipmb replay`: a dataset through the service."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from optipmb_client.commands.options import (
    AsJson,
    Classes,
    DataOptions,
    Full,
    Out,
    Profile,
    open_sequences,
    print_json,
    say,
)
from optipmb_client.commands.service_options import PaceOptions, ServiceOptions
from optipmb_client.errors import UsageError
from optipmb_client.links import linked
from optipmb_client.progress import FrameProgress
from optipmb_client.recording import latency
from optipmb_client.replay import ReplayedSequence
from optipmb_client.replay import replay as replay_sequences


def replay(  # noqa: PLR0913  these are the command's options
    data: DataOptions,
    *,
    out: Out = Path("out/replay"),
    profile: Profile = None,
    classes: Classes = None,
    full: Full = False,
    service: ServiceOptions,
    pace: PaceOptions,
    streams: Annotated[int, typer.Option(min=1, help="Sequences sent at the same time.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Send a dataset through a running service, collect the tracks, and write its result files.

    The profile is one that the service knows. Ends with status 1 when tracks of some frames did not come back.
    """
    chosen_pace = pace.pace()
    asked = data.asked()
    opened, chosen = open_sequences(asked, data.sequences)
    name = profile or opened.profile
    if name == "auto":
        raise UsageError(
            "--profile: one that the service knows; auto is made for offline tracking (see: optipmb profiles)"
        )
    with (
        closing(linked(service.connect, config=service.config, timeout=pace.wait)) as connection,
        FrameProgress("replaying", sum(map(len, chosen))) as progress,
    ):
        results = replay_sequences(
            connection,
            opened,
            chosen,
            out,
            profile=name,
            pace=chosen_pace,
            classes=classes or (),
            streams=streams,
            prefix=service.prefix,
            full=full,
            on_frame=progress.advance,
        )
    if as_json:
        print_json(
            {
                "command": "replay",
                "dataset": asked.name,
                "profile": name,
                "out": out,
                "missing": sum(result.missing for result in results),
                "latency": latency([ns for result in results for ns in result.latencies_ns]),
                "sequences": [_summary(result) for result in results],
            }
        )
    else:
        for result in results:
            say(_line(result))
        say(f"results in {out}")
    complain(results)


def complain(results: list[ReplayedSequence]) -> None:
    """Say on standard error what is wrong with the results, and exit with status 1 when anything is."""
    missing = sum(result.missing for result in results)
    clouds = sum(result.clouds_missed for result in results)
    if missing:
        total = sum(result.frames for result in results)
        typer.echo(f"optipmb: {missing} of {total} frames have no tracks", err=True)
    if clouds:
        typer.echo(f"optipmb: {clouds} frames were tracked without the point cloud that was sent", err=True)
    for result in results:
        for problem in result.newest_problems[-1:]:
            text = f"optipmb: {result.name}: {result.problems} problems reported, the newest: {problem.message}"
            typer.echo(text, err=True)
    if missing or clouds:
        raise typer.Exit(1)


def _line(result: ReplayedSequence) -> str:
    text = f"{result.name}: {result.sent} frames sent, {result.returned} returned, {result.tracks} tracks"
    if result.latency is not None:
        text += f", latency p50 {result.latency.p50_ms:.1f} ms p99 {result.latency.p99_ms:.1f} ms"
    return f"{text}, {result.returned / max(result.seconds, 1e-9):.0f} frames/s"


def _summary(result: ReplayedSequence) -> dict[str, object]:
    return {
        "name": result.name,
        "stream": result.stream,
        "file": result.file,
        "frames": result.frames,
        "sent": result.sent,
        "returned": result.returned,
        "missing": result.missing,
        "clouds": result.clouds,
        "clouds_missed": result.clouds_missed,
        "tracks": result.tracks,
        "seconds": result.seconds,
        "latency": result.latency,
        "problems": result.problems,
        "newest_problems": [{"code": problem.code, "message": problem.message} for problem in result.newest_problems],
    }
