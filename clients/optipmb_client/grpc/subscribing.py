"""The tracks of a pattern on their way from a gateway into an inbox: subscribed again at the next one when it goes."""

import threading
import time
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

import grpc
from optipmb_schemas import Keys, Message
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_client.errors import ClientError, ConnectionFailed
from optipmb_client.grpc.channels import FIRST_PAUSE_S, LONGEST_PAUSE_S, Channels, lasting, refused
from optipmb_client.incoming import Arrival, Inbox

__all__ = ["GrpcSubscription"]

T = TypeVar("T", bound=Message)

QUEUE: Final = 1024
"""Messages of a stream that may wait in the gateway: the most that it allows."""


@dataclass(frozen=True)
class _ProtoArrival(Arrival):
    """A message that came in protobuf."""

    proto: Any = field(kw_only=True)

    def read(self, kind: type[T]) -> T:
        """Return the message, checked.

        Raises:
            MessageError: it is not valid.
        """
        return convert.from_proto(self.proto, kind)


class GrpcSubscription:
    """A `Subscribe` call, made anew when it ends; what the services keep comes first each time.

    Args:
        channels: to gateways.
        pattern: of streams.
        inbox: for what comes.
        keys: of the network, for the names of arrivals.
        problems: whether problems come too.
        timeout: seconds to wait until it is in force.

    Raises:
        ConnectionFailed: it is not in force in time.
        ServiceRefused: the gateway does not allow it.
    """

    def __init__(
        self, channels: Channels, pattern: str, inbox: Inbox, keys: Keys, *, problems: bool, timeout: float
    ) -> None:
        request = pb.SubscribeRequest(pattern=pattern, queue=QUEUE, history=True, problems=problems)
        self._request = request.SerializeToString()
        self._channels = channels
        self._inbox = inbox
        self._keys = keys
        self._call: Any = None
        self._over = threading.Event()
        self._settled = threading.Event()
        self._error: ClientError | None = None
        self._thread = threading.Thread(target=self._run, name=f"subscribe {pattern}", daemon=True)
        self._thread.start()
        if not self._settled.wait(timeout):
            self._error = ConnectionFailed(f"no gRPC gateway took the subscription within {timeout:g} s")
        if self._error is not None:
            self.close()
            raise self._error

    def close(self) -> None:
        """End it; what is in the inbox stays readable."""
        self._over.set()
        if self._call is not None:
            self._call.cancel()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._over.is_set():
            channel: Any = None
            try:
                method, channel = self._channels.call("Subscribe")
                self._call = method(iter((self._request,)), metadata=self._channels.metadata)
                self._call.initial_metadata()  # it is in force
                if self._call.is_active():
                    self._settled.set()
                for response in self._call:
                    pause = FIRST_PAUSE_S
                    self._take(pb.SubscribeResponse.FromString(response))
            except grpc.RpcError as error:
                if lasting(error):
                    self._end(refused(error))
                    return
            except (ConnectionFailed, ValueError) as error:  # the connection, or the channel, was closed
                self._end(ConnectionFailed(str(error)))
                return
            if not self._over.wait(pause):
                self._channels.failed(channel)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _end(self, error: ClientError) -> None:
        self._error = error
        self._settled.set()
        if not self._over.is_set():
            self._inbox.close()  # nothing will come any more

    def _take(self, response: pb.SubscribeResponse) -> None:
        self._inbox.dropped += response.skipped
        tracks = response.WhichOneof("response") == "tracks"
        proto = response.tracks if tracks else response.problem
        key = self._keys.tracks(proto.stream) if tracks else self._keys.problems(proto.stream)
        self._inbox.put(_ProtoArrival(key, b"", "application/protobuf", time.monotonic_ns(), proto=proto))
