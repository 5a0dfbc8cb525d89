"""Who tracks a stream, when several instances could: decisions only, no clock, no network, no threads.

Every owner holds a liveliness token `owner/<stream>/<instance>`, which others watch, and below it one that says claim.
Tokens vanish with their process, with its link, or when it has not been heard of for a lease. The rules, by which
exactly one instance keeps a stream:

- Who wants a stream that nobody owns declares its claim and then looks at all claims of the stream. Alone: it owns.
  Beside a lower name it withdraws. Beside higher names only it waits a moment: another claimant withdraws meanwhile,
  an owner does not, and then it withdraws itself.
- Two owners can meet after a network was cut. When both tokens persist, the lower name keeps.
- An owner writes only during its *write lease*, which is renewed every moment while it is linked and half as long as
the
  lease. A process that was frozen, or cut off, finds its write lease lapsed. It then looks first: where another holds a
  token it stands down, whatever the names are, for the other may have gone on; else it goes on itself.
- Who stands by claims as soon as the last token of the stream is gone. After a loss of its own link it waits for a
  lease: the owner may have lost its link too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from optipmb_service.cluster.port import Role, RoleChange

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@dataclass(slots=True)
class _Ownership:
    role: Role
    since_ns: int
    """When it was asked for, claimed, or decided on."""
    declared: bool = False
    denied: bool = False
    rival_since_ns: int | None = None


@dataclass
class OwnershipTable:
    """What one instance is to each stream. All times are monotonic, ns.

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
    _streams: dict[str, _Ownership] = field(default_factory=dict)
    _others: dict[str, set[str]] = field(default_factory=dict)
    _linked_ns: int | None = None

    def role(self, stream: str) -> Role:
        """Return what this instance is to a stream; may be called by any thread."""
        entry = self._streams.get(stream)
        return entry.role if entry else Role.NONE

    def owned(self) -> list[str]:
        """Return the streams whose owner this instance is."""
        return [stream for stream, entry in self._streams.items() if entry.role is Role.OWNER]

    def token_changed(self, stream: str, instance: str, *, present: bool) -> bool:
        """Note that a token came or went; True: it was one of this instance's own, and it is gone unasked."""
        if instance == self.instance:
            return not present and self.role(stream) is Role.OWNER
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
        return stream in self._others and self.role(stream) is not Role.OWNER

    def request(self, stream: str, now_ns: int) -> None:
        """Ask for a stream; what becomes of it is said by `decide`."""
        if stream not in self._streams:
            known = stream in self._others
            self._streams[stream] = _Ownership(Role.STANDBY if known else Role.CLAIMING, now_ns)

    def release(self, stream: str) -> None:
        """Give up a stream, or standing by for it."""
        self._streams.pop(stream, None)

    def claims(self, now_ns: int, *, linked: bool) -> list[str]:
        """Return the streams whose token is to be declared now, before `decide` is given all tokens."""
        if not linked:
            self._linked_ns = None
            return []
        if self._linked_ns is None:
            # At the start nothing was lost; the subtraction lets the first link count as an old one.
            self._linked_ns = now_ns if self._streams else now_ns - self.lease_ns
        settled = now_ns - self._linked_ns >= self.lease_ns
        claims = []
        for stream, entry in self._streams.items():
            if entry.role is Role.CLAIMING and not entry.declared:
                entry.declared, entry.since_ns = True, now_ns
                claims.append(stream)
            if entry.role is not Role.STANDBY or stream in self._others:
                continue
            # Who was denied just now may not have heard yet of the token that it was denied for.
            waits = entry.denied and now_ns - entry.since_ns < self.settle_ns
            if not waits and (settled or entry.since_ns >= self._linked_ns):
                entry.role, entry.since_ns, entry.declared = Role.CLAIMING, now_ns, True
                claims.append(stream)
        return claims

    def decide(
        self, now_ns: int, tokens: Mapping[str, Iterable[str]], *, lapsed: bool = False
    ) -> dict[str, RoleChange]:
        """Decide on the streams whose tokens were looked up, after those of `claims` were declared.

        Args:
            now_ns: monotonic time.
            tokens: the instances that hold tokens, by stream; none for a stream without.
            lapsed: whether the write lease had lapsed before the tokens were looked up.
        """
        changes = {}
        for stream, holders in tokens.items():
            entry, others = self._streams.get(stream), set(holders) - {self.instance}
            change = None
            if entry is None:
                continue
            if entry.role is Role.CLAIMING:
                change = self._claimant(entry, others, now_ns)
            elif entry.role is Role.OWNER:
                change = self._owner(entry, others, now_ns, lapsed=lapsed)
            if change is not None:
                entry.role = Role.OWNER if change is RoleChange.GRANTED else Role.STANDBY
                entry.denied = change is not RoleChange.GRANTED
                entry.since_ns, entry.rival_since_ns = now_ns, None
                changes[stream] = change
        return changes

    @property
    def contested(self) -> list[str]:
        """The streams that this instance claims, and those that it owns and another one too."""
        contested = {stream for stream, entry in self._streams.items() if entry.role is Role.CLAIMING}
        contested |= {stream for stream in self._others if self.role(stream) is Role.OWNER}
        return sorted(contested)

    def _claimant(self, entry: _Ownership, others: set[str], now_ns: int) -> RoleChange | None:
        if not others:
            return RoleChange.GRANTED
        if min(others) < self.instance or now_ns - entry.since_ns >= self.settle_ns:
            return RoleChange.DENIED
        return None

    def _owner(self, entry: _Ownership, others: set[str], now_ns: int, *, lapsed: bool) -> RoleChange | None:
        if not others:
            entry.rival_since_ns = None
            return None
        if lapsed:
            return RoleChange.LOST
        if entry.rival_since_ns is None:
            entry.rival_since_ns = now_ns
        persists = now_ns - entry.rival_since_ns >= self.persist_ns
        return RoleChange.LOST if persists and min(others) < self.instance else None
