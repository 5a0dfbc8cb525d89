"""One run of a load: frames sent at their times, tracks timed as they arrive, everything counted.

Time counts from just before the detections of a frame are handed to the network to the arrival of its tracks in this
process. Frames of different streams are spread evenly over the period, as independent sensors' are. The generator
watches itself: frames that it sends late, and the processor time that it takes, are part of the result.
"""

import contextlib
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from optipmb_schemas import PREFIX, Detections, Keys, Points, SessionParameters, encoding_of

from optipmb_client.errors import ServiceRefused, ServiceUnavailable
from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.load.material import FIRST, Frames, chain, head, message
from optipmb_client.sessions import close_session, set_parameters
from optipmb_client.zenoh import Connection
from optipmb_client.zenoh.sender import Sender

STAGES = ("queue", "decode", "step", "deliver")
"""Parts of a latency: waiting (for a thread, for the cloud), decoding, tracking, and the rest: encoding and network."""

SETTLED = 10  # frames of a stream whose latency does not count: its session begins with them

STRAGGLERS_S = 5.0  # after the last frame, how long nothing may come before what has not come counts as lost
CACHE = 50
EPOCH_NS = 1_600_000_000_000_000_000

_msgpack: Any = msgpack  # its type information is partial


@dataclass(frozen=True)
class Load:
    """What is sent.

    Attributes:
        streams: sensors.
        rate: frames per second of each.
        seconds: how long.
        profile: that the service tracks with; None: its own choice.
    """

    streams: int
    rate: float
    seconds: float
    profile: str | None = None

    @property
    def frames(self) -> int:
        """Frames of one stream."""
        return max(SETTLED + 1, round(self.rate * self.seconds))


@dataclass(frozen=True)
class Run:
    """What a load came to. Times are milliseconds; quantiles are over all frames but the first of each stream."""

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
    """Takes arrivals in on the draining thread, without a queue between: it only looks at a few fields."""

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
    """Send a load through a running service.

    Args:
        connection: where the service is.
        load: how much.
        frames: what of.
        prefix: first part of all keys.
        on_frame: called with the number of frames sent.

    Raises:
        ServiceUnavailable: no service answers.
        ServiceRefused: it does not know the profile, or takes no more streams.
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
        sending = _Sending(load, frames, names, senders)
        began, cpu = time.monotonic(), time.process_time()
        sending.run(on_frame)
        seconds, cpu = time.monotonic() - began, time.process_time() - cpu
        seen = -1
        while arrivals.received > seen and not arrivals.enough.is_set():
            seen = arrivals.received
            arrivals.enough.wait(STRAGGLERS_S)
    return _result(load, frames, sending, arrivals, seconds, cpu)


def _closed(connection: Connection, name: str, prefix: str) -> None:
    with contextlib.suppress(ServiceRefused, ServiceUnavailable):
        close_session(connection, name, prefix=prefix)


class _Sending:
    """Sends everything in time."""

    def __init__(self, load: Load, frames: Frames, names: list[str], senders: list[tuple[Sender, Sender]]) -> None:
        self._load = load
        self._frames = frames
        self._names = names
        self._senders = senders
        self._epoch = secrets.token_bytes(16)
        self.sent_ns = np.zeros((load.streams, load.frames), np.int64)
        self.due_ns = np.zeros_like(self.sent_ns)

    def run(self, on_frame: Callable[[int], None]) -> None:
        """Send all frames."""
        streams, period_ns = self._load.streams, 1e9 / self._load.rate
        first_ns = time.monotonic_ns()
        for frame in range(self._load.frames):
            for stream in range(streams):
                due_ns = first_ns + round((frame + stream / streams) * period_ns)
                if (pause_ns := due_ns - time.monotonic_ns()) > 0:
                    time.sleep(pause_ns / 1e9)
                self._send(stream, frame, round(frame * period_ns))
                self.due_ns[stream, frame] = due_ns
            on_frame(streams)

    def _send(self, stream: int, frame: int, stamp_ns: int) -> None:
        # Every stream is at another place of the round, so that not all do the same at once.
        at = (frame + stream * 7) % len(self._frames)
        begins = head(self._names[stream], self._epoch, FIRST + frame, EPOCH_NS + stamp_ns)
        detections, points = self._senders[stream]
        cloud = self._frames.clouds[at]
        if cloud is not None:
            points.put(message(cloud, begins))
        payload = message(self._frames.detections[at], begins)
        self.sent_ns[stream, frame] = time.monotonic_ns()
        detections.put(payload)


def _result(load: Load, frames: Frames, sending: _Sending, arrivals: _Arrivals, seconds: float, cpu: float) -> Run:
    came = arrivals.at_ns > 0
    came[:, :SETTLED] = False
    latency = (arrivals.at_ns[came] - sending.sent_ns[came]) / 1e6
    stages = arrivals.stages[came]
    parts = [*stages.T, latency - stages.sum(axis=1)]
    clouds = sum(cloud is not None for cloud in frames.clouds) > 0
    return Run(
        streams=load.streams,
        rate=load.rate,
        objects=frames.objects,
        points=frames.points,
        seconds=seconds,
        sent=sending.sent_ns.size,
        received=arrivals.received,
        repeated=arrivals.repeated,
        cloudless=int(arrivals.cloudless[came].sum()) if clouds else 0,
        p50_ms=_quantile(latency, 0.5),
        p99_ms=_quantile(latency, 0.99),
        max_ms=_quantile(latency, 1.0),
        stages_p50_ms={name: _quantile(part, 0.5) for name, part in zip(STAGES, parts, strict=True)},
        stages_p99_ms={name: _quantile(part, 0.99) for name, part in zip(STAGES, parts, strict=True)},
        late_p99_ms=_quantile((sending.sent_ns - sending.due_ns).ravel() / 1e6, 0.99),
        generator_cpu=cpu / seconds,
    )


def _quantile(values: NDArray[Any], share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")
