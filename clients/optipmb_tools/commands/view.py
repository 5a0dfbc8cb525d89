"""`optipmb watch` and `optipmb plot`: streams or a recording in Rerun or Foxglove, and pictures of tracks."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.errors import UsageError
from optipmb_schemas import Density, Detections, Keys, Message, MessageError, Points, Problem, Topic, Tracks, decode

from optipmb_tools.commands.options import All, AsJson, LabelledOptions, report, say
from optipmb_tools.commands.service_options import ServiceOptions, speed_of
from optipmb_tools.extras import needed
from optipmb_tools.table_files import SUFFIXES

TOPICS: tuple[Topic, ...] = ("tracks", "detections", "problems", "points")
KINDS: dict[str, type[Message]] = {
    "tracks": Tracks,
    "detections": Detections,
    "points": Points,
    "problems": Problem,
    "density": Density,
}
WAITING = 32  # messages; a viewer that is too slow loses the oldest
TICK_S = 0.2


@dataclass(frozen=True, kw_only=True)
class WatchOptions:
    """Options of the content and of the viewer."""

    streams: Annotated[
        list[str] | None,
        typer.Option("--streams", metavar="NAME...", help="Streams, `*` stands for any name. Default: all."),
    ] = None
    points: Annotated[bool, typer.Option(help="Show the point clouds too.")] = True
    poisson: Annotated[
        bool, typer.Option("--poisson", help="Ask the service where it expects objects not yet detected, and show it.")
    ] = False

    web: Annotated[bool, typer.Option("--web", help="Serve the viewer to a browser instead of opening a window.")] = (
        False
    )
    web_port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page, with --web.")] = 9090
    data_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page's data, with --web.")] = 9876
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve Foxglove instead: open the printed address there.")
    ] = False
    foxglove_port: Annotated[int, typer.Option(min=0, max=65535, help="Port for Foxglove.")] = 8765
    host: Annotated[str, typer.Option(help="Address that Foxglove is served at.")] = "127.0.0.1"
    save: Annotated[Path | None, typer.Option("--save", help="Write an .rrd file instead, for Rerun.")] = None


def watch(
    file: Annotated[
        Path | None, typer.Argument(help="A recording; default: the running service.", show_default=False)
    ] = None,
    *,
    how: WatchOptions,
    speed: Annotated[str, typer.Option(help="Of a recording: 1 as recorded, 10 ten times as fast, max.")] = "max",
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so many seconds.")] = None,
    service: ServiceOptions,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router.")] = 5.0,
) -> None:
    """Watch streams from above and in 3D: tracks, their velocity, uncertainty and paths, detections, clouds.

    Ends when it is interrupted, or at the end of a recording with --save. With --foxglove also problems, as logs.
    """
    if how.web + how.foxglove + (how.save is not None) > 1:
        raise UsageError("expected one of --web, --foxglove and --save, received several")
    if how.poisson and (file is not None or how.foxglove):
        raise UsageError("--poisson: expected without a recording or --foxglove, which show no densities; received one")
    pace = speed_of(speed)
    if how.foxglove:
        needed("watching with Foxglove", "record", "foxglove")
    else:
        needed("watching", "watch", "rerun")
    messages = _live(service, timeout, how) if file is None else _recorded(file, pace, how)
    first = next(messages, None)  # an error of the source is reported before a viewer opens
    ends = None if seconds is None else time.monotonic() + seconds
    until = _until(itertools.chain([first], messages), ends)
    if how.foxglove:
        _in_foxglove(until, how, ends)
        return
    _in_rerun(until, how, ends)


def _until(messages: Iterable[Message | None], ends: float | None) -> Iterator[Message]:
    """Yield messages until a time of the monotonic clock; for ever without."""
    for message in messages:
        if message is not None:
            yield message
        if ends is not None and time.monotonic() > ends:
            return


def _stay(ends: float | None) -> None:
    threading.Event().wait(None if ends is None else max(0.0, ends - time.monotonic()))


def _in_foxglove(messages: Iterable[Message], how: WatchOptions, ends: float | None) -> None:
    from optipmb_tools.views.foxglove import FoxgloveServer  # noqa: PLC0415  an extra of the installation

    with FoxgloveServer(how.host, how.foxglove_port) as server:
        say(f"open {server.address} in Foxglove (Open connection, Foxglove WebSocket)")
        for message in messages:
            server.show(message)
        _stay(ends)


def _in_rerun(messages: Iterable[Message], how: WatchOptions, ends: float | None) -> None:
    import rerun as rr  # noqa: PLC0415  an extra of the installation

    from optipmb_tools.views.viewer import View  # noqa: PLC0415  as above

    recording = rr.RecordingStream("optipmb")
    if how.web:
        source = recording.serve_grpc(grpc_port=how.data_port)
        rr.serve_web_viewer(web_port=how.web_port, open_browser=False, connect_to=source)
        say(f"watch at http://localhost:{how.web_port}/?url={source.replace(':', '%3A').replace('/', '%2F')}")
    elif how.save is None:
        recording.spawn()
    else:
        how.save.parent.mkdir(parents=True, exist_ok=True)
        recording.save(how.save)
    view = View(recording, how.streams[0] if how.streams and "*" not in how.streams[0] else None)
    try:
        for message in messages:
            view.show(message)
        if how.web:
            _stay(ends)
    finally:
        recording.flush()
    if how.save is not None:
        say(f"saved in {how.save}")


def _live(service: ServiceOptions, timeout: float, how: WatchOptions) -> Iterator[Message | None]:
    """Yield messages as they come; None now and then while there are none."""
    from optipmb_client.incoming import Inbox  # noqa: PLC0415  of a running service

    keys = Keys(service.prefix)
    topics = [topic for topic in TOPICS if how.points or topic != "points"]
    wanted = [keys.matching(pattern, topic) for pattern in how.streams or ["*/*/*"] for topic in topics]
    inbox = Inbox(WAITING)
    with contextlib.ExitStack() as stack:
        connection = stack.enter_context(service.connection(timeout))
        for key in wanted:
            connection.subscribe(key, inbox)
        queries = None
        if how.poisson:
            from optipmb_tools.views.viewer import DensityQueries  # noqa: PLC0415  an extra of the installation

            queries = stack.enter_context(DensityQueries(connection, inbox, service.prefix))
        while True:
            arrival = inbox.get(TICK_S)
            message = None if arrival is None else _message(arrival.key, arrival.payload, arrival.encoding)
            if queries is not None and isinstance(message, Tracks):
                queries.note(message.stream)
            yield message


def _recorded(file: Path, speed: float | None, how: WatchOptions) -> Iterator[Message | None]:
    """Yield the messages of a recording, at its pace."""
    needed("recordings", "record", "mcap", need="need")
    from optipmb_tools.recordings.recording_file import RecordingFile  # noqa: PLC0415  packages of an extra

    zero: float | None = None
    for one in RecordingFile(file):
        if (how.streams and one.stream not in how.streams) or (one.topic == "points" and not how.points):
            continue
        if speed is not None:
            after = one.received_ns / 1e9 / speed
            zero = time.monotonic() - after if zero is None else zero
            time.sleep(max(0.0, zero + after - time.monotonic()))
        yield _message(one.topic, one.payload, one.encoding)


def _message(key: str, payload: bytes, encoding: str) -> Message | None:
    kind = KINDS.get(key.rpartition("/")[2])
    try:
        return None if kind is None else decode(payload, kind, encoding=encoding)
    except MessageError:
        return None


def plot(
    data: LabelledOptions,
    *,
    tracks: Annotated[
        list[Path],
        typer.Option(
            help="Folder with the result files of track or replay, or a table of tracks; several times for several "
            "trackers side by side."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="The PNG file, or a GIF file of a moving picture.")],
    score: Annotated[
        float | None, typer.Option(help="Least mean score of a track, in the place of its confirmation.")
    ] = None,
    every: All = False,
    as_json: AsJson = False,
) -> None:
    """Draw the confirmed tracks of one sequence from above, with misses and confused ids where the truth is known."""
    tables = ("table", "pyarrow") if any(one and one.suffix in SUFFIXES for one in (data.data, *tracks)) else ()
    needed("optipmb plot", ",".join(("plot", *tables[:1])), "matplotlib", "scipy", *tables[1:])
    from optipmb_tools.evaluation import default_rules, evaluate_files  # noqa: PLC0415  loads the solvers of scipy
    from optipmb_tools.views.pictures import draw_results  # noqa: PLC0415  as above

    if out.suffix == ".gif" and len(tracks) > 1:
        raise UsageError(f"--out {out}: a moving picture shows one --tracks, received {len(tracks)}; name a PNG file")
    opened = data.open()
    if len(opened.sequences) != 1:
        raise UsageError(f"--sequences: one sequence makes a picture, received {len(opened.sequences)}")
    (sequence,) = opened.sequences
    known = sequence.truth() is not None
    rules = default_rules(opened.name)
    results = [evaluate_files([sequence], one, opened.labels, rules) if known else [] for one in tracks]
    draw_results(out, sequence, tracks, results, score, every=every)
    shown = {"command": "plot", "dataset": opened.name, "sequence": sequence.name, "picture": out}
    report(shown, f"picture in {out}", as_json=as_json)
