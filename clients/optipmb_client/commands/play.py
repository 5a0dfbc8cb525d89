"""`optipmb play`: a recording into a service."""

import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optipmb_client.commands.options import AsJson, Full, mcap_needed, print_json, say, warn
from optipmb_client.commands.service_options import PaceOptions, ServiceOptions
from optipmb_client.datasets import open_dataset
from optipmb_client.progress import FrameProgress
from optipmb_client.recording import Results

if TYPE_CHECKING:
    from optipmb_client.mcap_files.play import PlayedStream


def play(  # noqa: PLR0913  these are the command's options
    file: Annotated[Path, typer.Argument(help="The MCAP file, as `optipmb record` writes it.", show_default=False)],
    *,
    streams: Annotated[
        list[str] | None, typer.Option("--streams", metavar="NAME...", help="Only these streams.", show_default=False)
    ] = None,
    as_recorded: Annotated[
        bool,
        typer.Option(
            "--as-recorded", help="Play under the recorded names: only into a service that does nothing else."
        ),
    ] = False,
    profile: Annotated[
        str | None, typer.Option("--profile", help="Parameter profile; default: what was in force.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for result files of the tracks.")] = None,
    full: Full = False,
    service: ServiceOptions,
    pace: PaceOptions,
    as_json: AsJson = False,
) -> None:
    """Play a recording into a running service and compare the tracks with the recorded ones, byte for byte.

    Streams get names of their own (`play-<6 hex>-...`) unless they are to be played as recorded. The comparison leaves
    out the names of stream and session, and `delivery`. Ends with status 1 when tracks do not come back, or come back
    different.
    """
    with mcap_needed():
        from optipmb_client.mcap_files.play import choose  # noqa: PLC0415  as above
        from optipmb_client.mcap_files.play import play as play_streams  # noqa: PLC0415  as above
        from optipmb_client.mcap_files.reading import RecordingFile  # noqa: PLC0415  packages of an extra
    chosen_pace = pace.pace()
    recording = RecordingFile(file)
    plans = choose(recording, streams or ())
    if recording.cut:
        typer.echo(f"optipmb: {file} was cut off; everything up to the cut is played", err=True)
    with (
        service.connection(pace.wait) as connection,
        FrameProgress("playing", sum(len(one.frames) for one in plans.values())) as progress,
    ):
        results = play_streams(
            connection,
            recording,
            plans,
            pace=chosen_pace,
            site=None if as_recorded else f"play-{secrets.token_hex(3)}",
            profile=profile,
            prefix=service.prefix,
            on_frame=progress.advance,
        )
    if out is not None:
        dataset = open_dataset("mcap", file)
        files = Results(dataset, out, full=full)
        sequences = dataset.sequences([result.name for result in results])
        for result, sequence in zip(results, sequences, strict=True):
            indexed = {
                index: result.tracks[frame]
                for index, frame in enumerate(plans[result.name].frames)
                if frame in result.tracks
            }
            files.take(sequence, files.write(sequence, indexed))
        files.close(sequences)
    if as_json:
        print_json({"command": "play", "cut": recording.cut, "out": out, "streams": [_summary(one) for one in results]})
    else:
        for result in results:
            say(_line(result))
    _complain(results)


def _complain(results: "list[PlayedStream]") -> None:
    wrong = False
    for result in results:
        for reason in _reasons(result):
            warn(f"{result.name}: {reason}")
        if result.first_difference is not None:
            differ = f"{result.recorded - result.equal} of {result.recorded} frames differ from the recorded ones"
            warn(f"{result.name}: {differ}, the first is number {result.first_difference}")
        if not result.recorded and result.returned < result.frames:
            warn(f"{result.name}: {result.frames - result.returned} of {result.frames} frames have no tracks")
        wrong |= result.first_difference is not None or (not result.recorded and result.returned < result.frames)
    if wrong:
        raise typer.Exit(1)


def _reasons(result: "PlayedStream") -> Iterator[str]:
    """Yield why tracks may differ from the recorded ones."""
    if result.clouds_lost:
        yield f"{result.clouds_lost} clouds are missing in the recording"
    if result.other_values:
        yield f"profile {result.profile} here has other values than what was in force"
    if result.first_difference is None:
        return
    if result.first_id > 1:
        yield (
            f"this service has tracked {result.stream} before, so ids begin at {result.first_id}: "
            "play it without --as-recorded, or into another service"
        )
    if result.begins_late:
        yield "the recording begins in the middle of a session: ids and the first seconds differ"
    if result.never_tracked:
        yield f"{result.never_tracked} frames were not tracked when it was recorded"


def _line(result: "PlayedStream") -> str:
    text = f"{result.name} as {result.stream}: {result.returned} of {result.frames} frames returned"
    if result.recorded:
        text += f", {result.equal} of {result.recorded} equal to the recorded tracks"
    if result.latency is not None:
        text += f", latency p50 {result.latency.p50_ms:.1f} ms p99 {result.latency.p99_ms:.1f} ms"
    return text


def _summary(result: "PlayedStream") -> dict[str, Any]:
    problems = [{"code": problem.code, "message": problem.message} for problem in result.newest_problems]
    left_out = {"tracks", "newest_problems"}
    return {name: value for name, value in vars(result).items() if name not in left_out} | {"newest_problems": problems}
