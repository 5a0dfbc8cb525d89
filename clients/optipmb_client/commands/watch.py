"""`optipmb watch`: streams, or a recording, in Rerun."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from optipmb_schemas import PREFIX, Density, Detections, Keys, Message, MessageError, Points, Topic, Tracks, decode

from optipmb_client.asking import DensityAsker
from optipmb_client.commands.options import Config, Connect, Prefix, mcap_needed, say
from optipmb_client.commands.replay import speed_of
from optipmb_client.errors import ClientError, UsageError
from optipmb_client.transport import Connection, Inbox

if TYPE_CHECKING:
    from rerun import RecordingStream

TOPICS: tuple[Topic, ...] = ("tracks", "detections", "points")
KINDS: dict[str, type[Message]] = {"tracks": Tracks, "detections": Detections, "points": Points, "density": Density}
WAITING = 32  # messages; a viewer that is too slow loses the oldest
TICK_S = 0.2


def watch(  # noqa: PLR0913  these are the command's options
    file: Annotated[
        Path | None, typer.Argument(help="A recording; default: what a service does now.", show_default=False)
    ] = None,
    *,
    streams: Annotated[
        list[str] | None,
        typer.Option("--streams", metavar="NAME...", help="Streams, `*` stands for any name. Default: all."),
    ] = None,
    points: Annotated[bool, typer.Option(help="Show the point clouds too.")] = True,
    poisson: Annotated[
        bool, typer.Option("--poisson", help="Ask the service where it expects objects not yet detected, and show it.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve the viewer to a browser instead of opening a window.")
    ] = False,
    web_port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page, with --web.")] = 9090,
    data_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page's data, with --web.")] = 9876,
    save: Annotated[Path | None, typer.Option("--save", help="Write an .rrd file instead, for Rerun.")] = None,
    speed: Annotated[str, typer.Option(help="Of a recording: 1 as recorded, 10 ten times as fast, max.")] = "max",
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so many seconds.")] = None,
    connect: Connect = None,
    config: Config = None,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router.")] = 5.0,
    prefix: Prefix = PREFIX,
) -> None:
    """Watch streams from above and in 3D: tracks, their velocity, uncertainty and ways, detections, clouds.

    Ends when it is interrupted, or at the end of a recording with --save.
    """
    if web and save is not None:
        raise UsageError("--save: expected either a file or --web, received both")
    if poisson and file is not None:
        raise UsageError("--poisson: expected without a recording, which holds no densities; received one")
    pace = speed_of(speed)
    try:
        import rerun as rr  # noqa: PLC0415  an extra of the installation

        from optipmb_client.watching import View  # noqa: PLC0415  as above
    except ImportError as error:
        raise ClientError("watching needs Rerun, which is not installed: pip install 'optipmb[watch]'") from error
    messages = (
        _live(connect, config, timeout, streams or ["*/*/*"], prefix, points=points, poisson=poisson)
        if file is None
        else _recorded(file, streams, pace, points=points)
    )
    first = next(messages, None)  # what is wrong with the source is told before a viewer opens
    recording = rr.RecordingStream("optipmb")
    if web:
        source = recording.serve_grpc(grpc_port=data_port)
        rr.serve_web_viewer(web_port=web_port, open_browser=False, connect_to=source)
        say(f"watch at http://localhost:{web_port}/?url={source.replace(':', '%3A').replace('/', '%2F')}")
    else:
        _open(recording, save)
    view = View(recording, streams[0] if streams and "*" not in streams[0] else None)
    ends = None if seconds is None else time.monotonic() + seconds
    try:
        for message in itertools.chain([first], messages):
            if message is not None:
                view.show(message)
            if ends is not None and time.monotonic() > ends:
                break
        else:
            if web:
                threading.Event().wait(None if ends is None else max(0.0, ends - time.monotonic()))
    finally:
        recording.flush()
    if save is not None:
        say(f"saved in {save}")


def _open(recording: "RecordingStream", save: Path | None) -> None:
    """Write to a file, or to the window of a viewer."""
    if save is None:
        recording.spawn()
        return
    save.parent.mkdir(parents=True, exist_ok=True)
    recording.save(save)


def _live(
    connect: list[str] | None,
    config: Path | None,
    timeout: float,
    patterns: list[str],
    prefix: str,
    *,
    points: bool,
    poisson: bool,
) -> Iterator[Message | None]:
    """Yield what comes; None now and then while nothing does."""
    keys = Keys(prefix)
    topics = [topic for topic in TOPICS if points or topic != "points"]
    wanted = [keys.matching(pattern, topic) for pattern in patterns for topic in topics]
    inbox = Inbox(WAITING)
    with contextlib.ExitStack() as stack:
        connection = stack.enter_context(Connection(connect, config=config, timeout=timeout))
        for key in wanted:
            connection.subscribe(key, inbox)
        asker = stack.enter_context(DensityAsker(connection, inbox, prefix)) if poisson else None
        while True:
            arrival = inbox.get(TICK_S)
            message = None if arrival is None else _message(arrival.key, arrival.payload, arrival.encoding)
            if asker is not None and isinstance(message, Tracks):
                asker.note(message.stream)
            yield message


def _recorded(file: Path, streams: list[str] | None, speed: float | None, *, points: bool) -> Iterator[Message | None]:
    """Yield what was recorded, at its pace."""
    with mcap_needed():
        from optipmb_client.mcap_files.reading import RecordingFile  # noqa: PLC0415  packages of an extra
    zero: float | None = None
    for one in RecordingFile(file):
        if (streams and one.stream not in streams) or (one.topic == "points" and not points):
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
