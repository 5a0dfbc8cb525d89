"""`optipmb replay`: a data set through the service."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.errors import UsageError
from optipmb_client.links import linked

from optipmb_tools.commands.options import AsJson, Classes, DataOptions, Digits, Full, Out, Profile, report, warn
from optipmb_tools.commands.service_options import PaceOptions, ServiceOptions
from optipmb_tools.results.exports import check_export
from optipmb_tools.results.output import latency
from optipmb_tools.run.replay import ReplayedSequence, Replaying
from optipmb_tools.run.replay import replay as replay_sequences
from optipmb_tools.views.progress import FrameProgress


@dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """Options of a replay."""

    out: Out = Path("out/replay")
    profile: Profile = None
    classes: Classes = None
    full: Full = False
    digits: Digits = "unit"


def replay(
    data: DataOptions,
    *,
    how: ReplayOptions,
    service: ServiceOptions,
    pace: PaceOptions,
    streams: Annotated[int, typer.Option(min=1, help="Sequences sent at the same time.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Send a dataset through a running service, collect the tracks, and write its result files.

    The profile is one that the service knows. Ends with status 1 when tracks of some frames did not come back.
    """
    chosen_pace = pace.pace()
    opened = data.open(digits=how.digits)
    check_export(how.out, opened.dataset, len(opened.sequences))
    name = how.profile or opened.dataset.profile
    if how.profile == "auto":
        raise UsageError("--profile: one that the service knows, such as generic; auto is made for offline tracking")
    if name == "auto":
        name = "generic"
        warn("profile generic, which is auto at 10 Hz (--profile NAME, see: optipmb profiles)")
    replaying = Replaying(name, chosen_pace, how.classes or (), streams, service.prefix, how.full)
    with (
        closing(linked(service.connect, config=service.config, timeout=pace.wait)) as connection,
        FrameProgress("replaying", opened.frames) as progress,
    ):
        results = replay_sequences(connection, opened.dataset, opened.sequences, how.out, replaying, progress.advance)
    shown = {
        "command": "replay",
        "dataset": opened.name,
        "profile": name,
        "out": how.out,
        "missing": sum(result.missing for result in results),
        "latency": latency([ns for result in results for ns in result.latencies_ns]),
        "sequences": [_summary(result) for result in results],
    }
    report(shown, *map(_line, results), f"results in {how.out}", as_json=as_json)
    complain(results)


def complain(results: Sequence[ReplayedSequence]) -> None:
    """Print problems of the results on standard error, and exit with status 1 if there are any."""
    missing = sum(result.missing for result in results)
    clouds = sum(result.clouds_missed for result in results)
    if missing:
        warn(f"{missing} of {sum(result.frames for result in results)} frames have no tracks")
    if clouds:
        warn(f"{clouds} frames were tracked without the point cloud that was sent")
    for result in results:
        for problem in result.newest_problems[-1:]:
            warn(f"{result.name}: {result.problems} problems reported, the newest: {problem.message}")
    if missing or clouds:
        raise typer.Exit(1)


def _line(result: ReplayedSequence) -> str:
    text = f"{result.name}: {result.sent} frames sent, {result.returned} returned, {result.tracks} tracks"
    if result.latency is not None:
        text += f", latency p50 {result.latency.p50_ms:.1f} ms p99 {result.latency.p99_ms:.1f} ms"
    return f"{text}, {result.returned / max(result.seconds, 1e-9):.0f} frames/s"


_SHOWN = (
    *("name", "stream", "file", "frames", "sent", "returned", "missing", "clouds", "clouds_missed", "tracks"),
    *("seconds", "latency", "problems"),
)


def _summary(result: ReplayedSequence) -> dict[str, object]:
    problems = [{"code": problem.code, "message": problem.message} for problem in result.newest_problems]
    return {name: getattr(result, name) for name in _SHOWN} | {"newest_problems": problems}
