"""`optipmb watch`: streams, or a recording, in Rerun."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from optipmb_schemas import Density, Detections, Keys, Message, MessageError, Points, Problem, Topic, Tracks, decode

from optipmb_client.asking import DensityAsker
from optipmb_client.commands.options import mcap_needed, say
from optipmb_client.commands.service_options import ServiceOptions, speed_of
from optipmb_client.errors import UsageError
from optipmb_client.extras import needed
from optipmb_client.incoming import Inbox

if TYPE_CHECKING:
    from rerun import RecordingStream

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


def watch(  # noqa: PLR0913  these are the command's options
    file: Annotated[
        Path | None, typer.Argument(help="A recording; default: the running service.", show_default=False)
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
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve Foxglove instead: open the printed address there.")
    ] = False,
    foxglove_port: Annotated[int, typer.Option(min=0, max=65535, help="Port for Foxglove.")] = 8765,
    host: Annotated[str, typer.Option(help="Address that Foxglove is served at.")] = "127.0.0.1",
    save: Annotated[Path | None, typer.Option("--save", help="Write an .rrd file instead, for Rerun.")] = None,
    speed: Annotated[str, typer.Option(help="Of a recording: 1 as recorded, 10 ten times as fast, max.")] = "max",
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so many seconds.")] = None,
    service: ServiceOptions,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a router.")] = 5.0,
) -> None:
    """Watch streams from above and in 3D: tracks, their velocity, uncertainty and paths, detections, clouds.

    Ends when it is interrupted, or at the end of a recording with --save. With --foxglove also problems, as logs.
    """
    if web + foxglove + (save is not None) > 1:
        raise UsageError("expected one of --web, --foxglove and --save, received several")
    if poisson and (file is not None or foxglove):
        raise UsageError("--poisson: expected without a recording or --foxglove, which show no densities; received one")
    pace = speed_of(speed)
    if foxglove:
        needed("watching with Foxglove", "record", "foxglove")
    else:
        needed("watching", "watch", "rerun")
    messages = (
        _live(service, timeout, streams or ["*/*/*"], points=points, poisson=poisson)
        if file is None
        else _recorded(file, streams, pace, points=points)
    )
    first = next(messages, None)  # what is wrong with the source is reported before a viewer opens
    ends = None if seconds is None else time.monotonic() + seconds
    shown = _until(itertools.chain([first], messages), ends)
    if foxglove:
        _in_foxglove(shown, host, foxglove_port, ends)
        return
    followed = streams[0] if streams and "*" not in streams[0] else None
    _in_rerun(shown, followed, save, (web_port, data_port) if web else None, ends)


def _until(messages: Iterable[Message | None], ends: float | None) -> Iterator[Message]:
    """Yield what comes until a time of the monotonic clock; for ever without."""
    for message in messages:
        if message is not None:
            yield message
        if ends is not None and time.monotonic() > ends:
            return


def _stay(ends: float | None) -> None:
    threading.Event().wait(None if ends is None else max(0.0, ends - time.monotonic()))


def _in_foxglove(messages: Iterable[Message], host: str, port: int, ends: float | None) -> None:
    from optipmb_client.foxglove_server import FoxgloveServer  # noqa: PLC0415  an extra of the installation

    with FoxgloveServer(host, port) as server:
        say(f"open {server.address} in Foxglove (Open connection, Foxglove WebSocket)")
        for message in messages:
            server.show(message)
        _stay(ends)


def _in_rerun(
    messages: Iterable[Message],
    followed: str | None,
    save: Path | None,
    ports: tuple[int, int] | None,
    ends: float | None,
) -> None:
    import rerun as rr  # noqa: PLC0415  an extra of the installation

    from optipmb_client.watching import View  # noqa: PLC0415  as above

    recording = rr.RecordingStream("optipmb")
    if ports is not None:
        page, data = ports
        source = recording.serve_grpc(grpc_port=data)
        rr.serve_web_viewer(web_port=page, open_browser=False, connect_to=source)
        say(f"watch at http://localhost:{page}/?url={source.replace(':', '%3A').replace('/', '%2F')}")
    else:
        _open(recording, save)
    view = View(recording, followed)
    try:
        for message in messages:
            view.show(message)
        if ports is not None:
            _stay(ends)
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
    service: ServiceOptions, timeout: float, patterns: list[str], *, points: bool, poisson: bool
) -> Iterator[Message | None]:
    """Yield what comes; None now and then while nothing does."""
    keys = Keys(service.prefix)
    topics = [topic for topic in TOPICS if points or topic != "points"]
    wanted = [keys.matching(pattern, topic) for pattern in patterns for topic in topics]
    inbox = Inbox(WAITING)
    with contextlib.ExitStack() as stack:
        connection = stack.enter_context(service.connection(timeout))
        for key in wanted:
            connection.subscribe(key, inbox)
        asker = stack.enter_context(DensityAsker(connection, inbox, service.prefix)) if poisson else None
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
