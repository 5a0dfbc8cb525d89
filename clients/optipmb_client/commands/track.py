"""`optipmb track`: a dataset through the tracker, in this process."""

from pathlib import Path

from optipmb_client.commands.options import (
    AsJson,
    Classes,
    DatasetName,
    Detections,
    Full,
    Options,
    Out,
    Profile,
    Root,
    Sequences,
    open_sequences,
    print_json,
    say,
)
from optipmb_client.progress import FrameProgress


def track(  # noqa: PLR0913  these are the command's options
    *,
    dataset: DatasetName,
    root: Root = None,
    detections: Detections = None,
    sequences: Sequences = None,
    option: Options = None,
    out: Out = Path("out/track"),
    profile: Profile = None,
    classes: Classes = None,
    full: Full = False,
    as_json: AsJson = False,
) -> None:
    """Track a dataset in this process, without a service, and write its result files.

    A profile may also be a TOML file here. Replaying the same data through a service gives the same files.
    """
    from optipmb_client import offline  # noqa: PLC0415  loads the tracker and its compiler

    opened, chosen = open_sequences(dataset, root, detections, sequences, option)
    name = profile or opened.profile
    offline.read_profile(name)  # a wrong one is told before anything is shown
    results = []
    with FrameProgress("tracking", sum(map(len, chosen))) as progress:
        for result in offline.track(
            opened, chosen, out, profile=name, classes=classes or (), full=full, on_frame=progress.advance
        ):
            results.append(result)
            if not as_json:
                rate = result.frames / max(result.seconds, 1e-9)
                step = f", step p50 {result.step.p50_ms:.2f} ms p99 {result.step.p99_ms:.2f} ms" if result.step else ""
                say(f"{result.name}: {result.frames} frames, {result.tracks} tracks, {rate:.0f} frames/s{step}")
    if as_json:
        print_json({"command": "track", "dataset": dataset, "profile": name, "out": out, "sequences": results})
    else:
        say(f"results in {out}")
