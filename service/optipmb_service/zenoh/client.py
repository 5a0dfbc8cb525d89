"""The session of the service and its edges on the network: publishes inputs, reads outputs, asks.

It declares the same as `optipmb_client` does for a program of its own, so that nothing on the network can tell the two
apart.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Final, Generic, Protocol, TypeVar

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.zenoh.configuration import BUSY, certificates, configured, loaded
from optipmb_client.zenoh.session import ZenohSession
from optipmb_client.zenoh.session import opened as open_session

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable
    from pathlib import Path

    from optipmb_client.incoming import Arrival
    from optipmb_client.zenoh.handles import Dispatcher, Sender
    from optipmb_client.zenoh.session import Opened

    from optipmb_service.settings import Settings

WAIT_BEFORE_CLOSE_US: Final = 30_000_000
"""How long a client waits to declare something where its router is slow to read, before Zenoh closes the link.

Zenoh's own 5 s make it worse: all that was declared on the link is withdrawn, and declared again on the next one. A
router that does not answer at all is left when its lease ends.
"""

RETRY_MS: Final = {"period_init_ms": 100, "period_max_ms": 2000, "period_increase_factor": 2}

RUNTIME_VARIABLE: Final = "ZENOH_RUNTIME"
RUNTIME: Final = "(rx: (handover: app))"
"""A client has one link, and one thread that waits for its socket and reads it; after that was lost, Zenoh has two.

By default one thread waits and wakes one of two others to read: two more threads are woken for each message.
Sending has a thread of its own, so a callback that waits for the lock of the interpreter keeps nothing from leaving.
"""

LISTENING: Final = "zenoh_listen"
"""Use of the certificate of a listener, which Zenoh reads at its start alone."""

MESSAGE_HEADROOM: Final = 4
"""A message up to this many times the limit is received and answered by a problem; a larger one is dropped by Zenoh."""

NEW_STREAMS: Final = 4000
"""Publishers and subscriptions that edges have declared at once."""

NEW_STREAM_S: Final = 0.5
"""Time after which there is a further one, in the long run."""

IDLE_S: Final = 60.0
"""Time after which a resource that is not used is closed; up to twice as long where few are kept."""

log = structlog.get_logger("optipmb_service")


class _Closable(Protocol):
    def close(self) -> None:
        """Release it."""


R = TypeVar("R", bound=_Closable)


class IdlePool(Generic[R]):
    """Subscriptions and publishers that are not used at the moment, by key; may be used by any threads.

    They are kept for the next user because Zenoh never gives back the number of a key. They are closed after
    `idle_s` (`IDLE_S`), and the oldest of more than `most` at once.
    """

    def __init__(self, most: int, idle_s: float | None = None) -> None:
        self._most = most
        self._idle_s = IDLE_S if idle_s is None else idle_s
        self._lock = threading.Lock()
        self._idle: dict[Hashable, tuple[float, R]] = {}
        self._is_timed = False

    def keep(self, key: Hashable, resource: R) -> bool:
        """Add a resource; False when there is one of this key."""
        with self._lock:
            if key in self._idle:
                return False
            self._idle[key] = time.monotonic() + self._idle_s, resource
            if len(self._idle) > self._most:
                self._end_in(0.0)
            elif not self._is_timed:
                self._end_in(self._idle_s)
        return True

    def take(self, key: Hashable) -> R | None:
        """Remove and return the resource of a key, None when there is none."""
        with self._lock:
            _, resource = self._idle.pop(key, (0.0, None))
        return resource

    def close(self) -> None:
        with self._lock:
            left, self._idle = self._idle, {}
        for _, resource in left.values():
            resource.close()

    def _end_in(self, seconds: float) -> None:
        self._is_timed |= seconds > 0
        timer = threading.Timer(seconds, self._end, (seconds > 0,))
        timer.daemon = True
        timer.start()

    def _end(self, timed: bool) -> None:  # noqa: FBT001 - as the timer is given it
        now = time.monotonic()
        with self._lock:
            surplus = len(self._idle) - self._most
            ended = [key for at, (key, (ends, _)) in enumerate(self._idle.items()) if at < surplus or ends <= now]
            resources = [self._idle.pop(key)[1] for key in ended]
            if timed:
                self._is_timed = False
                if self._idle:
                    self._end_in(self._idle_s)
        for resource in resources:
            resource.close()


L = TypeVar("L")
M = TypeVar("M")


class _Feed(Generic[L]):
    def __init__(self) -> None:
        self.listeners: tuple[L, ...] = ()
        self.subscription: _Closable | None = None

    def close(self) -> None:
        if self.subscription is not None:
            self.subscription.close()


class SharedSubscriptions(Generic[L, M]):
    """Subscriptions that listeners share, by key expression; kept for a while without any. For any threads.

    Args:
        subscribe: opens a subscription, which calls its second argument with each message.
        receive: called for each message with the listeners, on a thread of the subscription.
        most: subscriptions that are kept without listeners.
        idle_s: for how long, if it is not `IDLE_S`.
    """

    def __init__(
        self,
        subscribe: Callable[[str, Callable[[M], None]], _Closable],
        receive: Callable[[tuple[L, ...], M], None],
        most: int,
        idle_s: float | None = None,
    ) -> None:
        self._subscribe = subscribe
        self._receive = receive
        self._lock = threading.Lock()
        self._feeds: dict[str, _Feed[L]] = {}
        self._idle: IdlePool[_Feed[L]] = IdlePool(most, idle_s)

    def join(self, key: str, listener: L) -> Callable[[], None]:
        """Add a listener until the result is called, which may be twice. Raises as `subscribe` does."""
        with self._lock:
            feed = self._feeds.get(key) or self._idle.take(key) or _Feed()
            feed.listeners = (*feed.listeners, listener)
            if feed.subscription is None:
                feed.subscription = self._subscribe(key, lambda message: self._receive(feed.listeners, message))
            self._feeds[key] = feed
        return partial(self._leave, key, feed, listener)

    def _leave(self, key: str, feed: _Feed[L], listener: L) -> None:
        with self._lock:
            left = tuple(one for one in feed.listeners if one is not listener)
            if len(left) < len(feed.listeners):
                feed.listeners = left
                if not left:
                    self._idle.keep(key, self._feeds.pop(key))

    def close(self) -> None:
        """Withdraw the subscriptions without listeners; may wait."""
        self._idle.close()


class TooManyStreamsError(TransportError):
    """Too many new streams were asked for; `wait_s` seconds later there is room for one."""

    def __init__(self, wait_s: float) -> None:
        super().__init__(f"too many new streams were asked for; the next one can be in {wait_s:.0f} s")
        self.wait_s = wait_s


class Turns:
    """Bound on how often strangers have keys declared: a burst, then one in each period. May be used by any threads."""

    def __init__(self, burst: int, period_s: float) -> None:
        self._burst = burst
        self._period_s = period_s
        self._lock = threading.Lock()
        self._left, self._at = float(burst), time.monotonic()

    def take(self) -> None:
        """Take a turn.

        Raises:
            TooManyStreamsError: there is none now.
        """
        with self._lock:
            now = time.monotonic()
            self._left = min(float(self._burst), self._left + (now - self._at) / self._period_s)
            self._at = now
            if self._left < 1:
                raise TooManyStreamsError((1 - self._left) * self._period_s)
            self._left -= 1


class Outgoing:
    """The publishers of one stream's detections and clouds.

    Args:
        detections: sends detections.
        points: sends clouds; without a cache only while somebody subscribes.
        wanted: called on any thread, and only to pass it on, when it has changed whether anybody takes clouds.
    """

    def __init__(self, detections: Sender, points: Sender, wanted: Callable[[], None]) -> None:
        self.wanted = wanted
        self._senders = detections, points
        self.detections = detections.put
        self.points = points.put
        points.on_wanted(lambda: self.wanted())  # noqa: PLW0108 - it changes with the call

    @property
    def points_wanted(self) -> bool:
        """Whether anybody is known to take clouds; always with a cache, which serves those who come later."""
        return self._senders[1].wanted

    def close(self) -> None:
        """Withdraw both."""
        for sender in self._senders:
            sender.close()


class Client(ZenohSession):
    """A session on the network; a client waits for a router until it has one.

    Raises:
        TransportError: an endpoint or the configuration cannot be used.
    """

    def __init__(self, settings: Settings) -> None:
        super().__init__(opened(settings), _log_failure)
        self.keys = schemas.Keys(settings.prefix)
        self._is_router = settings.is_router
        self._turns = Turns(NEW_STREAMS, NEW_STREAM_S)

    def linked(self) -> bool:
        """Whether the session has a router, or is one."""
        return self._is_router or super().linked()

    @property
    def failure(self) -> str:
        """Why nothing can be received or sent; empty while it can."""
        return "" if self.linked() else "network: no router"

    def publish(self, stream: str, cache: int, cache_clouds: int, wanted: Callable[[], None]) -> Outgoing:
        """Open the publishers of a stream, which keep so many detections and clouds; `wanted` as for `Outgoing`.

        Raises:
            TransportError: also where too many were opened.
        """
        self._turns.take()
        return Outgoing(*self.senders(self.keys, stream, cache=cache, cache_clouds=cache_clouds), wanted)

    def publish_problem(self, problem: schemas.Problem) -> None:
        """Send a problem on its stream's key; one without a stream has no key and is not sent."""
        if problem.stream:
            with contextlib.suppress(TransportError):  # at the end: the session is closed
                self.put(self.keys.problems(problem.stream), schemas.encode(problem), schemas.encoding_of(problem))

    def subscribe(self, key: str, receive: Callable[[Arrival], object], *, history: bool | None = None) -> Dispatcher:
        """Hand over publications under a key expression, as `ZenohSession` does.

        Raises:
            TransportError: also where too many were opened.
        """
        self._turns.take()
        return super().subscribe(key, receive, history=history)


def _log_failure(name: str) -> None:
    log.exception("internal_error", reader=name)  # noqa: LOG004 - called while the exception is handled


def opened(settings: Settings) -> Opened:
    """Open a session of Zenoh's; a client does not return before it has a router.

    Raises:
        TransportError: an endpoint is in use or unusable, or the file of the settings is.
    """
    config = configured(_values(settings), settings.zenoh_config, router=settings.is_router)
    # Read when the first session of a process opens; neither a later router nor a child is to find it.
    sets_runtime = not settings.is_router and RUNTIME_VARIABLE not in os.environ
    if sets_runtime:
        os.environ[RUNTIME_VARIABLE] = RUNTIME
    try:
        return open_session(config)
    except TransportError as error:
        where = ", ".join((*settings.endpoints, *settings.connect))
        if "Address already in use" in str(error):
            reason = f"cannot listen on {where}: the address is in use; is another optipmb-service running?"
        else:
            reason = f"cannot open {where}: {error}"
        raise TransportError(reason) from error
    finally:
        if sets_runtime:
            del os.environ[RUNTIME_VARIABLE]


def certificates_of(settings: Settings) -> dict[str, Path]:
    """Return the files of the certificates that the Zenoh configuration names, by their use.

    Raises:
        TransportError: the file of the configuration cannot be read.
    """
    uses = {"connect_certificate": "zenoh", "listen_certificate": LISTENING, "root_ca_certificate": "zenoh_authority"}
    return {uses[name]: file for name, file in certificates(loaded(settings.zenoh_config)).items()}


def _values(settings: Settings) -> dict[str, object]:
    values: dict[str, object] = {
        **BUSY,
        "mode": "router" if settings.is_router else "client",
        "listen/endpoints": list(settings.endpoints),
        "connect/endpoints": list(settings.connect),
        "connect/timeout_ms": -1,
        "connect/retry": RETRY_MS,
        "scouting/delay": 0,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": settings.shared_memory,
        "transport/link/tx/lease": round(settings.lease_s * 1e3),
        "transport/link/rx/max_message_size": MESSAGE_HEADROOM * settings.limits.max_bytes,
    }
    if settings.is_router:
        values["connect/exit_on_failure"] = False  # a router starts without the routers that it looks for
    else:
        values["transport/link/tx/queue/congestion_control/block/wait_before_close"] = WAIT_BEFORE_CLOSE_US
    # One interest in the subscribers of all tracks, and one in heartbeats, in place of two for each stream:
    # a router compares every subscription with all interests.
    tracks = schemas.Keys(settings.prefix).all("tracks")
    aggregated = json.loads(loaded(settings.zenoh_config).get_json("aggregation/publishers"))
    values["aggregation/publishers"] = [*aggregated, tracks, f"{tracks}/@adv/**"]
    return values
