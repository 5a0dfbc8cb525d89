"""A connection to gateways, with what publishers, subscribers and replays use of a Zenoh connection."""

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self

import grpc
from optipmb_schemas import (
    Keys,
    Links,
    Message,
    Problem,
    ResetRequest,
    SessionParameters,
    SessionState,
    Topic,
    decode,
    encode,
    encoding_of,
)
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_client.errors import ClientError, ConnectionFailed
from optipmb_client.grpc.channels import Channels, from_gateway, lasting
from optipmb_client.grpc.streams import GrpcSender, GrpcSubscription, Publishing
from optipmb_client.incoming import Answer, Inbox

__all__ = ["GrpcConnection"]


class GrpcConnection:
    """A connection to one of several gateways; when it goes, the next one is taken.

    Args:
        addresses: of gateways, `host:port`.
        config: a folder with `key.pem`, `cert.pem` and `ca.pem`, or a file in it; default: no TLS.
        metadata: sent with every call, such as a token.
        timeout: seconds to wait for a gateway.

    Raises:
        ConnectionFailed: no gateway answers within `timeout`, or a certificate cannot be read.
    """

    def __init__(
        self,
        addresses: Sequence[str],
        *,
        config: str | Path | None = None,
        metadata: Mapping[str, str] = MappingProxyType({}),
        timeout: float = 5.0,
    ) -> None:
        self.where = ", ".join(addresses)
        if not timeout >= 0:  # NaN is not
            text = f"timeout: expected seconds, 0 or more, received {timeout!r}"
            raise ConnectionFailed(text, endpoints=tuple(addresses))
        self._timeout = min(timeout, threading.TIMEOUT_MAX)
        self._channels = Channels(addresses, config, metadata, self._timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all calls. May be called twice."""
        self._channels.close()

    def senders(self, stream: str, *, prefix: str, cache: int, cache_clouds: int) -> tuple[GrpcSender, GrpcSender]:
        """Return what sends the detections and the clouds of a stream; the prefix is the gateway's affair."""
        del prefix
        publishing = Publishing(self._channels, stream, cache, cache_clouds, self._timeout)
        return GrpcSender(publishing, "detections"), GrpcSender(publishing, "points")

    def subscribe_streams(
        self, pattern: str, inbox: Inbox, *topics: Topic, prefix: str, history: bool
    ) -> GrpcSubscription:
        """Move topics of a pattern of streams into an inbox: tracks or `now`, perhaps with problems, or events."""
        return GrpcSubscription(
            self._channels, pattern, inbox, Keys(prefix), topics=topics, history=history, timeout=self._timeout
        )

    def query(self, key: str, payload: bytes = b"", encoding: str = "", *, timeout: float = 2.0) -> tuple[Answer, ...]:
        """Ask at the key of a query about a stream (its state, its parameters, a reset), or about the links of an area.

        Returns:
            The answer; an error as a problem; nothing when no service answers.

        Raises:
            ClientError: it is another query.
        """
        head, _, name = key.rpartition("/q/")
        stream = "/".join(head.split("/")[-3:])
        if name not in _QUERIES:
            raise ClientError(f"q/{name} is not offered over gRPC; connect to Zenoh")
        method, request, field, kind = _QUERIES[name](stream, payload, encoding)
        call, channel = self._channels.call(method)
        try:
            requests = iter((request.SerializeToString(),))
            responses = list(call(requests, timeout=timeout, metadata=self._channels.metadata))
        except grpc.RpcError as error:
            if lasting(error):
                return (_refusal(stream, error),)
            if not from_gateway(error):
                self._channels.failed(channel)
            return ()
        response = getattr(pb, f"{method}Response").FromString(responses[0])
        message = convert.from_proto(getattr(response, field), kind)
        return (Answer(key, encode(message), encoding_of(message), ok=True),)


def _refusal(stream: str, error: Any) -> Answer:
    text = str(error.details())[:500]
    problem = Problem(stream=stream, instance="gateway", code=error.code().name.lower(), message=text)
    return Answer("", encode(problem), encoding_of(problem), ok=False)


_Asked = tuple[str, Any, str, type[Message]]


def _state(stream: str, _payload: bytes, _encoding: str) -> _Asked:
    return "GetState", pb.GetStateRequest(stream=stream), "state", SessionState


def _links(place: str, _payload: bytes, _encoding: str) -> _Asked:
    return "GetLinks", pb.GetLinksRequest(area=place.rpartition("/")[2]), "links", Links


def _reset(stream: str, payload: bytes, encoding: str) -> _Asked:
    asked = decode(payload, ResetRequest, encoding=encoding) if payload else ResetRequest()
    return "Reset", pb.ResetRequest(stream=stream, close=asked.close), "state", SessionState


def _parameters(stream: str, payload: bytes, encoding: str) -> _Asked:
    asked = decode(payload, SessionParameters, encoding=encoding) if payload else SessionParameters()
    request = pb.SetParametersRequest(stream=stream, parameters=convert.to_proto(asked))
    return "SetParameters", request, "parameters", SessionParameters


_QUERIES: Final[Mapping[str, Callable[[str, bytes, str], _Asked]]] = {
    "links": _links,
    "state": _state,
    "reset": _reset,
    "parameters": _parameters,
}
