"""`optipmb record` and `optipmb play`: streams into an MCAP file, and a recording into a service."""

import contextlib
import secrets
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from optipmb_client.errors import UsageError

from optipmb_tools.commands.options import AsJson, Digits, Full, print_json, report, say, warn
from optipmb_tools.commands.service_options import PaceOptions, ServiceOptions
from optipmb_tools.extras import needed
from optipmb_tools.views.progress import FrameProgress, StatusLine

if TYPE_CHECKING:
    from optipmb_tools.recordings.play import PlayedStream
    from optipmb_tools.recordings.record import Recording


def record(
    *,
    out: Annotated[Path, typer.Option("--out", help="The MCAP file; it must not be there yet.")],
    streams: Annotated[
        list[str] | None,
        typer.Option("--streams", metavar="NAME...", help="Streams, `*` stands for any name. Default: all."),
    ] = None,
    points: Annotated[bool, typer.Option(help="Record the point clouds too.")] = True,
    duration: Annotated[
        float | None, typer.Option(min=0.1, help="End after so many seconds. Default: at SIGINT or SIGTERM.")
    ] = None,
    service: ServiceOptions,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router.")] = 5.0,
    as_json: AsJson = False,
) -> None:
    """Record everything on the keys of streams: detections, clouds, tracks, problems, and the parameters in force.

    The file opens in Foxglove, which draws the tracks, and plays back with `optipmb play`. It is written out every
    second, so that a recording that is killed still opens.
    """
    needed("recordings", "record", "mcap", need="need")
    from optipmb_tools.recordings.record import Wanted  # noqa: PLC0415  packages of an extra
    from optipmb_tools.recordings.record import record as record_streams  # noqa: PLC0415  as above

    stop = threading.Event()
    if out.exists():
        raise UsageError(f"--out: expected a new file, there is {out} already")
    wanted = Wanted(streams or ["*/*/*"], points, duration, service.prefix)
    with service.connection(timeout) as connection, _ended_by(stop), StatusLine() as progress:
        result = record_streams(
            connection, out, wanted, stop=stop, on_flush=lambda so_far: progress.show(_progress(so_far, duration))
        )
    if as_json:
        print_json({"command": "record", **vars(result)})
        return
    for name, counts in sorted(result.streams.items()):
        say(f"{name}: " + ", ".join(f"{count} {topic}" for topic, count in sorted(counts.items())))
    say(f"{result.messages} messages in {result.seconds:.0f} s, {result.size / 1e6:.1f} MB in {out}")
    if result.dropped:
        warn(f"{result.dropped} messages were lost, the disk is too slow")
        raise typer.Exit(1)


def _progress(so_far: "Recording", duration: float | None) -> str:
    rate = so_far.messages / max(so_far.seconds, 1e-9)
    left = "" if duration is None else f", {max(0.0, duration - so_far.seconds):.0f} s left"
    return f"recording: {so_far.messages} messages, {rate:.0f} per second, {so_far.size / 1e6:.1f} MB{left}"


@contextlib.contextmanager
def _ended_by(stop: threading.Event) -> Iterator[None]:
    """Let SIGINT and SIGTERM set an event: they are how a recording ends, not errors."""
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(frozen=True, kw_only=True)
class PlayOptions:
    """Options of playing."""

    streams: Annotated[
        list[str] | None, typer.Option("--streams", metavar="NAME...", help="Only these streams.", show_default=False)
    ] = None
    as_recorded: Annotated[
        bool,
        typer.Option(
            "--as-recorded", help="Play under the recorded names: only into a service that does nothing else."
        ),
    ] = False
    profile: Annotated[str | None, typer.Option("--profile", help="Parameter profile; default: what was in force.")] = (
        None
    )
    out: Annotated[Path | None, typer.Option("--out", help="Folder for result files of the tracks.")] = None
    full: Full = False
    digits: Digits = "unit"


def play(
    file: Annotated[Path, typer.Argument(help="The MCAP file, as `optipmb record` writes it.", show_default=False)],
    *,
    how: PlayOptions,
    service: ServiceOptions,
    pace: PaceOptions,
    as_json: AsJson = False,
) -> None:
    """Play a recording into a running service and compare the tracks with the recorded ones, byte for byte.

    Streams get names of their own (`play-<6 hex>-...`) unless they are to be played as recorded. The comparison leaves
    out the names of stream and session, and `delivery`. Ends with status 1 when tracks do not come back, or come back
    different.
    """
    needed("recordings", "record", "mcap", need="need")
    from optipmb_tools.recordings.play import Playing, choose  # noqa: PLC0415  as above
    from optipmb_tools.recordings.play import play as play_streams  # noqa: PLC0415  as above
    from optipmb_tools.recordings.recording_file import RecordingFile  # noqa: PLC0415  packages of an extra

    chosen_pace = pace.pace()
    recording = RecordingFile(file)
    plans = choose(recording, how.streams or ())
    if recording.cut:
        warn(f"{file} was cut off; everything up to the cut is played")
    site = None if how.as_recorded else f"play-{secrets.token_hex(3)}"
    with (
        service.connection(pace.wait) as connection,
        FrameProgress("playing", sum(len(one.frames) for one in plans.values())) as progress,
    ):
        playing = Playing(chosen_pace, site, how.profile, service.prefix, progress.advance)
        results = play_streams(connection, recording, plans, playing)
    if how.out is not None:
        _write(file, how.out, results, {name: list(one.frames) for name, one in plans.items()}, how)
    shown = {"command": "play", "cut": recording.cut, "out": how.out, "streams": [_summary(one) for one in results]}
    report(shown, *map(_line, results), as_json=as_json)
    wrong = False
    for result in results:
        for reason in _reasons(result):
            warn(f"{result.name}: {reason}")
        if result.first_difference is not None:
            differ = f"{result.recorded - result.equal} of {result.recorded} frames differ from the recorded ones"
            warn(f"{result.name}: {differ}, the first is number {result.first_difference}")
        lost = 0 if result.recorded else result.frames - result.returned
        if lost:
            warn(f"{result.name}: {lost} of {result.frames} frames have no tracks")
        wrong |= result.first_difference is not None or lost > 0
    if wrong:
        raise typer.Exit(1)


def _write(
    file: Path, out: Path, results: "list[PlayedStream]", frames: dict[str, list[tuple[bytes, int]]], how: PlayOptions
) -> None:
    from optipmb_tools.datasets import open_dataset  # noqa: PLC0415  only with --out
    from optipmb_tools.results.exports import check_export  # noqa: PLC0415  as above
    from optipmb_tools.results.output import Results  # noqa: PLC0415  as above

    dataset = open_dataset("mcap", file, digits=how.digits)
    check_export(out, dataset, len(results))
    files = Results(dataset, out, full=how.full)
    sequences = dataset.sequences([result.name for result in results])
    for result, sequence in zip(results, sequences, strict=True):
        known = enumerate(frames[result.name])
        files.take(
            sequence, files.write(sequence, {index: result.tracks[one] for index, one in known if one in result.tracks})
        )
    files.close(sequences)


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
