"""The demonstration: a real service as a child process, a generated scene replayed through it, and what came of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from optipmb_client.child import ServiceProcess
from optipmb_client.datasets import open_dataset
from optipmb_client.drawing import draw_results
from optipmb_client.errors import ClientError
from optipmb_client.evaluation import ClearResult, combine, default_rules, evaluate_files
from optipmb_client.recording import Preloaded
from optipmb_client.replay import Pace, ReplayedSequence, replay
from optipmb_client.zenoh import Connection

START_S = 300.0  # the first start after an installation compiles
PATIENCE_S = 20.0
SEED = 4  # of the scene
CLOUD_WAIT_S = 5.0  # all clouds are sent; on a busy machine one may be late


@dataclass(frozen=True)
class Demonstration:
    """What the demonstration gave.

    Attributes:
        replayed: The replay: frames, latencies, file of the tracks.
        figures: All classes together, tracks below the best threshold of their class left out.
        picture: View of the tracks from above; None where matplotlib is not installed.
    """

    replayed: ReplayedSequence
    figures: ClearResult
    picture: Path | None


def demonstrate(
    out: Path, *, frames: int, speed: float | None, on_stage: Callable[[str], None], on_frame: Callable[[], None]
) -> Demonstration:
    """Start a service, replay one scene through it, end it, and judge the tracks.

    `speed` is a multiple of real time; None: each frame goes out when the tracks of the one before have come back.
    `on_stage` is called with what comes next, `on_frame` when a frame has come back.

    Raises:
        ServiceUnavailable: The service did not start.
    """
    dataset = open_dataset("scene", frames=frames, seed=SEED)
    on_stage(f"generating {frames / 10:.0f} s of traffic")
    (scene,) = dataset.sequences(["0000"])
    sequence = Preloaded(scene)  # generating takes the processor's time, which would show in the latencies
    on_stage("starting the service (the first time, it compiles for up to a minute)")
    with ServiceProcess(log=out / "service.log", environment={"OPTIPMB_CLOUD_WAIT_S": str(CLOUD_WAIT_S)}) as service:
        service.wait_until_ready(START_S)
        rate = "frame by frame" if speed is None else f"{speed:g} times as fast as recorded"
        on_stage(f"replaying through {service.endpoint}, {rate}")
        with Connection(service.endpoint) as connection:
            (replayed,) = replay(
                connection,
                dataset,
                [sequence],
                out,
                profile=dataset.profile,
                pace=Pace(speed=speed, window=1, patience_s=PATIENCE_S),
                on_frame=on_frame,
            )
    on_stage("comparing the tracks with the truth, drawing them")
    results = evaluate_files([sequence], out, sequence.labels, default_rules(dataset.name))
    figures = combine(result.sweep.results[result.sweep.best] for result in results)
    picture: Path | None = out / "tracks.png"
    try:
        draw_results(out / "tracks.png", sequence, [out], [results])
    except ClientError as error:  # the picture is worth having, not worth failing for
        on_stage(str(error))
        picture = None
    return Demonstration(replayed, figures, picture)
