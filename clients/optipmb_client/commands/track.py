"""`optipmb track`: a dataset through the tracker, in this process; or what a service saved when tracking failed."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from optipmb_client.commands.options import (
    AsJson,
    Classes,
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
from optipmb_client.datasets import DATASETS, DataSequence, dataset_at
from optipmb_client.errors import TrackingFailed, UsageError
from optipmb_client.progress import FrameProgress


def track(  # noqa: PLR0913  these are the command's options
    path: Annotated[
        Path | None,
        typer.Argument(help="A bag of ROS 2 or a recording, in place of --dataset and --root.", show_default=False),
    ] = None,
    *,
    dataset: Annotated[
        str | None, typer.Option("--dataset", help=f"Layout of the data: {', '.join(DATASETS)}.", show_default=False)
    ] = None,
    root: Root = None,
    detections: Detections = None,
    sequences: Sequences = None,
    option: Options = None,
    out: Out = Path("out/track"),
    profile: Profile = None,
    classes: Classes = None,
    full: Full = False,
    keep_input: Annotated[
        bool, typer.Option("--keep-input", help="Of a bag, with --out FILE.mcap: also copy what is in it.")
    ] = False,
    dump: Annotated[
        Path | None, typer.Option("--dump", help="What a service saved of a stream when tracking it failed.")
    ] = None,
    trace: Annotated[bool, typer.Option("--trace", help="With --dump: also print where the error was raised.")] = False,
    as_json: AsJson = False,
) -> None:
    """Track a dataset or a file in this process, without a service, and write its result files.

    From a bag of ROS 2, --out FILE.mcap makes a bag with the tracks as TrackedObjects, Detection3DArray and markers.

    A profile may also be a TOML file here. Replaying the same data through a service gives the same files.

    With --dump, the frames that a service saved are gone through once more instead. Status 1 and one line say which
    of them raises which error; status 0 that none does any more.
    """
    if dump is not None:
        _replay_dump(dump, trace=trace, as_json=as_json)
        return
    if path is not None:
        if dataset is not None or root is not None:
            raise UsageError("expected a path, or --dataset and --root, received both")
        dataset, root = dataset_at(path), path
    if dataset is None:
        raise UsageError("expected a path, --dataset or --dump, received none")
    from optipmb_client import offline  # noqa: PLC0415  loads the tracker and its compiler

    if keep_input:
        option = [*(option or ()), "keep_input=1"]
    opened, chosen = open_sequences(dataset, root, detections, sequences, option)
    _check_out(out, dataset, chosen)
    name = profile or opened.profile
    offline.read_profile(name)  # a wrong one is told before anything is shown
    for note in (note for sequence in chosen for note in getattr(sequence, "notes", ())):
        typer.echo(f"optipmb: {note}", err=True)
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


def _check_out(out: Path, dataset: str, chosen: Sequence[DataSequence]) -> None:
    """A bag of tracks is one file, and holds those of one topic of a bag."""
    if out.suffix != ".mcap":
        return
    if dataset != "rosbag":
        raise UsageError(f"--out {out}: expected a folder, for only tracks of a bag are written as a bag")
    if len(chosen) > 1:
        names = " ".join(sequence.name for sequence in chosen)
        raise UsageError(f"--out {out}: expected one of the bag's topics by --sequences, received {names}")


def _replay_dump(file: Path, *, trace: bool, as_json: bool) -> None:
    from optipmb_client import dumps  # noqa: PLC0415  loads the tracker and its compiler

    result = dumps.replay(dumps.read(file))
    if as_json:
        print_json({"command": "track", "dump": file, "result": result})
    if result.error is None:
        say(f"{result.stream}: {result.frames} frames without an error; saved was {result.saved}")
        return
    if trace:
        print(result.trace, file=sys.stderr)  # noqa: T201  it was asked for
    again = "the saved error again" if result.same else f"another error than the saved one ({result.saved})"
    raise TrackingFailed(f"{result.stream}: frame {result.seq}, stamp {result.stamp_ns} ns: {result.error}: {again}")
