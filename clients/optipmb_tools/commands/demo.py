"""`optipmb demo`: everything once, on this machine, without data."""

import contextlib
import itertools
import os
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

import typer
from optipmb_client.errors import ClientError
from rich.console import Console

from optipmb_tools.commands.options import AsJson, Out, report, say
from optipmb_tools.commands.replay import complain
from optipmb_tools.commands.service_options import Speed, speed_of
from optipmb_tools.extras import needed
from optipmb_tools.views.progress import FrameProgress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_client.zenoh import Connection

    from optipmb_tools.datasets import DetectionFrame

STREAM = "demo/street/lidar"
START_S = 300.0  # the first start after an installation compiles
PATIENCE_S = 20.0
SEED = 4  # of the scene
CLOUD_WAIT_S = 5.0  # all clouds are sent; on a busy machine one may be late


def demo(
    *,
    out: Out = Path("out/demo"),
    frames: Annotated[int, typer.Option(min=10, max=2000, help="Frames of the scene, ten per second.")] = 200,
    speed: Speed = "max",
    live: Annotated[
        bool,
        typer.Option("--live", help="Send the traffic in a loop and show it on the live page, until Ctrl-C."),
    ] = False,
    browser: Annotated[bool, typer.Option(help="With --live: open the page where there is a browser.")] = True,
    as_json: AsJson = False,
) -> None:
    """Start a service, send generated traffic through it, evaluate and draw the tracks.

    The service is a process of its own on a free port and ends with the demo.
    """
    if live:
        _show_live(frames, browser=browser)
        return
    needed("optipmb demo", "demo", "uvicorn", "starlette", "structlog", "prometheus_client", "scipy", "pyarrow")
    from optipmb_client.zenoh import Connection  # noqa: PLC0415  as above

    from optipmb_tools.datasets import Preloaded, open_dataset  # noqa: PLC0415  packages of this command alone
    from optipmb_tools.evaluation import combine, default_rules, evaluate_files  # noqa: PLC0415  as above
    from optipmb_tools.run.replay import Replaying, ReplayPace, replay  # noqa: PLC0415  as above
    from optipmb_tools.run.service_process import ServiceProcess  # noqa: PLC0415  as above
    from optipmb_tools.views.pictures import draw_results  # noqa: PLC0415  as above

    pace, table = speed_of(speed), out / "tracks.csv"
    with FrameProgress("replaying", frames) as progress:
        dataset = open_dataset("scene", frames=frames, seed=SEED)
        progress.note(f"generating {frames / 10:.0f} s of traffic")
        (scene,) = dataset.sequences(["0000"])
        sequence = Preloaded(scene)  # generating takes the processor's time, which would show in the latencies
        progress.note("starting the service (the first time, it compiles for up to a minute)")
        with ServiceProcess(
            log=out / "service.log", environment={"OPTIPMB_CLOUD_WAIT_S": str(CLOUD_WAIT_S)}
        ) as service:
            service.wait_until_ready(START_S)
            rate = "frame by frame" if pace is None else f"{pace:g} times as fast as recorded"
            progress.note(f"replaying through {service.endpoint}, {rate}")
            how = Replaying(dataset.profile, ReplayPace(speed=pace, window=1, patience_s=PATIENCE_S))
            with Connection(service.endpoint) as connection:
                (replayed,) = replay(connection, dataset, [sequence], table, how, progress.advance)
        progress.note("comparing the tracks with the truth, drawing them")
        results = evaluate_files([sequence], table, sequence.labels, default_rules(dataset.name))
        figures = combine(result.shown for result in results)
        pictures = [out / "tracks.png", out / "tracks.gif"]
        try:
            for one in pictures:
                draw_results(one, sequence, [table], [results])
        except ClientError as error:  # pictures are worth having, not worth failing for
            progress.note(str(error))
            pictures = []
    shown = {
        "command": "demo",
        "frames": replayed.frames,
        "returned": replayed.returned,
        "missing": replayed.missing,
        "clouds_missed": replayed.clouds_missed,
        "tracks": replayed.tracks,
        "latency": replayed.latency,
        **figures.summary(),
        "file": replayed.file,
        "picture": pictures[0] if pictures else None,
        "animation": pictures[1] if pictures else None,
    }
    lines = [f"frames    {replayed.returned} of {replayed.frames} tracked, {replayed.clouds} with a point cloud"]
    if (found := replayed.latency) is not None:
        lines.append(f"latency   p50 {found.p50_ms:.1f} ms, p99 {found.p99_ms:.1f} ms, from publishing to receiving")
    lines.append(
        f"tracks    {figures.objects} objects, {figures.switches} id switches, MOTA "
        f"{100 * figures.mota:.1f} %, precision {100 * figures.precision:.1f} %, recall {100 * figures.recall:.1f} %"
    )
    lines.append(f"files     {replayed.file}: all tracks, a row for each in each frame")
    lines += [f"          {one}: the confirmed tracks" for one in pictures]
    report(shown, *lines, as_json=as_json)
    complain([replayed])


def _show_live(frames: int, *, browser: bool) -> None:
    """Send a scene through a service, in a loop at its own rate, until Ctrl-C."""
    needed("optipmb demo --live", "service", "uvicorn", "starlette", "structlog", "prometheus_client")
    from optipmb_client.zenoh import Connection  # noqa: PLC0415  packages of this command alone

    from optipmb_tools.datasets import open_dataset  # noqa: PLC0415  as above
    from optipmb_tools.run.service_process import ServiceProcess, free_port  # noqa: PLC0415  as above

    place = f"127.0.0.1:{free_port()}"
    page = f"http://{place}/#{quote(STREAM, safe='/')}"
    with (
        contextlib.suppress(KeyboardInterrupt),
        Console(stderr=True).status("starting a service (the first time it compiles, for up to a minute)") as status,
        ServiceProcess(["--http", place]) as service,
    ):
        (scene,) = open_dataset("scene", frames=frames, seed=SEED, clouds=0).sequences(["0000"])
        seen = list(scene.frames())
        service.wait_until_ready(START_S)
        say(f"live page: {page}")
        if browser and ("DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ):
            webbrowser.open(page)
        with Connection(service.endpoint) as connection:
            for number in itertools.count(1):
                status.update(f"sending {frames / 10:.0f} s of a generated street, time {number}; Ctrl-C ends it")
                drive(connection, seen)


def drive(connection: "Connection", frames: "Sequence[DetectionFrame]") -> None:
    """Publish frames once, each at its time, in a session of their own."""
    from optipmb_client.publisher import Publisher  # noqa: PLC0415  packages of this command alone
    from optipmb_client.sessions import close_session, set_parameters  # noqa: PLC0415  as above
    from optipmb_schemas import SessionParameters  # noqa: PLC0415  as above

    with Publisher(STREAM, connection=connection) as publisher:
        set_parameters(connection, STREAM, SessionParameters(profile="scene"))
        begun = time.time_ns() - frames[0].stamp_ns
        for one in frames:
            time.sleep(max(0.0, (begun + one.stamp_ns - time.time_ns()) / 1e9))
            publisher.publish(stamp_ns=begun + one.stamp_ns, labels=one.labels, pose=one.pose, **one.columns)
    close_session(connection, STREAM)
