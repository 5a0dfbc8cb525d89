"""`optipmb demo`: everything once, on this machine, without data."""

from pathlib import Path
from typing import Annotated

import typer

from optipmb_client.commands.options import AsJson, Out, print_json, say
from optipmb_client.commands.replay import complain
from optipmb_client.commands.service_options import Speed, speed_of
from optipmb_client.extras import needed
from optipmb_client.progress import FrameProgress


def demo(
    *,
    out: Out = Path("out/demo"),
    frames: Annotated[int, typer.Option(min=10, max=2000, help="Frames of the scene, ten per second.")] = 200,
    speed: Speed = "max",
    as_json: AsJson = False,
) -> None:
    """Start a service, send generated traffic through it, evaluate and draw the tracks.

    The service is a process of its own on a free port and ends with the demo.
    """
    needed("optipmb demo", "demo", "uvicorn", "starlette", "structlog", "prometheus_client", "scipy")
    from optipmb_client.demo import demonstrate  # noqa: PLC0415  loads what only this command needs

    with FrameProgress("replaying", frames) as progress:
        result = demonstrate(
            out, frames=frames, speed=speed_of(speed), on_stage=progress.note, on_frame=progress.advance
        )
    replayed, figures = result.replayed, result.figures
    if as_json:
        print_json(
            {
                "command": "demo",
                "frames": replayed.frames,
                "returned": replayed.returned,
                "missing": replayed.missing,
                "clouds_missed": replayed.clouds_missed,
                "tracks": replayed.tracks,
                "latency": replayed.latency,
                **figures.summary(),
                "file": replayed.file,
                "picture": result.picture,
            }
        )
    else:
        say(f"frames    {replayed.returned} of {replayed.frames} tracked, {replayed.clouds} with a point cloud")
        if replayed.latency is not None:
            latency = replayed.latency
            say(f"latency   p50 {latency.p50_ms:.1f} ms, p99 {latency.p99_ms:.1f} ms, from publishing to receiving")
        say(
            f"tracks    {figures.objects} objects, MOTA {figures.mota:.3f}, {len(figures.switches)} id switches, "
            f"precision {figures.precision:.3f}, recall {figures.recall:.3f}"
        )
        say(f"files     {', '.join(str(file) for file in (replayed.file, result.picture) if file is not None)}")
    complain([replayed])
