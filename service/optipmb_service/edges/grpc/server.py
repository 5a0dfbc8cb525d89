"""The gateway as a server: methods, health, reflection, metrics, limits of connections, and an end in order."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import ctypes
import resource
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import grpc
import optipmb_schemas as schemas
import structlog
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection
from optipmb_client.errors import ClientError
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_schemas.protobuf import tracking_pb2 as pb

from optipmb_service.edges.access import NotAllowedError
from optipmb_service.edges.grpc import publishing, subscribing
from optipmb_service.edges.grpc.access import Access, credentials
from optipmb_service.edges.grpc.calls import Call, CallerGoneError, EndCall, ending_with_caller
from optipmb_service.edges.grpc.network import Network
from optipmb_service.telemetry.problem_reporter import ProblemReporter

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.client import Client

    Context = grpc.aio.ServicerContext[Any, Any]

SERVICE: Final = pb.DESCRIPTOR.services_by_name["TrackingService"].full_name

METHODS: Final[dict[str, Callable[[Call], Awaitable[None]]]] = {
    "Track": publishing.track,
    "Publish": publishing.publish,
    "Subscribe": subscribing.subscribe,
    "SubscribeEvents": subscribing.subscribe_events,
    "QueryTracks": subscribing.query_tracks,
    "GetState": subscribing.get_state,
    "GetLinks": subscribing.get_links,
    "Reset": subscribing.reset,
    "SetParameters": subscribing.set_parameters,
    "ListStreams": subscribing.list_streams,
}

SAID_BY: Final = "optipmb-gateway"
"""Trailing metadata by which a gateway signs its errors: others come of the way to it."""

GRACE_S: Final = 1.0
"""How long calls may take to finish at the end."""

LINK_S: Final = 0.5
"""How often the gateway looks whether it has a router."""

TRIM_BYTES: Final = 64 * 2**20
"""Bytes of requests after which the memory that they took is given back."""

OTHER_FILES: Final = 256
"""Files of a process beside the connections of gRPC: its own, and a service's with its links and its store.

Where the limit of open files is low, half of it.
"""

HEADROOM: Final = 64 * 2**10
"""Bytes of a request beyond its payload."""

OPTIONS: Final = (
    ("grpc.so_reuseport", 0),  # two gateways on one port would share it without a word
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.http2.ping_timeout_ms", 10_000),  # keepalive_timeout_ms has no effect in grpcio 1.85
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
    ("grpc.max_connection_idle_ms", 300_000),
    ("grpc.server_handshake_timeout_ms", 10_000),
    ("grpc.max_metadata_size", 16 * 2**10),
)

log = structlog.get_logger("optipmb_service")


class CallMetrics:
    """Counts of calls; written on the loop, or by one thread each, and read by any."""

    def __init__(self) -> None:
        self.open: collections.Counter[str] = collections.Counter()
        self.ended: collections.Counter[tuple[str, str]] = collections.Counter()
        self.requests: collections.Counter[str] = collections.Counter()
        self.responses: collections.Counter[str] = collections.Counter()
        self.skipped: collections.Counter[str] = collections.Counter()
        self.refused: collections.Counter[str] = collections.Counter()
        self.request_bytes = 0
        self.invalid = 0


class GrpcServer:
    """A gateway that serves, and what its calls share; to be made and used on its loop.

    Args:
        settings: address, certificates, access, limits.
        client: of the network.
        sessions: returns the session that a stream feeds.

    Raises:
        ClientError: the address, the certificates or the access cannot be used.
    """

    def __init__(self, settings: Settings, client: Client, sessions: Callable[[str], str]) -> None:
        self.metrics = CallMetrics()
        self.client = client
        self.session_of = sessions
        self.instance = settings.instance
        self.limits = settings.limits.limits()
        self.network = Network(client, self._invalid)
        self._calls: set[Call] = set()
        self._reporter = ProblemReporter(client.publish_problem)
        self._most = settings.grpc_calls
        self._access = Access(
            certificates=settings.grpc_tls is not None,
            names=settings.grpc_names,
            tokens=settings.grpc_tokens,
            reads=settings.readable_by,
        )
        most = settings.limits.max_bytes + HEADROOM
        options = (
            *OPTIONS,
            ("grpc.max_receive_message_length", most),
            ("grpc.max_send_message_length", -1),
            ("grpc.max_allowed_incoming_connections", _connections(settings.grpc_connections)),
            ("grpc.max_concurrent_streams", settings.grpc_calls + 1),  # one more is refused, and does not wait
        )
        self._server = grpc.aio.server(options=options)
        self._health = health.aio.HealthServicer()
        self._watching: asyncio.Task[None] | None = None
        self._register()
        self.address = self._listen(settings)

    async def start(self) -> None:
        await self._server.start()
        self._watching = asyncio.create_task(self._watch())

    async def stop(self) -> None:
        """Refuse new calls, finish the open ones, and end."""
        if self._watching is not None:
            self._watching.cancel()
        await self._health.enter_graceful_shutdown()
        for call in tuple(self._calls):
            call.end()
        await self._server.stop(GRACE_S)
        await asyncio.to_thread(self.network.close)

    def refused(self, problem: schemas.Problem) -> None:
        """Count and report the problem of a message that is not valid."""
        self.metrics.refused[problem.code] += 1
        self._reporter.report(problem, time.monotonic_ns())

    def _register(self) -> None:
        # On the wire a call with one request is a stream of one: all methods have one kind of handler.
        handlers: dict[str, grpc.RpcMethodHandler[bytes, bytes]] = {
            name: grpc.stream_stream_rpc_method_handler(self._handler(name)) for name in METHODS
        }
        self._server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self._server)

    def _listen(self, settings: Settings) -> str:
        try:
            if settings.grpc_tls is None:
                port = self._server.add_insecure_port(settings.grpc)
            else:
                port = self._server.add_secure_port(settings.grpc, credentials(settings.grpc_tls))
        except RuntimeError as error:
            raise ClientError(f"cannot listen on {settings.grpc} for gRPC: is the address in use?") from error
        return f"{settings.grpc.rpartition(':')[0]}:{port}"

    async def _watch(self) -> None:
        """Tell the health service whether the network can be used, and report problems that are due, for ever."""
        known: bool | None = None
        trimmed = 0
        while True:
            self._reporter.flush(time.monotonic_ns())
            if self.metrics.request_bytes - trimmed > TRIM_BYTES:
                trimmed = self.metrics.request_bytes
                await asyncio.to_thread(_trim)
            linked = self.client.linked()
            if linked != known:
                known = linked
                status = health_pb2.HealthCheckResponse
                for name in ("", SERVICE):
                    await self._health.set(name, status.SERVING if linked else status.NOT_SERVING)
            await asyncio.sleep(LINK_S)

    def _handler(self, name: str) -> Callable[[Any, Context], Awaitable[None]]:
        async def handle(_requests: Any, context: Context) -> None:
            began, code = time.monotonic(), "OK"
            self.metrics.open[name] += 1
            end: EndCall | None = None
            try:
                try:
                    await self._serve(name, context)
                except EndCall as raised:
                    end = raised
                if end is not None:
                    # A request may be 32 MB, and the frames of its exceptions hold it until the next collection.
                    end.__traceback__ = end.__context__ = end.__cause__ = None
                    code = end.code.name
                    status = end.status()
                    signed = (*(status.trailing_metadata or ()), (SAID_BY, self.instance))
                    with ending_with_caller():
                        await context.abort(status.code, status.details, signed)
            except CallerGoneError:
                code = "CANCELLED"
                raise asyncio.CancelledError from None
            except asyncio.CancelledError:
                code = "CANCELLED"
                raise
            finally:
                self.metrics.open[name] -= 1
                self.metrics.ended[name, code] += 1
                log.debug(
                    "grpc_call", method=name, peer=context.peer(), code=code, seconds=round(time.monotonic() - began, 3)
                )

        return handle

    async def _serve(self, name: str, context: Context) -> None:
        """Serve a call.

        Raises:
            EndCall: it cannot be served, or ends otherwise than by its end.
        """
        if len(self._calls) >= self._most:
            raise EndCall(grpc.StatusCode.RESOURCE_EXHAUSTED, f"{self._most} calls are open; try another gateway")
        call = Call(self, context, await self._access.caller(context), name)
        self._calls.add(call)
        try:
            await METHODS[name](call)
        except schemas.MessageError as error:
            self.metrics.refused[error.code] += 1
            raise EndCall.invalid(error) from None
        except NotAllowedError as error:
            raise EndCall(grpc.StatusCode.PERMISSION_DENIED, str(error)) from None
        except TransportError as error:
            raise EndCall(grpc.StatusCode.UNAVAILABLE, f"the network cannot be used: {error}") from error
        except (EndCall, CallerGoneError, asyncio.CancelledError):
            raise
        except Exception as error:
            log.exception("internal_error", method=name)
            raise EndCall(grpc.StatusCode.INTERNAL, "a fault of the gateway; its log has it") from error
        finally:
            self._calls.discard(call)
            self.metrics.skipped[name] += call.left_out

    def _invalid(self, reason: str) -> None:
        self.metrics.invalid += 1
        log.warning("grpc_invalid", reason=reason)


@contextlib.contextmanager
def serving(settings: Settings, client: Client, sessions: Callable[[str], str]) -> Iterator[GrpcServer]:
    """Serve meanwhile, on a thread with a loop of its own: neither side waits for the other. As `GrpcServer`.

    Raises:
        ClientError: the address, the certificates or the access cannot be used.
    """
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="grpc", daemon=True)
    thread.start()

    async def begin() -> GrpcServer:
        server = GrpcServer(settings, client, sessions)
        await server.start()
        return server

    server: GrpcServer | None = None
    try:
        server = asyncio.run_coroutine_threadsafe(begin(), loop).result()
        log.info("grpc", address=server.address)
        yield server
    finally:
        if server is not None:
            with contextlib.suppress(TimeoutError):
                asyncio.run_coroutine_threadsafe(server.stop(), loop).result(2 * GRACE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(GRACE_S)


def _trim() -> None:
    """Give back the memory of requests that are done with: the allocator of the C library keeps gigabytes."""
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)


def _connections(wanted: int) -> int:
    """Return how many connections there may be: each takes a file, and the process asks for as many as that takes."""
    files, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = wanted + OTHER_FILES
    if files == resource.RLIM_INFINITY or files >= needed:
        return wanted
    files = needed if most == resource.RLIM_INFINITY else min(needed, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, most))
    allowed = min(wanted, max(1, files - min(OTHER_FILES, files // 2)))
    if allowed < wanted:
        log.warning("grpc_connections", allowed=allowed, wanted=wanted, files=files)
    return allowed
