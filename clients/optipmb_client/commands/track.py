"""`optipmb track`: a dataset through the tracker, in this process; or what a service saved when tracking failed."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optipmb_client.commands.options import (
    AsJson,
    Classes,
    DataOptions,
    Full,
    Out,
    Profile,
    Ray,
    executor_of,
    open_sequences,
    print_json,
    say,
    warn,
)
from optipmb_client.errors import TrackingFailed, UsageError
from optipmb_client.progress import FrameProgress
from optipmb_client.results.nuscenes import NUSCENES_MAX_BOXES
from optipmb_client.table_files import is_table

if TYPE_CHECKING:
    from collections.abc import Sequence as Many

    from optipmb_client.datasets import DataSequence
    from optipmb_client.tracking import TrackedSequence


def track(  # noqa: PLR0913  these are the command's options
    data: DataOptions,
    *,
    out: Out = Path("out/track"),
    profile: Profile = None,
    classes: Classes = None,
    full: Full = False,
    smooth: Annotated[
        bool,
        typer.Option("--smooth", help="Estimate every state from all frames of its track, later ones too: for labels."),
    ] = False,
    fuse: Annotated[
        bool,
        typer.Option("--fuse", help="The sensors of a recording feed one density, by turns: by the column sensor."),
    ] = False,
    keep_input: Annotated[
        bool, typer.Option("--keep-input", help="Of a bag, with --out FILE.mcap: also copy what is in it.")
    ] = False,
    submission: Annotated[
        str | None,
        typer.Option(metavar="[SCORE]", help="Write a submission; of KITTI confirmed tracks from this mean score on."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Recordings at once; default: one for each processor.", show_default=False)
    ] = None,
    ray: Ray = None,
    dump: Annotated[
        Path | None, typer.Option("--dump", help="What a service saved of a stream when tracking it failed.")
    ] = None,
    trace: Annotated[bool, typer.Option("--trace", help="With --dump: also print where the error was raised.")] = False,
    as_json: AsJson = False,
) -> None:
    """Track your data on this machine, without a service: optipmb track detections.csv --out tracks.csv.

    From a bag of ROS 2, --out FILE.mcap makes a bag with the tracks as TrackedObjects, Detection3DArray and markers.

    A profile may also be a TOML file here. Replaying the same data through a service gives the same files.
    With --smooth, positions, headings and velocities also use later frames, which no service can.

    With --dump, the frames that a service saved are gone through once more instead. Status 1 and one line say which
    of them raises which error; status 0 that none does any more.
    """
    if dump is not None:
        _replay_dump(dump, trace=trace, as_json=as_json)
        return
    from optipmb_client import offline, tracking  # noqa: PLC0415  loads the tracker and its compiler

    flags = {"keep_input": keep_input and 1, "fuse": fuse and 1, "submission": submission}
    asked = data.asked(*(f"{name}={given}" for name, given in flags.items() if given))
    opened, chosen = open_sequences(asked, data.sequences)
    _check_out(out, asked.name, chosen, alone=submission is not None, full=full)
    name = profile or opened.profile
    parameters = offline.profile_for(name, chosen)
    for doubt in offline.doubts(parameters, chosen):
        warn(doubt)
    if name == offline.AUTO:
        warn(f"profile auto: {parameters.provenance}")
    results = []
    failed = None
    try:
        with (
            FrameProgress("tracking", sum(map(len, chosen))) as progress,
            executor_of(jobs, ray, chosen, len(chosen)) as executor,
        ):
            for result in tracking.track(
                opened,
                chosen,
                out,
                data=asked,
                parameters=parameters,
                classes=classes or (),
                full=full,
                smooth=smooth,
                executor=executor,
                on_frame=progress.advance,
                note=lambda text: progress.note(f"optipmb: {text}"),
            ):
                results.append(result)
                if not as_json:
                    _say_result(result)
    except tracking.RecordingsFailed as error:
        failed = error
    if as_json:
        report = {"command": "track", "dataset": asked.name, "profile": name, "out": out, "sequences": results}
        reasons = {} if failed is None else {name: one.reason for name, one in failed.failures.items()}
        print_json({**report, "failed": reasons})
    else:
        say(f"results in {out}")
    if failed is not None:
        raise failed
    _complain(results, parameters.name)


def _say_result(result: "TrackedSequence") -> None:
    rate = result.frames / max(result.seconds, 1e-9)
    step = f", step p50 {result.step.p50_ms:.2f} ms p99 {result.step.p99_ms:.2f} ms" if result.step else ""
    others = result.tracks - result.confirmed
    counts = f"{result.confirmed} tracks" + (f" and {others} never confirmed" if others else "")
    say(f"{result.name}: {result.frames} frames, {counts}, {rate:.0f} frames/s{step}")


def _complain(results: "list[TrackedSequence]", profile: str) -> None:
    """Say what was left out; end with status 1 when there were detections and not one track came of them."""
    detections = sum(one.detections for one in results)
    left_out: Counter[str] = sum((Counter(one.left_out) for one in results), Counter())
    if left_out:
        named = ", ".join(f"{count} {name}" for name, count in sorted(left_out.items()))
        warn(f"{left_out.total()} of {detections} detections are left out with profile {profile}: {named}")
    if estimated := sum(one.estimated for one in results):
        frames = sum(one.frames for one in results)
        warn(f"the motion of the sensor is estimated in {estimated} of {frames} frames: boxes have no poses")
    cut, samples = map(sum, zip(*(one.cut for one in results), strict=True))
    if cut:
        warn(f"{cut} boxes in {samples} samples are not written: a sample of nuScenes has {NUSCENES_MAX_BOXES} at most")
    if detections and not any(one.tracks for one in results):
        warn(f"no tracks came of {detections} detections: do their scores and rate fit profile {profile}?")
        raise typer.Exit(1)


def _check_out(out: Path, dataset: str, chosen: "Many[DataSequence]", *, alone: bool, full: bool) -> None:
    """A submission has files of its own; a bag of tracks is one file, and holds those of one topic of a bag."""
    if alone and (full or is_table(out)):
        raise UsageError("--submission: expected a folder as --out, and no --full: the files are for the benchmark")
    if out.suffix != ".mcap":
        return
    if dataset != "rosbag":
        raise UsageError(f"--out {out}: expected a folder, or a table: only tracks of a bag are written as a bag")
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
