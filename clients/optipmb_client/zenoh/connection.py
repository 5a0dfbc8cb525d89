"""A Zenoh session of a node or a command, as a client of routers."""

import contextlib
import json
import math
import time
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import zenoh
from optipmb_schemas import Keys, Topic
from optipmb_schemas.certificates import end_of, ended

from optipmb_client.errors import ConnectionFailed
from optipmb_client.incoming import Answer, Inbox
from optipmb_client.zenoh.configuration import BUSY, certificates, configured
from optipmb_client.zenoh.handles import Dispatcher, Sender
from optipmb_client.zenoh.session import CACHED, ZenohSession, opened

__all__ = ["DEFAULT_ENDPOINT", "Connection"]

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
LEASE_MS = 3000  # after so long a router takes a silent client for gone, and lets it in again; by default 10 s
CLOUD_BATCHES = 16  # of 64 kB on the way to the network: with the default of 2 sending a cloud takes four times as long
POLL_S = 0.02


class Connection:
    """A Zenoh session. Publishers and subscribers may share one; the caller that opens it closes it.

    It can declare 65,535 keys in its life, and closing gives none back: a `Publisher` declares three, with a cache of
    clouds four, and a `Subscriber` two, with `on_problem` four. What a program opens beyond is refused with
    `ConnectionFailed`; another connection can open it.

    Args:
        connect: Endpoint or endpoints of routers (or of a service with its own router), such as ``tcp/10.0.0.1:7447``;
            the session is then a client of them. Default: ``tcp/127.0.0.1:7447``, unless `config` is given.
        config: A Zenoh configuration file (JSON5), for TLS, user names and everything else; its endpoints hold unless
            `connect` is given too.
        timeout: Seconds to wait for a router; `math.inf`: for ever.

    Raises:
        ConnectionFailed: Within `timeout`, when no router is reachable or an endpoint or the file is unusable.
    """

    def __init__(
        self,
        connect: str | Sequence[str] | None = None,
        *,
        config: str | Path | None = None,
        timeout: float = 5.0,
    ) -> None:
        endpoints = (connect,) if isinstance(connect, str) else tuple(connect or ())
        if not endpoints and config is None:
            endpoints = (DEFAULT_ENDPOINT,)
        self.where = ", ".join(endpoints) or str(config)  # for people
        settings = _configuration(endpoints, config, timeout)
        try:
            self._session = ZenohSession(opened(settings))
        except ConnectionFailed:
            raise self._unanswered(endpoints, timeout, settings) from None
        # A router that starts at this moment may be known and not linked yet: messages would be lost.
        ends = time.monotonic() + timeout
        while json.loads(settings.get_json("mode")) == "client" and not self._session.linked():
            if time.monotonic() > ends:
                self._session.close()
                raise self._unanswered(endpoints, timeout, settings)
            time.sleep(POLL_S)
        # For programs that forget to close: messages that still stand in a batch would be lost at their end, and a
        # thread of the network that calls back after the interpreter has ended would abort the process.
        self._finalizer = weakref.finalize(self, self._session.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close everything opened on this connection, then the session. May be called twice."""
        self._finalizer()

    @property
    def closed(self) -> bool:
        """Whether `close` has been called."""
        return self._session.closed

    def cached_sender(self, key: str, encoding: str, *, cache: int) -> Sender:
        """Open a publisher for small messages that must not get lost: it keeps the newest `cache` for recovery."""
        return self._session.cached_sender(key, encoding, cache=cache)

    def plain_sender(self, key: str, encoding: str, *, cache: int = 0) -> Sender:
        """Open a publisher for large messages: lower priority than the small ones; with `cache` it keeps the newest."""
        return self._session.plain_sender(key, encoding, cache=cache)

    def senders(self, stream: str, *, prefix: str, cache: int, cache_clouds: int) -> tuple[Sender, Sender]:
        """Open what sends the detections and the clouds of a stream, each keeping the newest for recovery."""
        return self._session.senders(Keys(prefix), stream, cache=cache, cache_clouds=cache_clouds)

    def subscribe(self, pattern: str, inbox: Inbox, *, history: bool = True) -> Dispatcher:
        """Move all that is published under `pattern` into `inbox`; losses are recovered from the publishers' caches.

        With `history`, what those caches hold from before the subscription comes first.
        """
        return self._session.subscribe(pattern, inbox.put, history=history)

    def subscribe_streams(
        self, pattern: str, inbox: Inbox, *topics: Topic, prefix: str, history: bool
    ) -> contextlib.ExitStack:
        """Move topics of a pattern of streams into an inbox: tracks or `now`, perhaps with problems, or events."""
        self._session.require(CACHED * len(topics))
        subscriptions = contextlib.ExitStack()
        for topic in topics:
            subscriptions.callback(self.subscribe(Keys(prefix).matching(pattern, topic), inbox, history=history).close)
        return subscriptions

    def query(self, key: str, payload: bytes = b"", encoding: str = "", *, timeout: float = 2.0) -> tuple[Answer, ...]:
        """Send a query to all that answer at `key`; an empty result means no answer within `timeout` seconds."""
        return self._session.query(key, payload, encoding, timeout=timeout)

    def alive(self, pattern: str, *, timeout: float = 2.0) -> tuple[str, ...]:
        """Keys of the liveliness tokens under `pattern`, sorted."""
        return self._session.alive(pattern, timeout=timeout)

    def _unanswered(self, endpoints: tuple[str, ...], timeout: float, settings: zenoh.Config) -> ConnectionFailed:
        found = [file for name, file in certificates(settings).items() if name != "listen_certificate"]
        ends = [end for file in found if (end := ended(file, end_of(file)))]
        advice = "; ".join(ends) or "is optipmb-service running there?"
        if found and not ends:
            advice = "is optipmb-service running there, and does its TLS certificate hold?"
        if not found and any(one.startswith(("tls/", "quic/")) for one in endpoints):
            advice = "TLS needs certificates: name them in a Zenoh configuration, and give that as `config`"
        return ConnectionFailed(
            f"nothing answers at {self.where} (waited {timeout:g} s); {advice}",
            endpoints=endpoints,
            timeout=timeout,
        )


def _configuration(endpoints: tuple[str, ...], file: str | Path | None, timeout: float) -> zenoh.Config:
    if not timeout >= 0:  # NaN is not
        raise ConnectionFailed(f"timeout: expected seconds, 0 or more, received {timeout!r}", endpoints=endpoints)
    if file is not None and not Path(file).is_file():
        raise ConnectionFailed(f"there is no Zenoh configuration file at {file}")
    values: dict[str, object] = {
        "connect/timeout_ms": -1 if timeout == math.inf else int(timeout * 1e3),
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    }
    if endpoints:
        values["connect/endpoints"] = endpoints
    if file is None:
        values |= {
            **BUSY,
            "mode": "client",
            "transport/link/tx/queue/size/data_low": CLOUD_BATCHES,
            "transport/link/tx/lease": LEASE_MS,
        }
    try:
        return configured(values, file)
    except ConnectionFailed as error:
        if isinstance(error.__cause__, zenoh.ZError | OSError):
            where = " ".join([*endpoints, *([str(file)] if file else [])])
            raise ConnectionFailed(
                f"not a usable Zenoh endpoint or configuration: {where} (an endpoint looks like {DEFAULT_ENDPOINT})",
                endpoints=endpoints,
            ) from error
        raise
