"""The actors of a service by stream: makes one for whatever arrives, forgets those that have nothing left to do.

Any thread may ask; one lock guards the table, and nothing slow is done under it.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Final

from optipmb_service.session.values import MessageCounters

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.cluster.member import Member
    from optipmb_service.runtime.context import Actor
    from optipmb_service.runtime.scheduler import Scheduler
    from optipmb_service.runtime.stream_actor import StreamActor

MAX_UNPROVEN_ACTORS: Final = 256
"""Actors at once of streams that have not sent a valid message yet."""

MAX_UNPROVEN_ACTORS_STRAINED: Final = 16
"""The same while the lease is renewed late: each of them delays that."""


class ActorTable:
    """The actors, and what became of the messages of those that are gone.

    Args:
        make: makes the actor of a stream.
        scheduler: gives them their turns.
        member: says whether the lease is renewed late.
    """

    def __init__(self, make: Callable[[str], StreamActor], scheduler: Scheduler, member: Member) -> None:
        self._make = make
        self._scheduler = scheduler
        self._member = member
        self._lock = threading.Lock()
        self._actors: dict[str, StreamActor] = {}
        self._unproven: set[StreamActor] = set()
        self._past = MessageCounters()

    def of(self, stream: str) -> StreamActor | None:
        """Return the actor of a stream, with a session or without."""
        with self._lock:
            return self._actors.get(stream)

    def every(self) -> list[StreamActor]:
        """Return all actors, in any order."""
        with self._lock:
            return list(self._actors.values())

    def tracking(self) -> list[StreamActor]:
        """Return the actors that have a session, in any order."""
        return [actor for actor in self.every() if actor.session is not None]

    def in_order(self) -> list[StreamActor]:
        """Return the actors that have a session, by stream name."""
        with self._lock:
            actors = sorted(self._actors.items())
        return [actor for _, actor in actors if actor.session is not None]

    def offer(self, stream: str, offer: Callable[[StreamActor], bool | None], *, limited: bool = True) -> bool:
        """Offer something to the mailbox of a stream's actor; False when there is no room for one.

        Args:
            stream: of the actor.
            offer: puts it into the mailbox; returns whether the actor must be scheduled, None when the actor has ended.
            limited: whether none is made when too many streams are new.
        """
        while True:
            # A look without the lock finds most.
            actor = self._actors.get(stream) or self._actor(stream, limited=limited)
            if actor is None:
                return False
            must_schedule = offer(actor)
            if must_schedule is not None:
                break
            # The actor has closed since it was found: once more, with a new one.
            self.discard(actor)
        if must_schedule:
            self._scheduler.submit(actor)
        return True

    def discard(self, actor: Actor) -> None:
        """Forget an actor that has ended, but not what became of its messages."""
        with self._lock:
            if self._actors.get(actor.stream) is actor:
                del self._actors[actor.stream]
                self._unproven.discard(actor)
                self._past += actor.totals()

    def count(self, messages: MessageCounters) -> None:
        """Count messages that came to no actor."""
        with self._lock:
            self._past += messages

    def totals(self) -> MessageCounters:
        """Return what became of all messages since the start."""
        with self._lock:
            totals, actors = self._past, list(self._actors.values())
        for actor in actors:
            totals += actor.totals()
        return totals

    def has_room(self) -> bool:
        """Whether another stream may be new."""
        with self._lock:
            return not self._crowded()

    def _actor(self, stream: str, *, limited: bool) -> StreamActor | None:
        with self._lock:
            actor = self._actors.get(stream)
            if actor is None and not (self._crowded() and limited):
                actor = self._actors[stream] = self._make(stream)
                self._unproven.add(actor)
            return actor

    def _crowded(self) -> bool:
        """Whether too many streams have not sent a valid message yet, as far as is known; called with the lock."""
        most = MAX_UNPROVEN_ACTORS_STRAINED if self._member.strained else MAX_UNPROVEN_ACTORS
        if len(self._unproven) >= most:
            known = self._actors.get
            self._unproven = {one for one in self._unproven if not one.occupied and known(one.stream) is one}
        return len(self._unproven) >= most
