"""Links that are dead and not closed, as behind a gateway that has forgotten them, and what a long outage costs."""

import time

import pytest
from fleet import PROFILE, RouterProcess
from optipmb_client import Connection, Publisher, Subscriber
from optipmb_schemas import Keys, Tracks, decode, encode, encoding_of
from proxy import Proxy
from router import Sensor, until
from service_process import ServiceProcess
from takeovers import expected

KEYS = Keys()
STREAM = "site/node/lidar"
RATE_S = 0.05
FRAMES = 160
"""More after the link has died than a cache of tracks holds."""
FRAME = {"label": ["car"], "center": [[1.0, 2.0, 0.0]], "size": [[4.0, 2.0, 1.5]], "yaw": [0.0], "score": [0.9]}


@pytest.mark.parametrize("side", ["publisher", "subscriber"])
def test_a_dead_link_loses_nothing(side: str) -> None:
    """A publisher, or a subscriber, whose link died notices it before the caches have lost anything, at 20 Hz."""
    environment = {"OPTIPMB_PROFILE": PROFILE}
    with ServiceProcess(environment=environment) as service, Proxy(service.endpoint) as proxy:
        service.wait_ready()
        where = {"publisher": service.endpoint, "subscriber": service.endpoint} | {side: proxy.endpoint}
        with (
            Subscriber(STREAM, where["subscriber"], history=True) as tracks,
            Publisher(STREAM, where["publisher"], frame="world") as publisher,
        ):
            for seq in range(FRAMES):
                if seq == FRAMES // 10:
                    proxy.strand()
                publisher.publish(stamp_ns=seq * round(RATE_S * 1e9), **FRAME)
                time.sleep(RATE_S)  # the rate of a sensor, not a wait for anything
            found: set[int] = set()
            while len(found) < FRAMES and (received := tracks.receive(30.0)) is not None:
                found.add(received.tracks.seq)
            assert sorted(found) == list(range(FRAMES))
            assert (tracks.missed, tracks.statistics.missed) == ((), 0)


def test_what_is_lost_is_named() -> None:
    """Tracks that the cache no longer holds when the link is back are named, with the stamps around them.

    So are messages for which a program was too slow.
    """
    sensor = Sensor(stream=STREAM)
    messages = [decode(payload, Tracks) for payload in expected(40, sensor)[0]]
    with RouterProcess() as router, Connection(router.endpoint) as sending, Connection(router.endpoint) as receiving:
        sender = sending.cached_sender(KEYS.tracks(STREAM), encoding_of(Tracks), cache=5)

        def send(first: int, last: int) -> None:
            for one in messages[first:last]:
                sender.put(encode(one))

        with Subscriber(STREAM, connection=receiving, queue=8, history=True) as tracks:

            def take(seq: int) -> None:
                until(lambda: (one := tracks.receive(1.0)) is not None and one.tracks.seq == seq, f"frame {seq} comes")

            send(0, 1)
            take(0)
            router.kill()
            send(1, 20)
            router.start()
            take(15)
            take(19)
            (lost,) = tracks.missed
            assert (lost.stream, lost.epoch, lost.first, lost.last) == (STREAM, messages[0].epoch, 1, 14)
            assert (lost.after_ns, lost.before_ns) == (messages[0].stamp_ns, messages[15].stamp_ns)
            send(20, 40)
            until(lambda: tracks.statistics.dropped == 12, "all have come")
            take(39)
            assert [(one.first, one.last) for one in tracks.missed] == [(1, 14), (20, 31)]
            assert tracks.statistics.missed == 2
