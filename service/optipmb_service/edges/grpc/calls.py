"""One call: its requests, its responses, and its end."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Final, TypeVar

import grpc
from google.protobuf import any_pb2
from google.rpc import error_details_pb2, status_pb2
from grpc_status import rpc_status
from optipmb_schemas.protobuf import convert

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    import optipmb_schemas as schemas
    from google.protobuf.message import Message as ProtoMessage

    from optipmb_service.edges.access import Caller
    from optipmb_service.edges.grpc.server import GrpcServer
    from optipmb_service.edges.queues import Outbox

    P = TypeVar("P", bound=ProtoMessage)

FIRST_S: Final = 30.0
"""How long a call may be open before its first message."""

CODES: Final[dict[str, grpc.StatusCode]] = {"too_large": grpc.StatusCode.RESOURCE_EXHAUSTED}
"""Codes of messages that are refused for another reason than that they are not valid."""

_SKIPPED: Final = b"\x18"
"""Tag of field 3, `skipped`, of all responses of streams: protobuf merges messages that stand one after the other."""


class EndCall(Exception):  # noqa: N818 - it ends a call, and need not be an error
    """Ends the call with a status: a code, one line, and details that name the field at fault, if there is one."""

    def __init__(self, code: grpc.StatusCode, message: str, error: schemas.MessageError | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.error = error

    @classmethod
    def invalid(cls, error: schemas.MessageError) -> EndCall:
        """Return the end of a call whose request is not valid."""
        code = CODES.get(error.code, grpc.StatusCode.INVALID_ARGUMENT)
        return cls(code, str(error), error.with_traceback(None))  # its frames hold the request

    def status(self) -> grpc.Status:
        """Return the status with its details."""
        status = status_pb2.Status(code=self.code.value[0], message=self.message)
        if self.error is not None:
            violation = error_details_pb2.BadRequest.FieldViolation(
                field=self.error.path,
                description=f"expected {self.error.expected}, received {self.error.received}",
                reason=self.error.code.upper(),
            )
            packed = any_pb2.Any()
            packed.Pack(error_details_pb2.BadRequest(field_violations=[violation]))
            status.details.append(packed)
        return rpc_status.to_status(status)


class CallerGoneError(Exception):
    """The caller has cancelled the call, its deadline has passed, or its connection is lost."""


@contextlib.contextmanager
def ending_with_caller() -> Iterator[None]:
    """Take any error of gRPC for the end of the caller: bytes of a call that is open can be written.

    Raises:
        CallerGoneError: there is an error.
    """
    try:
        yield
    except (asyncio.CancelledError, grpc.aio.AbortError):
        raise
    except Exception as error:
        raise CallerGoneError from error


class Call:
    """A call under way.

    Attributes:
        gateway: the server of the call.
        caller: who makes it.
        left_out: responses that the caller was too slow for.
        traceparent: W3C trace context in its metadata, unchecked.
    """

    def __init__(
        self, gateway: GrpcServer, context: grpc.aio.ServicerContext[Any, Any], caller: Caller, method: str
    ) -> None:
        self.gateway = gateway
        self.caller = caller
        self.left_out = 0
        self.traceparent = str(dict(context.invocation_metadata() or ()).get("traceparent", ""))
        self._context = context
        self._method = method
        self._ended = asyncio.Event()
        self._reading: asyncio.Task[Any] | None = None
        self._outbox: Outbox[bytes] | None = None

    def end(self) -> None:
        """Read nothing more; a call that only writes ends."""
        self._ended.set()
        if self._reading is not None:
            self._reading.cancel()
        elif self._outbox is not None:
            self._outbox.close()

    async def request(self, kind: type[P]) -> P:
        """Return the only request.

        Raises:
            EndCall: none comes.
            MessageError: it is another one.
        """
        return convert.parse(await self.first() or b"", kind)

    async def first(self) -> bytes | None:
        """Return the first request.

        Raises:
            EndCall: none comes.
        """
        try:
            async with asyncio.timeout(FIRST_S):
                return await self.read()
        except TimeoutError:
            code = grpc.StatusCode.DEADLINE_EXCEEDED
            raise EndCall(code, f"no message came within {FIRST_S:g} s of the call") from None

    async def read(self) -> bytes | None:
        """Return the next request; None when the caller has sent all, or the gateway ends."""
        if self._ended.is_set():
            return None
        self._reading = task = asyncio.current_task()
        try:
            request = await self._context.read()
        except asyncio.CancelledError:
            if not self._ended.is_set() or task is None or task.uncancel():
                raise
            return None
        finally:
            self._reading = None
        if request is grpc.aio.EOF:
            return None
        metrics = self.gateway.metrics
        metrics.requests[self._method] += 1
        metrics.request_bytes += len(request)
        return bytes(request)

    async def begin(self) -> None:
        """Tell the caller that the call is in force, before the first response.

        Raises:
            CallerGoneError: the caller has gone.
        """
        with ending_with_caller():
            await self._context.send_initial_metadata(())

    async def write(self, response: bytes) -> None:
        """Write a response; waits while the caller reads too slowly.

        Raises:
            CallerGoneError: the caller has gone.
        """
        with ending_with_caller():
            await self._context.write(response)
        self.gateway.metrics.responses[self._method] += 1

    async def drain(self, outbox: Outbox[bytes]) -> None:
        """Write the responses of an outbox until it is closed, and count those that it has left out."""
        self._outbox = outbox
        try:
            while (taken := await outbox.take()) is not None:
                response, skipped = taken
                await self.write(response + _SKIPPED + varint(skipped) if skipped else response)
        finally:
            self.left_out += outbox.left_out

    @contextlib.asynccontextmanager
    async def writing(self, outbox: Outbox[bytes]) -> AsyncIterator[None]:
        """Write the responses of an outbox meanwhile, and the rest of them at the end."""
        task = asyncio.create_task(self.drain(outbox))
        try:
            try:
                yield
            except Exception:
                # A write that is cancelled would keep the status from being sent: the rest is written before it.
                outbox.close()
                await asyncio.wait((task,))
                raise
            outbox.close()
            await task
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    def check_ending(self) -> None:
        """End a call that the gateway has ended and not the caller.

        Raises:
            EndCall: it has.
        """
        if self._ended.is_set():
            raise EndCall(grpc.StatusCode.UNAVAILABLE, "the gateway ends; call again, at any")


def varint(number: int) -> bytes:
    """Return a number as protobuf writes it."""
    parts = bytearray()
    while number > 0x7F:  # noqa: PLR2004 - seven bits in each byte
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    parts.append(number)
    return bytes(parts)
