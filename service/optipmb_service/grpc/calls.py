"""One call: who makes it, what it is given of the gateway, and how its responses are written."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol

import grpc

from optipmb_service.grpc.status import EndCall

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    import optipmb_schemas as schemas

    from optipmb_service.grpc.access import Caller
    from optipmb_service.grpc.feeds import Feeds
    from optipmb_service.grpc.metrics import CallMetrics
    from optipmb_service.grpc.outbox import Outbox
    from optipmb_service.grpc.publishers import Publishers
    from optipmb_service.zenoh.client import Client


class Context(Protocol):
    """What is used of gRPC's context of a call."""

    async def read(self) -> Any:
        """Return the next request, or EOF."""

    async def write(self, message: bytes) -> None:
        """Send a response."""

    async def send_initial_metadata(self, initial_metadata: Any) -> None:
        """Send the metadata that precede the first response."""

    async def abort(self, code: Any, details: str, trailing_metadata: Any) -> Any:
        """End the call with an error."""

    def auth_context(self) -> Any:
        """Return what is known of the caller's certificate."""

    def invocation_metadata(self) -> Any:
        """Return the metadata that the caller has sent."""

    def peer(self) -> str:
        """Return the address of the caller."""


FIRST_S: Final = 30.0
"""How long a call may be open before its first message."""


@dataclass(frozen=True)
class Gateway:
    """What calls share."""

    client: Client
    feeds: Feeds
    publishers: Publishers
    instance: str
    limits: schemas.Limits
    refused: Callable[[schemas.Problem], None]
    """Called with the problem of a message that is not valid."""
    calls: set[Call] = field(default_factory=set)


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

    Args:
        gateway: that serves it.
        context: of gRPC.
        caller: who makes it.
        name: of the method.
        metrics: what counts its messages.

    Attributes:
        left_out: responses that the caller was too slow for.
    """

    def __init__(self, gateway: Gateway, context: Context, caller: Caller, name: str, metrics: CallMetrics) -> None:
        self.gateway = gateway
        self.caller = caller
        self._ended = asyncio.Event()
        self.left_out = 0
        self._context = context
        self._reading: asyncio.Task[Any] | None = None
        self._outbox: Outbox | None = None
        self._name = name
        self._metrics = metrics

    def end(self) -> None:
        """Read nothing more; a call that only writes ends."""
        self._ended.set()
        if self._reading is not None:
            self._reading.cancel()
        elif self._outbox is not None:
            self._outbox.close()

    async def first(self) -> bytes | None:
        """Return the first request.

        Raises:
            EndCall: none comes.
        """
        try:
            return await asyncio.wait_for(self.read(), FIRST_S)
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
        self._metrics.requests[self._name] += 1
        self._metrics.request_bytes += len(request)
        return bytes(request)

    async def begin(self) -> None:
        """Tell the caller that the call is in force, before the first response.

        Raises:
            CallerGoneError: there is nobody to tell.
        """
        with ending_with_caller():
            await self._context.send_initial_metadata(())

    async def write(self, response: bytes) -> None:
        """Write a response; waits while the caller reads too slowly.

        Raises:
            CallerGoneError: nobody reads it.
        """
        with ending_with_caller():
            await self._context.write(response)
        self._metrics.responses[self._name] += 1

    async def drain(self, outbox: Outbox) -> None:
        """Write what comes into an outbox until it is closed."""
        self._outbox = outbox
        while (response := await outbox.take()) is not None:
            await self.write(response)

    @contextlib.asynccontextmanager
    async def writing(self, outbox: Outbox) -> AsyncIterator[None]:
        """Write what comes into an outbox meanwhile, and at the end what is left in it."""
        task = asyncio.create_task(self.drain(outbox))
        try:
            try:
                yield
            except Exception:
                # A write that is cancelled would keep the status from being sent: what is left is written before it.
                outbox.close()
                await asyncio.wait((task,))
                raise
            outbox.close()
            await task
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            self.left_out += outbox.left_out

    def check_ending(self) -> None:
        """End a call that the gateway has ended and not the caller.

        Raises:
            EndCall: it has.
        """
        if self._ended.is_set():
            raise EndCall(grpc.StatusCode.UNAVAILABLE, "the gateway ends; call again, at any")
