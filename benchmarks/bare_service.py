"""A service without what makes it one: detections are decoded, tracked and answered, and nothing else is done.

python benchmarks/bare_service.py ENDPOINT PREFIX

`service_cost.py --bare` measures it beside the service. It has the same client of Zenoh, decoder, tracker and encoder,
and no order of frames, window, checkpoints, bounds, counters, leases, queries or problems: what it costs is the least
that a frame can cost with these parts.
"""

from __future__ import annotations

import sys
from collections import deque
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas
from optipmb_service.app.lifecycle import settle
from optipmb_service.app.worker import warm_up
from optipmb_service.settings import Settings
from optipmb_service.stream import convert
from optipmb_service.stream.scheduler import Scheduler
from optipmb_service.stream.timeline import FrameId
from optipmb_service.zenoh.client import Client

import optipmb

if TYPE_CHECKING:
    from optipmb_client.zenoh.handles import Sender
    from optipmb_client.zenoh.session import Sample, Session

PROFILE: Final = "generic"
CACHE: Final = 50


class Frames:
    """Takes detections on the thread of the network, and tracks them on a thread of its own.

    Args:
        session: to publish on.
        keys: of what is published.
    """

    def __init__(self, session: Session, keys: schemas.Keys) -> None:
        self._session, self._keys = session, keys
        self._parameters = optipmb.load_profile(PROFILE)
        self._tracker = optipmb.Tracker(self._parameters)
        self._densities: dict[str, optipmb.Density] = {}
        self._publishers: dict[str, Sender] = {}
        times = {"queue_ms": 0.0, "decode_ms": 0.0, "step_ms": 0.0}
        self._delivery = {"instance": "bare", "received_ns": 0, "published_ns": 0, **times, "run": 0}
        self._waiting: deque[bytes] = deque()
        self._scheduler = Scheduler()

    def take(self, sample: Sample) -> None:
        """Take detections."""
        self._waiting.append(sample.payload.to_bytes())
        self._scheduler.submit(self.work)

    def work(self) -> bool:
        """Answer a frame."""
        message = schemas.decode(self._waiting.popleft(), schemas.Detections)
        stream = message.stream
        if stream not in self._densities:
            self._densities[stream] = self._tracker.initial()
            self._publishers[stream] = self._session.cached_sender(
                self._keys.tracks(stream), schemas.encoding_of(schemas.Tracks), cache=CACHE, detected=False
            )
        frame, ignored = convert.frame_of(self._parameters, message)
        result = self._tracker.step(self._densities[stream], frame)
        self._densities[stream] = result.density
        tracks = convert.tracks_of(
            result.tracks,
            None,
            stream=stream,
            frame_id=FrameId(message.epoch, message.seq, message.stamp_ns),
            session="0" * 32,
            revision=0,
            parameters=self._parameters,
            cloud_used=False,
            gap=0,
            ignored=ignored,
        )
        self._publishers[stream].put(tracks.encoded(self._delivery))
        return False


def main() -> None:
    """Answer until the end of stdin."""
    endpoint, prefix = sys.argv[1:]
    warm_up()
    keys = schemas.Keys(prefix)
    session = Client(Settings(connect=(endpoint,), prefix=prefix))
    frames = Frames(session, keys)
    session.listen(keys.all("detections"), frames.take)
    settle()
    print("ready", flush=True)
    sys.stdin.read()
    session.close()


if __name__ == "__main__":
    main()
