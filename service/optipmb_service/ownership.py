"""Who tracks a stream, when several instances could: decisions only, no clock, no network, no threads.

Every owner holds a liveliness token `owner/<stream>/<instance>`, which others watch, and below it one that says claim.
Tokens vanish with their process, with its link, or when it has not been heard of for a lease. The rules, by which
exactly one instance keeps a stream:

- Who wants a stream that nobody owns declares its claim and then looks at all claims of the stream. Alone: it owns.
  Beside a lower name it withdraws. Beside higher names only it waits a moment: another claimant withdraws meanwhile,
  an owner does not, and then it withdraws itself.
- Two owners can meet after a network was cut. When both tokens persist, the lower name keeps.
- An owner writes only during its *tenure*, which is renewed every moment while it is linked and half as long as the
  lease. A process that was frozen, or cut off, finds its tenure lapsed. It then looks first: where another holds a
  token it stands down, whatever the names are, for the other may have gone on; else it goes on itself.
- Who stands by claims as soon as the last token of the stream is gone. After a loss of its own link it waits for a
  lease: the owner may have lost its link too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum, unique
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@unique
class Standing(StrEnum):
    """What an instance is to a stream."""

    NONE = "none"
    """It has not asked for it."""
    CLAIMING = "claiming"
    """It wants it: its token is declared, or will be in a moment, and it looks for others."""
    OWNER = "owner"
    """It tracks the stream."""
    STANDBY = "standby"
    """Another one tracks it."""


@unique
class Change(StrEnum):
    """What becomes of a seat."""

    GRANTED = "granted"
    DENIED = "denied"
    LOST = "lost"


@dataclass(slots=True)
class _Seat:
    standing: Standing
    since_ns: int
    """When it was asked for, claimed, or decided on."""
    declared: bool = False
    denied: bool = False
    rival_since_ns: int | None = None


class Tenure:
    """The time during which an owner may write without looking; read by any thread, written by one.

    Args:
        length_ns: how long a renewal holds, monotonic time.
    """

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._until_ns = 0

    def valid(self, now_ns: int) -> bool:
        """Whether the tenure holds."""
        return now_ns < self._until_ns

    def renew(self, now_ns: int) -> None:
        """Let it hold from now."""
        self._until_ns = now_ns + self._length_ns

    def lapse(self) -> None:
        """End it: writing has to wait until somebody has looked who else holds tokens."""
        self._until_ns = 0


@dataclass
class Seats:
    """The seats of one instance. All times are monotonic, ns.

    Attributes:
        instance: its name.
        lease_ns: how long after the loss of its own link it takes over nothing.
        settle_ns: how long a claimant waits for claimants of a higher name.
        persist_ns: how long two owners stand beside each other before the higher name gives way.
    """

    instance: str
    lease_ns: int
    settle_ns: int
    persist_ns: int
    _seats: dict[str, _Seat] = field(default_factory=dict)
    _others: dict[str, set[str]] = field(default_factory=dict)
    _linked_ns: int | None = None

    def standing(self, stream: str) -> Standing:
        """Return what this instance is to a stream; may be called by any thread."""
        seat = self._seats.get(stream)
        return seat.standing if seat else Standing.NONE

    def owned(self) -> list[str]:
        """Return the streams whose owner this instance is."""
        return [stream for stream, seat in self._seats.items() if seat.standing is Standing.OWNER]

    def told(self, stream: str, instance: str, *, present: bool) -> bool:
        """Note that a token came or went; True: it was one of this instance's own, and it is gone unasked."""
        if instance == self.instance:
            return not present and self.standing(stream) is Standing.OWNER
        others = self._others.setdefault(stream, set())
        if present:
            others.add(instance)
        else:
            others.discard(instance)
        if not others:
            del self._others[stream]
        return False

    def elsewhere(self, stream: str) -> bool:
        """Whether another instance tracks a stream, as far as is known; may be called by any thread."""
        return stream in self._others and self.standing(stream) is not Standing.OWNER

    def seek(self, stream: str, now_ns: int) -> None:
        """Ask for a stream; what becomes of it is said by `decide`."""
        if stream not in self._seats:
            known = stream in self._others
            self._seats[stream] = _Seat(Standing.STANDBY if known else Standing.CLAIMING, now_ns)

    def leave(self, stream: str) -> None:
        """Give up a stream, or standing by for it."""
        self._seats.pop(stream, None)

    def claims(self, now_ns: int, *, linked: bool) -> list[str]:
        """Return the streams whose token is to be declared now, before `decide` is given all tokens."""
        if not linked:
            self._linked_ns = None
            return []
        if self._linked_ns is None:
            # At the start nothing was lost; the subtraction lets the first link count as an old one.
            self._linked_ns = now_ns if self._seats else now_ns - self.lease_ns
        settled = now_ns - self._linked_ns >= self.lease_ns
        claims = []
        for stream, seat in self._seats.items():
            if seat.standing is Standing.CLAIMING and not seat.declared:
                seat.declared, seat.since_ns = True, now_ns
                claims.append(stream)
            if seat.standing is not Standing.STANDBY or stream in self._others:
                continue
            # Who was denied just now may not have been told yet of the token that it was denied for.
            waits = seat.denied and now_ns - seat.since_ns < self.settle_ns
            if not waits and (settled or seat.since_ns >= self._linked_ns):
                seat.standing, seat.since_ns, seat.declared = Standing.CLAIMING, now_ns, True
                claims.append(stream)
        return claims

    def decide(self, now_ns: int, tokens: Mapping[str, Iterable[str]], *, lapsed: bool = False) -> dict[str, Change]:
        """Decide on the streams whose tokens were looked up, after those of `claims` were declared.

        Args:
            now_ns: monotonic time.
            tokens: the instances that hold tokens, by stream; none for a stream without.
            lapsed: whether the tenure had lapsed before the tokens were looked up.
        """
        changes = {}
        for stream, holders in tokens.items():
            seat, others = self._seats.get(stream), set(holders) - {self.instance}
            change = None
            if seat is None:
                continue
            if seat.standing is Standing.CLAIMING:
                change = self._claimant(seat, others, now_ns)
            elif seat.standing is Standing.OWNER:
                change = self._owner(seat, others, now_ns, lapsed=lapsed)
            if change is not None:
                seat.standing = Standing.OWNER if change is Change.GRANTED else Standing.STANDBY
                seat.denied = change is not Change.GRANTED
                seat.since_ns, seat.rival_since_ns = now_ns, None
                changes[stream] = change
        return changes

    @property
    def contested(self) -> list[str]:
        """The streams that this instance claims, and those that it owns and another one too."""
        contested = {stream for stream, seat in self._seats.items() if seat.standing is Standing.CLAIMING}
        contested |= {stream for stream in self._others if self.standing(stream) is Standing.OWNER}
        return sorted(contested)

    def _claimant(self, seat: _Seat, others: set[str], now_ns: int) -> Change | None:
        if not others:
            return Change.GRANTED
        if min(others) < self.instance or now_ns - seat.since_ns >= self.settle_ns:
            return Change.DENIED
        return None

    def _owner(self, seat: _Seat, others: set[str], now_ns: int, *, lapsed: bool) -> Change | None:
        if not others:
            seat.rival_since_ns = None
            return None
        if lapsed:
            return Change.LOST
        if seat.rival_since_ns is None:
            seat.rival_since_ns = now_ns
        persists = now_ns - seat.rival_since_ns >= self.persist_ns
        return Change.LOST if persists and min(others) < self.instance else None
