"""Which tracks of the streams of an area are one object: pure, without clock, threads and I/O.

`take` accepts the messages of all streams as they come. The result depends on the messages alone, not on how they are
grouped. Decisions are made at common times, every 0.2 s of the area's time: once all streams have come so far, or the
furthest is `WAIT_NS` beyond. A global id is a hash of the area and of the first stream, session and object that had it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from optipmb_schemas import LinkedObject

from optipmb_service.links import components, gaps, views
from optipmb_service.links.gaps import EXAMPLE, PLACE, Learned
from optipmb_service.links.looks import FRESH_NS, WAIT_NS, LinkInputs
from optipmb_service.links.objects import APPEARANCE, OBJECT, Objects
from optipmb_service.links.places import WorldFrame
from optipmb_service.links.vectors import ObjectVectors
from optipmb_service.links.views import BIAS, GRID_NS, PAIR, Present

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from optipmb_schemas import Tracks

    from optipmb.model.rows import Index
    from optipmb_service.settings import LinkSettings

    Table = NDArray[np.void]

NS: Final = 1e-9
DECIDE_NS: Final = 600_000_000
"""Age at which it is decided whether an object was lost by another view before;"""
DECIDE_VECTORS_NS: Final = 2 * 10**9
"""the same where its vector is waited for."""
ACCELERATION: Final = 2.0
"""Of an object between its message and the common time, m/s^2."""
MISALIGNED: Final = np.array((0.5, 0.5, np.radians(1.0), 0.05))
"""Biases of place (m), angle (rad) and clock (s) above which streams are misaligned, where they are"""
LEAST_SIGMAS: Final = 3.0
"""times their standard deviation."""
HOW: Final = ("overlap", "passage", "appearance", "none")

VERSION: Final = 1
TABLES: Final = (OBJECT, PAIR, BIAS, EXAMPLE, PLACE)
"""Types of the tables of a state, by number; others are by name."""


def _packed(column: NDArray[Any] | None) -> tuple[int | str, tuple[int, ...], bytes] | None:
    if column is None:
        return None
    kind = TABLES.index(column.dtype) if column.dtype in TABLES else column.dtype.str
    return kind, column.shape, column.tobytes()


def _unpacked(packed: Any) -> Any:
    if packed is None:
        return None
    kind, shape, data = packed
    return np.frombuffer(data, TABLES[kind] if isinstance(kind, int) else kind).reshape(shape).copy()


class Linker:
    """The links of one area.

    Attributes:
        inputs: its streams.
        objects: of their sessions.
        pairs: `PAIR` of objects, ascending.
        biases: `BIAS` of streams, ascending.
        grid_ns: the next common time.

    Args:
        area: its name.
        settings: of the area.
        frame: returns the world frame of a stream.
    """

    def __init__(
        self, area: str, settings: LinkSettings, frame: Callable[[str], WorldFrame] = lambda _: WorldFrame()
    ) -> None:
        self.area, self.settings = area, settings
        self.inputs = LinkInputs(frame)
        self.objects = Objects(area)
        self.grid_ns = -1
        self.pairs: Table = np.zeros(0, PAIR)
        self.biases: Table = np.zeros(0, BIAS)
        self._learned = Learned.empty()
        self._vectors = ObjectVectors()
        self._part: Index = np.zeros(0, np.int64)  # of each object
        self._changes: list[LinkedObject] = []

    def take(self, message: Tracks, arrived_ns: int, vectors: NDArray[np.float32] | None = None) -> None:
        """Accept the tracks of a frame.

        Args:
            message: the tracks.
            arrived_ns: when they came, by the clock of the receiver; it only tells which clocks are wrong.
            vectors: (N, E) of appearance, NaN where unknown.
        """
        stream = self.inputs.accept(message, arrived_ns, self.grid_ns)
        if self.inputs.is_set_back:
            self._begin_again()
        if stream is None:
            return
        if message.session != stream.session:
            self.objects.begin(stream, message.session, message.stamp_ns)
        self.inputs.add(stream, message, vectors)
        first, until = self.inputs.until_ns()
        if self.grid_ns < 0 or until - self.grid_ns > 10 * WAIT_NS:
            first = max(first, until - 10 * WAIT_NS)
            self.grid_ns = max(self.grid_ns, -(-first // GRID_NS) * GRID_NS)
        while self.grid_ns <= until:
            self._decide_at(self.grid_ns)
            self.grid_ns += GRID_NS

    def state(self) -> bytes:
        """Return all that later links follow from, as `restored` reads it."""
        own, vectors = self.objects, self._vectors
        tables = [_packed(one) for one in (own.table, self.pairs, self.biases, *self._learned, vectors.counts)]
        sums = [(number, stamp, total.tobytes()) for number, (stamp, total) in vectors.sums.items()]
        rest = self.grid_ns, own.following, list(own.sessions.items()), dict(self.inputs.counters)
        return msgspec.msgpack.encode((VERSION, self.inputs.packed(_packed), tables, sums, rest))

    @classmethod
    def restored(cls, area: str, settings: LinkSettings, frame: Callable[[str], WorldFrame], state: bytes) -> Linker:
        """Return the linker of a state.

        Raises:
            ValueError: it is of another version, or none.
        """
        linker = cls(area, settings, frame)
        try:
            version, *rest = msgspec.msgpack.decode(state)
            if version != VERSION:
                raise TypeError(f"expected version {VERSION}, received {version}")  # noqa: TRY301 - one error for all
            streams, tables, sums, (linker.grid_ns, following, sessions, counters) = rest
            objects, linker.pairs, linker.biases, *learned, linker._vectors.counts = (_unpacked(one) for one in tables)
            linker._learned = Learned(*learned)
            linker.inputs.restore(streams, _unpacked)
            linker.inputs.counters.update(counters)
            linker.objects.restore(objects, sessions, following)
            linker._vectors.sums = {number: (stamp, np.frombuffer(one, np.float32)) for number, stamp, one in sums}
        except (ValueError, TypeError, IndexError) as error:  # msgspec raises the first, too
            raise ValueError(f"state of links: {error}") from error
        linker._settle()
        return linker

    def changes(self) -> list[LinkedObject]:
        """Return the rows that changed since the last call."""
        found, self._changes = self._changes, []
        return found

    def rows(self) -> list[LinkedObject]:
        """Return all objects that are linked."""
        size = np.bincount(self._part, minlength=1)[self._part]
        return [self._row(n) for n in np.flatnonzero(size > 1).tolist()]

    @property
    def linked(self) -> int:
        """How many objects are linked."""
        size = np.bincount(self._part, minlength=1)
        return int(size[size > 1].sum())

    def wrong(self) -> dict[tuple[str, str], str]:
        """Return the present problems, by stream and code, with streams whose frames or clocks differ by much.

        That common times began again is said once.
        """
        names = {one.number: one.name for one in self.inputs.streams.values()}
        found = dict(self.inputs.problems)
        self.inputs.say("", "set_back", "")
        for bias in self.biases[self.biases["pairs"] >= 1]:
            value, sigma = np.abs(bias["estimate"]), np.sqrt(np.diag(bias["covariance"]))
            far = (value > MISALIGNED) & (value > LEAST_SIGMAS * sigma)
            if far.any():
                x, y, turn, late = bias["estimate"].tolist()
                text = f"its tracks differ by {np.hypot(x, y):.2f} m, {np.degrees(turn):.1f} degrees"
                text += f" and {1e3 * late:.0f} ms from {names[int(bias['a'])]}"
                found[names[int(bias["b"])], "misaligned"] = text
        return found

    def _decide_at(self, stamp_ns: int) -> None:
        before = len(self.objects.table)
        now = self._present(stamp_ns)
        own = self.objects.table
        linked = self.pairs["linked"].copy(), views.keys_of(self.pairs)
        if now is not None:
            self.pairs, self.biases, whole = views.sample(self.pairs, self.biases, now, self._parts_of(now), stamp_ns)
            self.pairs = views.decide(self.pairs, now, self.settings.min_probability)
            text = "" if whole else "too many tracks at one place: only near pairs are looked at"
            self.inputs.say("", "crowded", text)
        ended = (own["ended"] == 0) & (own["last_ns"] <= stamp_ns - FRESH_NS)
        own["ended"][ended] = 1
        revived = (own["ended"] == 1) & (own["last_ns"] > stamp_ns - FRESH_NS)
        own["ended"][revived] = 0
        self._drop_pairs(stamp_ns)
        changed = before != len(own) or len(self._part) != len(own)
        opposed = changed or len(components.opposed(self.objects, self.pairs, self._part)) > 0
        if opposed or not self._same_links(*linked) or ended.any() or revived.any():
            self._settle()
        if self._continue(stamp_ns, np.flatnonzero(ended)):
            self._settle()
        self._forget(stamp_ns)

    def _parts_of(self, now: Present) -> Index:
        """Return the parts of tracks; one that is new is a part of its own."""
        part = np.arange(len(self.objects.table)) + len(self._part)
        part[: len(self._part)] = self._part
        return np.asarray(np.unique(part[self.objects.at(now.number)], return_inverse=True)[1])

    def _same_links(self, flags: NDArray[np.int8], keys: Index) -> bool:
        return np.array_equal(keys[flags > 0], views.keys_of(self.pairs)[self.pairs["linked"] > 0])

    def _present(self, stamp_ns: int) -> Present | None:
        """Return the tracks at a common time, and update their objects."""
        found: list[tuple[Any, ...]] = []
        for stream in self.inputs.streams.values():
            looks = stream.until(stamp_ns)
            for look in looks:
                ahead = stamp_ns - look.stamp_ns
                keep = np.flatnonzero(look.since_ns < FRESH_NS - ahead)
                for old, new in self.objects.continued(look, keep):
                    self._merge(old, new)
                numbers = self.objects.numbers(stream, look, keep)
                if look.stamp_ns > stream.used_ns:
                    seen, rows = self.objects.update(look, keep, numbers)
                    self._vectors.see(look, seen, rows, self.objects, self.pairs)
                    stream.used_ns = look.stamp_ns
            if not looks:
                continue
            seconds = ahead * NS
            place = look.place[keep] + seconds * look.velocity[keep]
            more = seconds**2 * look.variance[keep] + (0.5 * ACCELERATION * seconds**2) ** 2
            covariance = look.covariance[keep] + more[:, None] * (1.0, 0.0, 1.0)
            count = len(keep)
            columns = np.full(count, stream.number), look.kind[keep], np.full(count, stream.frame.plane)
            stamps = np.full(count, look.stamp_ns)
            found.append((numbers, *columns, stamps, place, look.velocity[keep], covariance))
        if not found:
            return None
        now = Present._make(np.concatenate(one) for one in zip(*found, strict=True))
        order = np.argsort(now.number, kind="stable")
        return Present._make(one[order] for one in now) if len(order) else None

    def _merge(self, old: int, new: int) -> None:
        """Give the links of a track that continues an object to that object."""
        for side in ("a", "b"):
            self.pairs[side][self.pairs[side] == old] = new
        _, first = np.unique(views.keys_of(self.pairs), return_index=True)
        self.pairs = self.pairs[first]
        own = self.objects.table
        gone = own["number"] == old
        told = np.flatnonzero(gone & (own["told"] > 0)).tolist()
        self._changes += [self._row(n).model_copy(update={"ended": True}) for n in told]
        self.objects.drop(gone)
        self._part = np.zeros(0, np.int64)

    def _drop_pairs(self, stamp_ns: int) -> None:
        """Forget pairs that say nothing any more, and withdraw links over a gap that was none."""
        pairs, own = self.pairs, self.objects
        old = (pairs["evidence"] < views.LEAST) | (pairs["stamp_ns"] < stamp_ns - 2 * FRESH_NS)
        # Evidence against two tracks of one part keeps them apart: it is forgotten only once they are gone.
        a, b = (own.at(pairs[side]) for side in ("a", "b"))
        part = components.connected(len(own.table), a[pairs["linked"] > 0], b[pairs["linked"] > 0])
        old &= (part[a] != part[b]) | (pairs["stamp_ns"] < stamp_ns - 2 * FRESH_NS)
        pairs = pairs[(pairs["linked"] > 0) | (~old & (pairs["how"] == 0))]
        apart = np.flatnonzero(pairs["how"] > 0)
        if len(apart):
            a, b = (own.at(pairs[side][apart]) for side in ("a", "b"))
            both = own.table["last_ns"][a] > own.table["first_ns"][b] + FRESH_NS
            self.inputs.counters["withdrawn"] += int(both.sum())
            pairs = np.delete(pairs, apart[both])
        self.pairs = pairs

    def _continue(self, stamp_ns: int, ended: Index) -> bool:
        """Link objects that began to lost ones; return whether there is a new link."""
        own, part = self.objects.table, self._part
        streams = {one.number: one for one in self.inputs.streams.values()}
        alive = np.bincount(part, own["ended"] == 0) > 0
        if len(ended):
            self._learned = self._learned.ended(self.objects.ends(ended[~alive[part[ended]]], streams, begin=False))
        decided = np.bincount(part, own["decided"]) > 0
        own["decided"] |= decided[part]
        _, oldest = np.unique(part, return_index=True)
        young = oldest[(own["decided"][oldest] == 0) & (own["ended"][oldest] == 0)]
        due = stamp_ns - own["first_ns"][young] >= (DECIDE_VECTORS_NS if self.settings.embedding_model else DECIDE_NS)
        if not due.any():
            return False
        lost = np.flatnonzero(~alive[part] & (own["last_ns"] > stamp_ns - round(self.settings.gap_s / NS)))
        lost = lost[np.lexsort((own["number"][lost], own["last_ns"][lost], part[lost]))]
        last = np.append(part[lost][1:] != part[lost][:-1], True)[: len(lost)]
        lost = lost[last]
        lost = np.sort(lost[np.argsort(-own["last_ns"][lost], kind="stable")[: gaps.MOST_SCORES // len(young)]])
        begun = self.objects.ends(young, streams, begin=True)
        ends = self.objects.ends(lost, streams, begin=False), begun, due
        names = {number: one.name for number, one in streams.items()}
        more = self._vectors.alike(own["number"][lost], own["number"][young], begun.kind)
        found = gaps.decide(self.settings, names, self._learned, ends, more, stamp_ns)
        partner, probability, needed, self._learned = found
        own["decided"][young[due]] = 1
        at = np.flatnonzero(partner >= 0)
        if len(at) == 0:
            return False
        pairs = np.zeros(len(at), PAIR)
        pairs["a"], pairs["b"] = own["number"][lost[partner[at]]], own["number"][young[at]]
        pairs["stamp_ns"], pairs["probability"], pairs["linked"] = stamp_ns, probability[at], 1
        pairs["how"] = np.where(needed[at] & (more[partner[at], at] != 0.0), APPEARANCE, 1)
        self.pairs = np.concatenate((self.pairs, pairs))
        self.pairs = self.pairs[np.argsort(views.keys_of(self.pairs), kind="stable")]
        return True

    def _begin_again(self) -> None:
        """End all objects, because the next common time is before the times of their tracks."""
        own = self.objects.table
        told = np.flatnonzero((own["told"] > 0) & (own["ended"] == 0)).tolist()
        self._changes += [self._row(n).model_copy(update={"ended": True}) for n in told]
        self.objects.drop(np.ones(len(own), np.bool_))
        self.pairs, self.biases, self._learned = self.pairs[:0], self.biases[:0], Learned.empty()
        self._vectors.sums.clear()
        self._part, self.grid_ns, self.inputs.is_set_back = np.zeros(0, np.int64), -1, False

    def _settle(self) -> None:
        self._part, new = components.settle(self.objects, self.pairs)
        self._changes += [self._row(n) for n in new.tolist()]

    def _forget(self, stamp_ns: int) -> None:
        """Drop parts that have ended long ago, and the oldest ended ones of too many objects."""
        own = self.objects.table
        if len(own) == 0:
            return
        newest = np.zeros(self._part.max() + 1, np.int64)
        np.maximum.at(newest, self._part, np.where(own["ended"] > 0, own["last_ns"], np.iinfo(np.int64).max))
        gone = newest[self._part] < stamp_ns - round(self.settings.gap_s / NS) - WAIT_NS
        text, most = "", self.settings.most
        if (surplus := len(own) - int(gone.sum()) - most) > 0:
            order = np.lexsort((own["number"], own["last_ns"], own["ended"] == 0, ~gone))
            gone[order[: int(gone.sum()) + surplus]] = True
            text = f"more than {most} objects: the oldest are forgotten"
        self.inputs.say("", "too_many_objects", text)
        if not gone.any():
            return
        numbers = own["number"][gone]
        for number in numbers.tolist():
            self._vectors.sums.pop(number, None)
        self.objects.drop(gone)
        self._part = np.unique(self._part[~gone], return_inverse=True)[1]
        self.pairs = self.pairs[~np.isin(self.pairs["a"], numbers) & ~np.isin(self.pairs["b"], numbers)]
        streams = self.inputs.streams.values()
        used = set(self.objects.table["session"].tolist()) | {one.session_number for one in streams}
        used |= {look.session for one in streams for look in one.looks}
        self.objects.sessions = {number: one for number, one in self.objects.sessions.items() if number in used}

    def _row(self, at: int) -> LinkedObject:
        row = self.objects.table[at]
        stream, session = self.objects.sessions[int(row["session"])]
        return LinkedObject.trusted(
            {
                "global_id": row["global"].tobytes(),
                "stream": stream,
                "session": session,
                "object": int(row["object"]),
                "probability": float(row["probability"]),
                "kind": HOW[int(row["how"])],
                "ended": bool(row["ended"]),
            }
        )
