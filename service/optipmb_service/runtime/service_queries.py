"""Answers to queries about the service: its status, its metrics, streams that are to be moved, messages handed over."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import optipmb_schemas as schemas

from optipmb_service.cluster.store import StoreError
from optipmb_service.runtime.requests import guarded, problem_with

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_service.cluster.leases import MemberLease
    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.ports import Packet, Request
    from optipmb_service.runtime.registry import Registry

TEXT = "text/plain;version=0.0.4"
"""Zenoh encoding of the metrics."""

JSON = "application/json"
"""Zenoh encoding of the metrics as data."""

MOVE_S = 15.0
"""How long a stream may take to be moved; it takes a second."""

UNDRAINED = "not all taken in time; it goes on draining until that is undone"
"""Why a drain was not confirmed."""

MOVES = 16
"""Moves that wait for each other."""


class ServiceQueries:
    """Answers every request about the service, and finishes it whatever happens.

    Args:
        registry: the streams.
        status: makes the status of the service.
        metrics: makes its metrics, in Prometheus' text format.
        samples: makes its metrics as data for the parent of this process.
        member: the partitions of this process.
        hand_over: gives what was received lately of sessions that are tracked elsewhere now.
        workers: how many processes the service has.
    """

    def __init__(
        self,
        registry: Registry,
        *,
        status: Callable[[], schemas.ServiceStatus],
        metrics: Callable[[], bytes],
        samples: Callable[[], bytes],
        member: Member,
        hand_over: Callable[[Iterable[str], Callable[[Packet], None]], None],
        workers: int,
    ) -> None:
        self._instance = registry.instance
        self._keys = registry.keys
        self._limits = registry.limits
        self._fusion = registry.fusion
        self._status = status
        self._metrics = metrics
        self._samples = samples
        self._member = member
        self._handed_over = hand_over
        self._workers = workers
        self._moves = ThreadPoolExecutor(1, "move")
        self._moving = threading.BoundedSemaphore(MOVES)
        self._handovers = ThreadPoolExecutor(1, "recent")

    def answer(self, request: Request) -> None:
        """Answer with the status of the service, its metrics, or both when the key has a `*`; or have streams moved."""
        instance = self._instance
        if request.key == self._keys.recent():
            self._handovers.submit(guarded, request, lambda: self._hand_over(request))
            return
        if request.key in {self._keys.move(instance), self._keys.drain(instance)}:
            if self._moving.acquire(blocking=False):
                moves = self._move if request.key == self._keys.move(instance) else self._drain
                self._moves.submit(self._move_in_turn, request, moves)
            else:
                many = schemas.MessageError("invalid_value", "worker", f"at most {MOVES} moves at a time", "more")
                guarded(request, lambda: request.refuse(self._problem(many)))
            return
        guarded(request, lambda: self._report(request, self._keys.status(instance), self._keys.metrics(instance)))

    def _report(self, request: Request, status: str, metrics: str) -> None:
        if request.key == self._keys.samples(self._instance):
            request.answer_text(request.key, self._samples(), JSON)
            return
        if request.matches(status):
            request.answer(status, self._status())
        if request.matches(metrics):
            request.answer_text(metrics, self._metrics(), TEXT)

    def _hand_over(self, request: Request) -> None:
        """Answer with what was received lately of sessions, whose names are lines, to who tracks them now."""
        key = self._keys.recent(self._instance)

        def give(packet: Packet) -> None:
            request.answer_text(key, packet.payload or b"", packet.encoding, about=packet.key)

        self._handed_over((request.payload or b"").decode("ascii", "replace").splitlines(), give)

    def _move_in_turn(self, request: Request, moves: Callable[[Request], None]) -> None:
        try:
            guarded(request, lambda: moves(request))
        finally:
            self._moving.release()

    def _move(self, request: Request) -> None:
        """Have a stream brought here, and say so."""
        try:
            asked = move_asked(request, self._limits, self._workers)
        except schemas.MessageError as error:
            request.refuse(self._problem(error))
            return
        try:
            received = "" if self._member.bring(self._fusion.session_of(asked.stream), MOVE_S) else "none in time"
        except StoreError as error:
            received = str(error)
        if received:
            failed = schemas.MessageError("invalid_value", "worker", "a worker to which the stream comes", received)
            request.refuse(self._problem(failed, asked.stream))
        else:
            request.answer(request.key, asked)

    def _drain(self, request: Request) -> None:
        """Have all streams taken by others, and say so."""
        try:
            asked = drain_asked(request, self._limits)
        except schemas.MessageError as error:
            request.refuse(self._problem(error))
            return
        received = "none" if asked.drain and not self._member.others else ""
        if not received:
            self._member.drain(drains=asked.drain)
            if asked.drain and not self._member.drained(MOVE_S):
                received = UNDRAINED
        if received:
            failed = schemas.MessageError("invalid_value", "drain", "another member that takes the streams", received)
            request.refuse(self._problem(failed))
        else:
            request.answer(request.key, asked)

    def _problem(self, error: schemas.MessageError, stream: str = "") -> schemas.Problem:
        return problem_with(error, instance=self._instance, stream=stream)


def move_asked(request: Request, limits: schemas.Limits, workers: int) -> schemas.MoveRequest:
    """Return what a request to move a stream says.

    Raises:
        MessageError: it is none, or there is no such worker.
    """
    asked = schemas.decode(request.payload or b"", schemas.MoveRequest, encoding=request.encoding, limits=limits)
    if asked.worker >= workers:
        raise schemas.MessageError("invalid_value", "worker", f"a worker from 0 to {workers - 1}", str(asked.worker))
    return asked


def drain_asked(request: Request, limits: schemas.Limits) -> schemas.DrainRequest:
    """Return what a request to leave all streams says.

    Raises:
        MessageError: it is none.
    """
    if not request.payload:
        return schemas.DrainRequest()
    return schemas.decode(request.payload, schemas.DrainRequest, encoding=request.encoding, limits=limits)


def members_of(leases: Sequence[MemberLease]) -> tuple[schemas.MemberSummary, ...]:
    """Return the lines of the members in the status."""
    return tuple(
        schemas.MemberSummary(
            member=one.member,
            state=one.state,
            age_s=one.age_ns / 1e9,
            partitions=tuple(one.fences),
            fences=tuple(one.fences.values()),
        )
        for one in leases
    )
