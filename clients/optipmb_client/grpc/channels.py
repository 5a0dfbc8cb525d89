"""Channels to gateways, and calls on them: any of several will do, and when one goes the next is taken."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import grpc
from google.protobuf.message import DecodeError
from optipmb_schemas.certificates import end_of, ended
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_client.errors import ClientError, ConnectionFailed, ServiceRefused

__all__ = ["CLOSE_S", "Channels", "ResumedCall", "from_gateway", "lasting"]

SERVICE: Final = pb.DESCRIPTOR.services_by_name["TrackingService"].full_name

SAID_BY: Final = "optipmb-gateway"
"""Trailing metadata by which a gateway signs its errors."""

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
CLOSE_S: Final = 5.0

OPTIONS: Final = (
    ("grpc.keepalive_time_ms", 10_000),
    ("grpc.http2.ping_timeout_ms", 5_000),  # keepalive_timeout_ms has no effect in grpcio 1.85
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.initial_reconnect_backoff_ms", 50),
    ("grpc.max_reconnect_backoff_ms", 1000),
)

_PASSING: Final = frozenset(
    {
        grpc.StatusCode.UNAVAILABLE,
        grpc.StatusCode.CANCELLED,
        grpc.StatusCode.DEADLINE_EXCEEDED,
        grpc.StatusCode.RESOURCE_EXHAUSTED,
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.UNKNOWN,
    }
)


class Channels:
    """One channel to one of several gateways.

    Args:
        addresses: of gateways, `host:port`.
        config: a folder with `key.pem`, `cert.pem` and `ca.pem`, or a file in it, for TLS.
        metadata: sent with every call, a token for example.
        timeout: seconds to wait for a gateway.

    Raises:
        ConnectionFailed: no gateway answers within `timeout`, or a certificate cannot be read.
    """

    def __init__(
        self, addresses: Sequence[str], config: str | Path | None, metadata: Mapping[str, str], timeout: float
    ) -> None:
        self.addresses = tuple(addresses)
        self.metadata = tuple(metadata.items())
        credentials = None if config is None else _credentials(Path(config))
        self._channels = [_channel(address, credentials) for address in self.addresses]
        self._lock = threading.Lock()
        self._at = 0
        self._closed = False
        ends = time.monotonic() + timeout
        while not self._ready(timeout / len(self.addresses)):
            if time.monotonic() >= ends:
                self.close()
                files = [] if config is None else [Path(config) / name for name in ("cert.pem", "ca.pem")]
                why = "".join(f"; {said}" for file in files if (said := ended(file, end_of(file))))
                raise ConnectionFailed(
                    f"no gRPC gateway answers at {', '.join(self.addresses)} (waited {timeout:g} s){why}",
                    endpoints=self.addresses,
                    timeout=timeout,
                )

    def call(self, method: str) -> tuple[Any, grpc.Channel]:
        """Return a method of the present gateway, which takes and gives bytes, and the channel that it is on.

        Raises:
            ConnectionFailed: after `close`.
        """
        with self._lock:
            if self._closed:
                raise ConnectionFailed("the connection has been closed")
            channel = self._channels[self._at]
        return channel.stream_stream(f"/{SERVICE}/{method}"), channel

    def failed(self, channel: grpc.Channel) -> None:
        """Go on with the next gateway, unless another call has done so already."""
        with self._lock:
            if self._channels[self._at] is channel:
                self._at = (self._at + 1) % len(self._channels)

    def close(self) -> None:
        """End all calls."""
        with self._lock:
            self._closed = True
        for channel in self._channels:
            channel.close()

    def _ready(self, timeout: float) -> bool:
        channel = self._channels[self._at]
        try:
            grpc.channel_ready_future(channel).result(max(timeout, 0.01))
        except grpc.FutureTimeoutError:
            self.failed(channel)
            return False
        return True


class ResumedCall(ABC):
    """A call that is made again when it ends, at the next gateway; on a thread of its own.

    Args:
        channels: to gateways.
        method: that is called.
        name: of the thread.

    Attributes:
        error: why no further call is made; None while calls are made.
    """

    def __init__(self, channels: Channels, method: str, name: str) -> None:
        self.error: ClientError | None = None
        self._channels = channels
        self._method = method
        self._call: Any = None
        self._settled = threading.Event()  # the first call is in force, or there will be none
        self._in_force = False  # whether a call was
        self._is_last = False  # whether a call that ends without an error is the last one
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abstractmethod
    def _requests(self) -> Iterator[bytes]:
        """Return the requests of a call."""

    @abstractmethod
    def _take(self, response: bytes) -> None:
        """Process a response."""

    @abstractmethod
    def _began(self) -> None:
        """Note that a call was made."""

    @abstractmethod
    def _ended(self) -> None:
        """Note that no further call is made."""

    def _open(self, what: str, timeout: float) -> None:
        """Make the first call, and wait until it is in force.

        Raises:
            ConnectionFailed: it is not in time.
            ServiceRefused: the gateway refuses it.
        """
        self._thread.start()
        if not self._settled.wait(timeout):
            self.error = ConnectionFailed(f"no gRPC gateway took the {what} within {timeout:g} s")
        elif self._in_force:
            return
        self._end()
        if self.error is not None:
            raise self.error

    def _end(self) -> None:
        """Cancel the call, and make none any more."""
        self._over.set()
        if self._call is not None:
            self._call.cancel()
        self._ended()
        self._thread.join(CLOSE_S)

    def _settle(self) -> None:
        """Note that a call is in force."""
        self._in_force = True
        self._settled.set()

    def _fail(self, error: ClientError) -> None:
        self.error = error
        self._settled.set()
        self._ended()

    def _run(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._over.is_set():
            try:
                method, channel = self._channels.call(self._method)
                self._call = method(self._requests(), metadata=self._channels.metadata)
                self._began()
                for response in self._call:
                    pause = FIRST_PAUSE_S
                    self._take(response)
                if self._is_last:
                    return
            except grpc.RpcError as error:
                if lasting(error):
                    self._fail(ServiceRefused(f"the gateway refused: {error.details()}"))
                    return
            except DecodeError as error:
                self._fail(ServiceRefused(f"the gateway sent a response that cannot be read: {error}"))
                return
            except (ConnectionFailed, ValueError) as error:  # the connection, or the channel, was closed
                self._fail(ConnectionFailed(str(error)))
                return
            if not self._over.is_set():
                self._channels.failed(channel)
                self._over.wait(pause)
                pause = min(2 * pause, LONGEST_PAUSE_S)


def lasting(error: Any) -> bool:
    """Tell whether another try would end in the same way."""
    return error.code() not in _PASSING


def from_gateway(error: Any) -> bool:
    """Tell whether a gateway said this, and not that there is none."""
    return any(key == SAID_BY for key, _ in error.trailing_metadata() or ())


def _channel(address: str, credentials: grpc.ChannelCredentials | None) -> grpc.Channel:
    if credentials is None:
        return grpc.insecure_channel(address, options=OPTIONS)
    return grpc.secure_channel(address, credentials, options=OPTIONS)


def _credentials(path: Path) -> grpc.ChannelCredentials:
    folder = path if path.is_dir() else path.parent
    try:
        authority, key, certificate = ((folder / name).read_bytes() for name in ("ca.pem", "key.pem", "cert.pem"))
    except OSError as error:
        raise ConnectionFailed(f"certificates for gRPC: {error.filename}: {error.strerror}") from error
    return grpc.ssl_channel_credentials(authority, key, certificate)
