"""Load on a running service: how many frames it carries, and how long their tracks take: `python benchmarks/load.py`.

Frames are encoded once, so that a message costs one copy while the load runs. Stream, epoch, number and stamp stand at
the start of every message and take the same number of bytes in all of them (stream names are of one length, numbers
begin at 2^32). So a message is a head of its own and a body, which all streams share. The frames repeat; generated
ones join without a jump.

Time counts from just before the detections of a frame are handed to the network to the arrival of its tracks in this
process. Frames of different streams are spread evenly over the period, as from independent sensors. The load
also measures itself: frames that it sends late, and the processor time that it takes, are part of the result. The
status is 1 when frames were lost, or the latency that was asked for was not held.
"""

import argparse
import contextlib
import itertools
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from optipmb_client.errors import ServiceRefused, ServiceUnavailable
from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.sessions import close_session, set_parameters
from optipmb_client.zenoh import DEFAULT_ENDPOINT, Connection
from optipmb_client.zenoh.handles import Sender
from optipmb_schemas import PREFIX, Detections, Keys, Points, Pose, SessionParameters, encode, encoding_of
from optipmb_tools.commands.options import print_json, print_table, say
from optipmb_tools.datasets import Cloud, DataSequence, DetectionFrame, open_dataset
from optipmb_tools.extras import needed
from optipmb_tools.views.colours import COLOURS
from optipmb_tools.views.progress import FrameProgress
from rich.table import Table

FIRST = 2**32  # number of the first frame: from here on msgpack writes nine bytes
STREAM_BYTES = 24  # length of the names of streams
CLOUDS = 20  # different clouds that are generated; more would only take memory
SPACING_M = 12.0
RADIUS_M = 4.0
NOISE_M = 0.05

STAGES = ("queue", "decode", "step", "deliver")
"""Parts of a latency: waiting (for a thread, for the cloud), decoding, tracking, and the rest: encoding and network."""
SETTLED = 10  # frames of a stream whose latency does not count: its session begins with them
STRAGGLERS_S = 5.0  # after the last frame, how long nothing may come before the missing frames count as lost
CACHE = 50
EPOCH_NS = 1_600_000_000_000_000_000

CLOSE = 1.05  # the search ends when the rates that hold and that do not differ by less than this factor
LEAST_HZ = 0.1
MOST_HZ = 10_000.0

_msgpack: Any = msgpack  # its type information is partial


@dataclass(frozen=True)
class Frames:
    """The bodies of messages: of frame k the detections `[k]`, and the cloud `[k]` unless there are none."""

    detections: tuple[bytes, ...]
    clouds: tuple[bytes | None, ...]
    objects: float  # mean number of objects in a frame
    points: float  # mean number of points in a frame

    def __len__(self) -> int:
        return len(self.detections)


def head(stream: str, epoch: bytes, seq: int, stamp_ns: int) -> bytes:
    """Return the four fields that every message starts with, as msgpack, without the size of the map before them."""
    fields = ("stream", stream, "epoch", epoch, "seq", seq, "stamp_ns", stamp_ns)
    return b"".join(map(_msgpack.packb, fields))


def generated(objects: int, points: int, rate: float, seed: int = 0) -> Frames:
    """Return ten seconds of objects that drive in circles, and clouds around the sensor, seen in the world frame.

    Args:
        objects: Number of objects, of two classes.
        points: Points of every cloud; 0: no clouds.
        rate: Frames per second.
        seed: Of the noise.
    """
    random = np.random.default_rng(seed)
    count = max(2, round(10 * rate))
    columns = max(1, int(np.ceil(np.sqrt(objects))))
    index = np.arange(objects)
    middle = SPACING_M * np.stack([index % columns, index // columns, 0 * index], axis=1).astype(np.float64)
    middle[:, :2] -= SPACING_M * (columns - 1) / 2
    begun = random.uniform(0, 2 * np.pi, objects)
    turn = 2 * np.pi * rate / count
    detections = []
    for k in range(count):
        angle = begun + 2 * np.pi * k / count
        around = np.stack([np.cos(angle), np.sin(angle), np.zeros(objects)], axis=1)
        along = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        detections.append(
            _body(
                Detections(
                    **_ANY,
                    frame="world",
                    labels=("car", "pedestrian"),
                    label=index % 2,
                    center=middle + RADIUS_M * around + random.normal(0, NOISE_M, (objects, 3)),
                    size=np.where(index[:, None] % 2 == 0, [4.5, 1.9, 1.6], [0.8, 0.7, 1.8]),
                    yaw=(angle + np.pi / 2) % (2 * np.pi),
                    velocity=RADIUS_M * turn * along,
                    score=np.full(objects, 0.8),
                    has_points=points > 0,
                )
            )
        )
    reach = SPACING_M * columns / 2 + 20
    clouds = [
        _body(
            Points(**_ANY, frame="world", pose=None, xyz=random.uniform(-reach, reach, (points, 3)).astype(np.float32))
        )
        for _ in range(CLOUDS if points else 0)
    ]
    shelf = itertools.islice(itertools.cycle(clouds or [None]), count)
    return Frames(tuple(detections), tuple(shelf), float(objects), float(points))


def recorded(sequences: Sequence[DataSequence], *, clouds: bool) -> Frames:
    """Return the frames of recorded sequences, one after the other; between them the scene changes."""
    frames = [frame for sequence in sequences for frame in sequence.frames()]
    shelf = [_cloud(frame.cloud) if clouds and frame.cloud is not None else None for frame in frames]
    points = [len(frame.cloud.xyz) if clouds and frame.cloud is not None else 0 for frame in frames]
    detections = (_recorded(frame, with_cloud=cloud is not None) for frame, cloud in zip(frames, shelf, strict=True))
    objects = float(np.mean([len(frame) for frame in frames]))
    return Frames(tuple(detections), tuple(shelf), objects, float(np.mean(points)))


def listed(frames: Sequence[dict[str, Any]]) -> Frames:
    """Return frames that are given by the fields of their detections in the world frame."""
    bodies = tuple(_body(Detections(**_ANY | one | {"stamp_ns": _ANY["stamp_ns"]}, frame="world")) for one in frames)
    return Frames(bodies, (None,) * len(bodies), float(np.mean([len(one["label"]) for one in frames])), 0.0)


def _recorded(frame: DetectionFrame, *, with_cloud: bool) -> bytes:
    pose = Pose(translation=frame.pose.translation, quaternion=frame.pose.quaternion)
    columns = {name: values for name, values in frame.columns.items() if name != "position_covariance"}
    return _body(Detections(**_ANY, frame="sensor", pose=pose, labels=frame.labels, **columns, has_points=with_cloud))


def _cloud(cloud: Cloud) -> bytes:
    pose = Pose(translation=cloud.pose.translation, quaternion=cloud.pose.quaternion)
    return _body(Points(**_ANY, frame="sensor", pose=pose, xyz=cloud.xyz))


_ANY: Any = {"stream": f"{'s' * (STREAM_BYTES - 4)}/s/s", "epoch": bytes(16), "seq": FIRST, "stamp_ns": FIRST}


def _body(message: Detections | Points) -> bytes:
    """Return a message without its head, but with the byte before the head put first."""
    payload, start = encode(message), head(**_ANY)
    at = payload.index(start)
    assert at == 1, "the header is not what a message starts with"
    return payload[:at] + payload[at + len(start) :]


def message(body: bytes, begins: bytes) -> bytes:
    """Return the message of a body with a head."""
    return b"".join((body[:1], begins, memoryview(body)[1:]))


def chain(parts: Iterable[str]) -> str:
    """Return a stream name of the common length from its parts, the first padded."""
    first, *rest = parts
    tail = "/".join(rest)
    return f"{first.ljust(STREAM_BYTES - len(tail) - 1, '-')}/{tail}"


@dataclass(frozen=True)
class Load:
    """Amount of frames to send."""

    streams: int  # sensors
    rate: float  # frames per second of each
    seconds: float
    profile: str | None = None  # None: the service chooses

    @property
    def frames(self) -> int:
        """Frames of one stream."""
        return max(SETTLED + 1, round(self.rate * self.seconds))


@dataclass(frozen=True)
class Run:
    """Result of a load. Times are milliseconds; quantiles are over all frames but the first of each stream."""

    streams: int
    rate: float
    objects: float
    points: float
    seconds: float
    sent: int
    received: int
    repeated: int
    cloudless: int  # frames whose cloud was sent and that were tracked without it
    p50_ms: float
    p99_ms: float
    max_ms: float
    stages_p50_ms: dict[str, float]
    stages_p99_ms: dict[str, float]
    late_p99_ms: float  # how late the generator itself was
    generator_cpu: float  # share of one processor that the generator took

    @property
    def lost(self) -> int:
        """Frames without tracks."""
        return self.sent - self.received

    @property
    def throughput(self) -> float:
        """Frames per second, all streams together."""
        return self.received / self.seconds

    def holds(self, latency_ms: float) -> bool:
        """Whether nothing was lost and 99 of 100 frames took at most so long."""
        return self.lost == 0 and self.cloudless == 0 and self.p99_ms <= latency_ms


class _Arrivals(Inbox):
    """Takes arrivals on the receiving thread, without a queue between: it only reads a few fields."""

    def __init__(self, frames: int, streams: dict[str, int]) -> None:
        super().__init__(1)
        self._streams = streams
        shape = (len(streams), frames)
        self.at_ns = np.zeros(shape, np.int64)
        self.stages = np.zeros((*shape, 3))
        self.cloudless = np.zeros(shape, np.bool_)
        self.repeated = 0
        self.received = 0
        self.enough = threading.Event()

    def put(self, arrival: Arrival) -> None:
        """Note the tracks of a frame."""
        fields = _msgpack.unpackb(arrival.payload)
        stream, frame = self._streams.get(fields["stream"]), fields["seq"] - FIRST
        if stream is None or not 0 <= frame < self.at_ns.shape[1]:
            return
        if self.at_ns[stream, frame]:
            self.repeated += 1
            return
        self.at_ns[stream, frame] = arrival.monotonic_ns
        delivery = fields["delivery"]
        self.stages[stream, frame] = delivery["queue_ms"], delivery["decode_ms"], delivery["step_ms"]
        self.cloudless[stream, frame] = not fields["cloud_used"]
        self.received += 1
        if self.received == self.at_ns.size:
            self.enough.set()


def run_load(
    connection: Connection,
    load: Load,
    frames: Frames,
    *,
    prefix: str = PREFIX,
    on_frame: Callable[[int], None] = lambda _count: None,
) -> Run:
    """Send a load through a running service; `on_frame` gets the number of frames sent.

    Raises:
        ServiceUnavailable: No service answers.
        ServiceRefused: It does not know the profile, or takes no more streams.
    """
    token = secrets.token_hex(3)
    names = [chain((f"load-{token}", f"{number:05d}", "x")) for number in range(load.streams)]
    keys = Keys(prefix)
    arrivals = _Arrivals(load.frames, {name: number for number, name in enumerate(names)})
    with contextlib.ExitStack() as opened:
        subscription = connection.subscribe(f"{prefix}/{names[0].partition('/')[0]}/*/*/tracks", arrivals)
        opened.callback(subscription.close)
        senders = []
        for name in names:
            set_parameters(connection, name, SessionParameters(profile=load.profile, cloud_wait_s=1.0), prefix=prefix)
            opened.callback(_closed, connection, name, prefix)
            frame = connection.cached_sender(keys.detections(name), encoding_of(Detections), cache=CACHE)
            opened.callback(frame.close)
            cloud = connection.plain_sender(keys.points(name), encoding_of(Points))
            opened.callback(cloud.close)
            senders.append((frame, cloud))
        began, cpu = time.monotonic(), time.process_time()
        sent_ns, due_ns = _send(load, frames, names, senders, on_frame)
        seconds, cpu = time.monotonic() - began, time.process_time() - cpu
        seen = -1
        while arrivals.received > seen and not arrivals.enough.is_set():
            seen = arrivals.received
            arrivals.enough.wait(STRAGGLERS_S)
    came = arrivals.at_ns > 0
    came[:, :SETTLED] = False
    latency = (arrivals.at_ns[came] - sent_ns[came]) / 1e6
    stages = arrivals.stages[came]
    parts = dict(zip(STAGES, (*stages.T, latency - stages.sum(axis=1)), strict=True))
    return Run(
        streams=load.streams,
        rate=load.rate,
        objects=frames.objects,
        points=frames.points,
        seconds=seconds,
        sent=sent_ns.size,
        received=arrivals.received,
        repeated=arrivals.repeated,
        cloudless=int(arrivals.cloudless[came].sum()) if any(cloud is not None for cloud in frames.clouds) else 0,
        p50_ms=_quantile(latency, 0.5),
        p99_ms=_quantile(latency, 0.99),
        max_ms=_quantile(latency, 1.0),
        stages_p50_ms={name: _quantile(part, 0.5) for name, part in parts.items()},
        stages_p99_ms={name: _quantile(part, 0.99) for name, part in parts.items()},
        late_p99_ms=_quantile((sent_ns - due_ns).ravel() / 1e6, 0.99),
        generator_cpu=cpu / seconds,
    )


def _closed(connection: Connection, name: str, prefix: str) -> None:
    with contextlib.suppress(ServiceRefused, ServiceUnavailable):
        close_session(connection, name, prefix=prefix)


def _send(
    load: Load, frames: Frames, names: list[str], senders: list[tuple[Sender, Sender]], on_frame: Callable[[int], None]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Send all frames in time; return when each was sent and due (streams, frames), monotonic ns."""
    epoch = secrets.token_bytes(16)
    sent_ns = np.zeros((load.streams, load.frames), np.int64)
    due_ns = np.zeros_like(sent_ns)
    period_ns, first_ns = 1e9 / load.rate, time.monotonic_ns()
    for frame in range(load.frames):
        for stream, (detections, points) in enumerate(senders):
            # Every stream is at another place of the round, so that not all do the same at once.
            at = (frame + stream * 7) % len(frames)
            due = first_ns + round((frame + stream / load.streams) * period_ns)
            if (pause_ns := due - time.monotonic_ns()) > 0:
                time.sleep(pause_ns / 1e9)
            begins = head(names[stream], epoch, FIRST + frame, EPOCH_NS + round(frame * period_ns))
            if (cloud := frames.clouds[at]) is not None:
                points.put(message(cloud, begins))
            payload = message(frames.detections[at], begins)
            sent_ns[stream, frame] = time.monotonic_ns()
            detections.put(payload)
            due_ns[stream, frame] = due
        on_frame(load.streams)
    return sent_ns, due_ns


def _quantile(values: NDArray[Any], share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def find_limit(measure: Callable[[float], Run], rate: float, latency_ms: float) -> tuple[float, list[Run]]:
    """Return the highest rate (Hz) found that holds, 0 when none does, and all runs in their order.

    Args:
        measure: Run a load at a rate per stream.
        rate: Start of the search, which doubles it until it does not hold, then halves the interval.
        latency_ms: Limit for 99 of 100 frames, with nothing lost.
    """
    runs: list[Run] = []

    def holds(at: float) -> bool:
        runs.append(measure(at))
        return runs[-1].holds(latency_ms)

    good, bad = 0.0, 0.0
    while LEAST_HZ <= rate <= MOST_HZ and not (good and bad):
        if holds(rate):
            good, rate = rate, 2 * rate
        else:
            bad, rate = rate, rate / 2
    while good and bad and bad / good > CLOSE:
        middle = (good * bad) ** 0.5
        if holds(middle):
            good = middle
        else:
            bad = middle
    return good, runs


_STYLES = ("-", "--", "-.", ":")
_MARKS = ("o", "s", "^", "D")


def table_of(runs: Sequence[Run], latency_ms: float | None = None) -> Table:
    """Return the runs, a row each; with a latency, also whether it was held."""
    table = Table(box=None, pad_edge=False)
    columns = ["streams", "Hz each", "frames/s", "sent", "received", "lost", "p50 ms", "p99 ms", "max ms"]
    columns += [f"{stage} p50|p99" for stage in STAGES] + ["sent late p99", "generator"]
    for name in columns + ([f"{latency_ms:g} ms"] if latency_ms is not None else []):
        table.add_column(name, justify="right", no_wrap=True)
    for run in sorted(runs, key=lambda run: run.rate):
        row = [str(run.streams), f"{run.rate:.1f}", f"{run.throughput:.0f}", str(run.sent), str(run.received)]
        row += [str(run.lost), f"{run.p50_ms:.2f}", f"{run.p99_ms:.2f}", f"{run.max_ms:.1f}"]
        row += [f"{run.stages_p50_ms[stage]:.2f}|{run.stages_p99_ms[stage]:.2f}" for stage in STAGES]
        row += [f"{run.late_p99_ms:.2f} ms", f"{run.generator_cpu:.0%}"]
        table.add_row(*row, *([("held" if run.holds(latency_ms) else "not held")] if latency_ms is not None else []))
    return table


def draw_runs(path: Path, runs: Sequence[Run], latency_ms: float | None = None) -> None:
    """Draw median and 99th percentile, and the median of each stage, against the frames per second.

    Raises:
        ClientError: matplotlib is not installed.
    """
    needed("pictures", "plot", "matplotlib", need="need")
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  an extra
    from matplotlib.figure import Figure  # noqa: PLC0415  an extra

    runs = sorted(runs, key=lambda run: run.throughput)
    rates = [run.throughput for run in runs]
    figure = Figure(figsize=(8.0, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(rates, [run.p99_ms for run in runs], color="#222222", linestyle="--", marker="v", label="99th percentile")
    axes.plot(rates, [run.p50_ms for run in runs], color="#222222", marker="o", linewidth=2, label="median")
    for stage, colour, style, mark in zip(STAGES, COLOURS, _STYLES, _MARKS, strict=False):
        values = [run.stages_p50_ms[stage] for run in runs]
        axes.plot(rates, values, color=colour, linestyle=style, marker=mark, markersize=4, label=f"median of {stage}")
    if latency_ms is not None:
        axes.axhline(latency_ms, color="#D55E00", linewidth=0.8)
        axes.annotate(f"limit {latency_ms:g} ms", (rates[0], latency_ms), va="bottom", fontsize=8, color="#D55E00")
    first = runs[0]
    cloud = f", clouds of {first.points:.0f} points" if first.points else ", no clouds"
    axes.set_title(f"{first.streams} streams, {first.objects:.0f} objects{cloud}", fontsize=10)
    axes.set_xlabel("frames per second, all streams")
    axes.set_ylabel("milliseconds from put to tracks")
    axes.set_yscale("log")
    axes.grid(visible=True, which="both", linewidth=0.3)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default=DEFAULT_ENDPOINT, help="endpoint of the service")
    parser.add_argument("--streams", type=int, default=10, help="sensors")
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second of each")
    parser.add_argument("--objects", type=int, default=40, help="objects in a generated frame")
    parser.add_argument("--points", type=int, default=0, help="points of a generated cloud; 0: no clouds")
    parser.add_argument("--dataset", help="recorded frames in the place of generated")
    parser.add_argument("--root", type=Path, help="folder of the dataset")
    parser.add_argument("--detections", help="detector of the dataset")
    parser.add_argument("--no-clouds", dest="clouds", action="store_false", help="without recorded clouds")
    parser.add_argument("--profile", help="of the sessions")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long one run takes")
    parser.add_argument("--find-limit", action="store_true", help="look for the highest rate that holds")
    parser.add_argument("--latency-ms", type=float, help="what 99 of 100 frames must not exceed; 20 with --find-limit")
    parser.add_argument("--plot", type=Path, help="picture of latency against throughput, a file")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args(arguments)
    latency_ms = given.latency_ms or (20.0 if given.find_limit else None)
    material: Frames | None = None
    if given.dataset is not None:
        dataset = open_dataset(given.dataset, given.root, given.detections)
        material = recorded(dataset.sequences(["all"]), clouds=given.clouds)

    def measure(at: float) -> Run:
        frames = generated(given.objects, given.points, at) if material is None else material
        one = Load(given.streams, at, given.seconds, given.profile)
        with (
            Connection(given.connect) as connection,
            FrameProgress(f"load at {at:.1f} Hz", one.frames * given.streams) as progress,
        ):
            return run_load(connection, one, frames, on_frame=progress.advance)

    searched = given.find_limit and latency_ms
    highest, runs = find_limit(measure, given.rate, latency_ms) if searched else (None, [measure(given.rate)])
    if given.plot is not None:
        draw_runs(given.plot, runs, latency_ms)
    if given.json:
        rows = [{**vars(run), "lost": run.lost, "throughput": run.throughput} for run in runs]
        print_json({"latency_ms": latency_ms, "highest_hz": highest, "runs": rows})
    else:
        print_table(table_of(runs, latency_ms))
        if highest is not None:
            say(f"highest rate that holds {latency_ms:g} ms: {highest:.1f} Hz each")
    held = highest != 0 if highest is not None else not runs[0].lost and runs[0].holds(latency_ms or float("inf"))
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
