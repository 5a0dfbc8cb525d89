"""`optipmb demo`: everything once, on this machine, without data."""

from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.errors import ClientError

from optipmb_tools.commands.options import AsJson, Out, report
from optipmb_tools.commands.replay import complain
from optipmb_tools.commands.service_options import Speed, speed_of
from optipmb_tools.extras import needed
from optipmb_tools.views.progress import FrameProgress

START_S = 300.0  # the first start after an installation compiles
PATIENCE_S = 20.0
SEED = 4  # of the scene
CLOUD_WAIT_S = 5.0  # all clouds are sent; on a busy machine one may be late


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
    from optipmb_client.zenoh import Connection  # noqa: PLC0415  as above

    from optipmb_tools.datasets import Preloaded, open_dataset  # noqa: PLC0415  packages of this command alone
    from optipmb_tools.evaluation import combine, default_rules, evaluate_files  # noqa: PLC0415  as above
    from optipmb_tools.run.replay import Pace, Replaying, replay  # noqa: PLC0415  as above
    from optipmb_tools.run.service_process import ServiceProcess  # noqa: PLC0415  as above
    from optipmb_tools.views.pictures import draw_results  # noqa: PLC0415  as above

    pace = speed_of(speed)
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
            how = Replaying(dataset.profile, Pace(speed=pace, window=1, patience_s=PATIENCE_S))
            with Connection(service.endpoint) as connection:
                (replayed,) = replay(connection, dataset, [sequence], out, how, progress.advance)
        progress.note("comparing the tracks with the truth, drawing them")
        results = evaluate_files([sequence], out, sequence.labels, default_rules(dataset.name))
        figures = combine(result.sweep.results[result.sweep.best] for result in results)
        pictures = [out / "tracks.png", out / "tracks.gif"]
        try:
            for one in pictures:
                draw_results(one, sequence, [out], [results], numbered=True)
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
        f"tracks    {figures.objects} objects, MOTA {figures.mota:.3f}, {figures.switches} id switches, "
        f"precision {figures.precision:.3f}, recall {figures.recall:.3f}"
    )
    lines.append(f"files     {replayed.file}: the tracks, a line for each box, in the format of KITTI's results")
    lines += [f"          {one}: the tracks that are worth showing, numbered from 1" for one in pictures]
    report(shown, *lines, as_json=as_json)
    complain([replayed])
