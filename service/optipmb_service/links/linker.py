"""Which tracks of the streams of an area are one object: pure, without clock, threads and I/O.

`take` accepts the messages of all streams as they come. The result depends on the messages alone, not on how they are
grouped. Decisions are made at common times, every 0.2 s of the area's time: once all streams have come so far, or the
furthest is `WAIT_NS` beyond. Objects of a stream are numbered as they come. A global id is a hash of the area and of
the first stream, session and object that had it. Linked objects form parts, in which no two tracks of one session
exist at once; the oldest object of a part gives it its id.
"""

from __future__ import annotations

import collections
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from optipmb.joining.appearance import MOST_COUNTS, Vectors, appearance_score, bin_of, distance
from optipmb.model.lost_objects import DISTANCES
from optipmb_service.links import gaps, views
from optipmb_service.links.gaps import EXAMPLE, PLACE, End, Learned
from optipmb_service.links.rules import KINDS, Placement, kinds_of
from optipmb_service.links.views import BIAS, GRID_NS, PAIR, Present

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray
    from optipmb_schemas import Tracks

    from optipmb.model.rows import Array, Index
    from optipmb_service.links.rules import Rules

    Table = NDArray[np.void]
    Singles = NDArray[np.float32]

NS: Final = 1e-9
WAIT_NS: Final = 10**9
"""How far the furthest stream may be ahead of a common time before that is decided without the others."""
FRESH_NS: Final = 10**9
"""Age at which a track that is not detected, or a message, does not count any more."""
DECIDE_NS: Final = 600_000_000
"""Age at which it is decided whether an object was lost by another view before;"""
DECIDE_VECTORS_NS: Final = 2 * 10**9
"""the same where its vector is waited for."""
START_NS: Final = 2 * 10**9
"""Objects that are there within this time of the start of a session have not begun there."""
CLOCK_NS: Final = 2 * 10**9
"""Largest difference of a stream's clock from most other clocks."""
STUCK_NS: Final = 5 * 10**9
"""A stream whose stamps have been behind for so long has set its clock back."""
MOST_STREAMS: Final = 64
MOST_TRACKS: Final = 2000
"""Tracks of a message; of more the first count."""
MOST_LOOKS: Final = 64
"""Messages of a stream that wait for a common time."""
ACCELERATION: Final = 2.0
"""Of an object between its message and the common time, m/s^2."""
EXISTS: Final = 0.5
"""Least existence of a track where none says that it is confirmed."""
MISALIGNED: Final = np.array((0.5, 0.5, np.radians(1.0), 0.05))
"""Biases of place (m), angle (rad) and clock (s) above which streams are misaligned, where they are"""
LEAST_SIGMAS: Final = 3.0
"""times their standard deviation."""
OTHERS: Final = 8
"""Other objects from which the distance of a vector is counted."""
HOW: Final = ("overlap", "passage", "appearance", "none")
APPEARANCE: Final = 2
NONE: Final = 3

OBJECT: Final = np.dtype([
    ("number", "i8"), ("session", "i8"), ("stream", "i8"), ("object", "i8"), ("global", "u8", 2), ("shown", "u8", 2),
    ("first_ns", "i8"), ("last_ns", "i8"), ("begin", "f8", 2), ("end", "f8", 2), ("velocity", "f4", 2),
    ("variance", "f4"), ("size", "f4", 3), ("probability", "f4"), ("kind", "i1"), ("how", "i1"), ("decided", "i1"),
    ("known", "i1"), ("ended", "i1"), ("told", "i1"),
])  # fmt: skip
"""An object of a session: ends in the plane of the area; `known`: it began while it was looked for; `told`: bits of
kind of the last publication (1: any, 2: the end)."""


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


class Look(NamedTuple):
    """What counts of a message, in the plane of the area; small numbers, for it is part of the state."""

    stamp_ns: int
    session: int
    object: Index  # (N,)
    id: Index
    place: Array
    velocity: Singles
    covariance: Singles  # (N, 3)
    variance: Singles  # (N,) of the velocity
    size: Singles
    kind: NDArray[np.int8]
    age_ns: Index
    since_ns: Index
    vectors: NDArray[np.float32] | None


@dataclass
class Stream:
    """A stream of an area and its newest messages."""

    name: str
    number: int
    place: Placement
    session: str = ""
    session_number: int = -1
    begun_ns: int = 0
    """Stamp of the first message of the session."""
    newest_ns: int = -1
    accepted_ns: int = 0
    """Arrival of the newest accepted message."""
    offset_ns: int = 0
    """Arrival less stamp of the newest message."""
    looks: collections.deque[Look] = field(default_factory=collections.deque)
    used_ns: int = -1
    """Stamp of the newest message that counted."""

    def at(self, stamp_ns: int) -> Look | None:
        """Return the newest message until a time, and drop those before it."""
        while len(self.looks) > 1 and self.looks[1].stamp_ns <= stamp_ns:
            self.looks.popleft()
        if not self.looks or not stamp_ns - FRESH_NS < self.looks[0].stamp_ns <= stamp_ns:
            return None
        return self.looks[0]


class Row(NamedTuple):
    """State of one object of a session."""

    global_id: bytes
    stream: str
    session: str
    object: int
    probability: float
    kind: str
    ended: bool


class Linker:
    """The links of one area.

    Args:
        rules: of the area.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self.streams: dict[str, Stream] = {}
        self.sessions: dict[int, tuple[str, str]] = {}
        self.grid_ns = -1
        """The next common time."""
        self.following = 0
        """Number of the next object or session."""
        self.objects: Table = np.zeros(0, OBJECT)
        self.known: dict[tuple[int, int], int] = {}
        """Number of each session and object."""
        self.pairs: Table = np.zeros(0, PAIR)
        self.biases: Table = np.zeros(0, BIAS)
        self.learned = Learned.empty()
        self.vectors: dict[int, tuple[int, NDArray[np.float32]]] = {}
        """When the newest vector of an object came, and their sum."""
        self.counts = np.zeros((len(KINDS), 2, DISTANCES))
        self.counters: collections.Counter[str] = collections.Counter()
        self.problems: dict[tuple[str, str], str] = {}
        """Present problems, by stream and code."""
        self.part: Index = np.zeros(0, np.int64)
        """Part of each object."""
        self._changes: list[Row] = []

    def take(self, message: Tracks, arrived_ns: int, vectors: NDArray[np.float32] | None = None) -> None:
        """Accept the tracks of a frame.

        Args:
            message: the tracks.
            arrived_ns: when they came, by the clock of the receiver; it only tells which clocks are wrong.
            vectors: (N, E) of appearance, NaN where unknown.
        """
        stream = self.streams.get(message.stream)
        if stream is None:
            if len(self.streams) >= MOST_STREAMS:
                self._say(message.stream, "too_many_streams", f"at most {MOST_STREAMS} streams in an area")
                return
            stream = Stream(message.stream, len(self.streams), self.rules.place(message.stream))
            stream.offset_ns = arrived_ns - message.stamp_ns
            self.streams[message.stream] = stream
        offset = arrived_ns - message.stamp_ns
        slack = (arrived_ns - stream.accepted_ns) // 10
        stream.offset_ns = offset if stream.newest_ns < 0 else min(offset, stream.offset_ns + max(slack, 0))
        if self._is_off(stream, arrived_ns) or not self._is_next(stream, message, arrived_ns):
            return
        if message.session != stream.session:
            stream.session, stream.session_number, stream.begun_ns = message.session, self.following, message.stamp_ns
            self.sessions[self.following] = stream.name, message.session
            self.following += 1
        stream.newest_ns = max(stream.newest_ns, message.stamp_ns)
        stream.accepted_ns = arrived_ns
        at = len(stream.looks)
        while at and stream.looks[at - 1].stamp_ns > message.stamp_ns:
            at -= 1
        stream.looks.insert(at, self._look(stream, message, vectors))
        if len(stream.looks) > MOST_LOOKS:
            stream.looks.popleft()
            self.counters["shed"] += 1
        self._advance()

    def state(self) -> bytes:
        """Return all that later links follow from, as `restored` reads it."""
        streams = [
            (
                (one.name, one.number, one.session, one.session_number, one.begun_ns),
                (one.newest_ns, one.accepted_ns, one.offset_ns, one.used_ns),
                [(look.stamp_ns, look.session, [_packed(column) for column in look[2:]]) for look in one.looks],
            )
            for one in self.streams.values()
        ]
        tables = [_packed(one) for one in (self.objects, self.pairs, self.biases, *self.learned, self.counts)]
        vectors = [(number, stamp, total.tobytes()) for number, (stamp, total) in self.vectors.items()]
        rest = self.grid_ns, self.following, list(self.sessions.items()), dict(self.counters)
        return msgspec.msgpack.encode((VERSION, streams, tables, vectors, rest))

    @classmethod
    def restored(cls, rules: Rules, state: bytes) -> Linker:
        """Return the linker of a state.

        Raises:
            ValueError: it is of another version, or none.
        """
        linker = cls(rules)
        try:
            version, *parts = msgspec.msgpack.decode(state)
            if version != VERSION:
                raise TypeError(f"expected version {VERSION}, received {version}")  # noqa: TRY301 - one error for all
            streams, tables, vectors, rest = parts
            objects, pairs, biases, *learned, counts = (_unpacked(one) for one in tables)
            linker.objects, linker.pairs, linker.biases, linker.counts = objects, pairs, biases, counts
            linker.learned = Learned(*learned)
            for (name, *header), times, looks in streams:
                stream = Stream(name, header[0], rules.place(name), *header[1:])
                stream.newest_ns, stream.accepted_ns, stream.offset_ns, stream.used_ns = times
                stream.looks.extend(Look(one[0], one[1], *map(_unpacked, one[2])) for one in looks)
                linker.streams[name] = stream
            linker.vectors = {number: (stamp, np.frombuffer(one, np.float32)) for number, stamp, one in vectors}
            linker.grid_ns, linker.following, sessions, counters = rest
            linker.sessions = {number: (one[0], one[1]) for number, one in sessions}
            linker.counters.update(counters)
        except (ValueError, TypeError, IndexError) as error:  # msgspec raises the first, too
            raise ValueError(f"state of links: {error}") from error
        rows = zip(objects["session"].tolist(), objects["object"].tolist(), objects["number"].tolist(), strict=True)
        linker.known = {(session, one): number for session, one, number in rows}
        linker._settle()
        return linker

    def changes(self) -> list[Row]:
        """Return the rows that changed since the last call."""
        found, self._changes = self._changes, []
        return found

    def rows(self) -> list[Row]:
        """Return all objects that are linked."""
        size = np.bincount(self.part, minlength=1)[self.part]
        return [self._row(n) for n in np.flatnonzero(size > 1).tolist()]

    @property
    def linked(self) -> int:
        """How many objects are linked."""
        size = np.bincount(self.part, minlength=1)
        return int(size[size > 1].sum())

    def wrong(self) -> dict[tuple[str, str], str]:
        """Return the present problems, by stream and code, with streams whose frames or clocks differ by much."""
        names = {one.number: one.name for one in self.streams.values()}
        found = dict(self.problems)
        for bias in self.biases[self.biases["pairs"] >= 1]:
            value, sigma = np.abs(bias["estimate"]), np.sqrt(np.diag(bias["covariance"]))
            far = (value > MISALIGNED) & (value > LEAST_SIGMAS * sigma)
            if far.any():
                x, y, turn, late = bias["estimate"].tolist()
                text = f"its tracks differ by {np.hypot(x, y):.2f} m, {np.degrees(turn):.1f} degrees"
                text += f" and {1e3 * late:.0f} ms from {names[int(bias['a'])]}"
                found[names[int(bias["b"])], "misaligned"] = text
        return found

    def _say(self, stream: str, code: str, text: str) -> None:
        """Note that something is wrong with a stream; empty: not any more."""
        if text:
            self.counters[code] += 1
            if len(self.problems) < 2 * MOST_STREAMS or (stream, code) in self.problems:
                self.problems[stream, code] = text
        else:
            self.problems.pop((stream, code), None)

    def _is_off(self, stream: Stream, arrived_ns: int) -> bool:
        """Return whether the clock of a stream is far from most other clocks."""
        others = [
            one.offset_ns
            for one in self.streams.values()
            if one is stream or (one.newest_ns >= 0 and arrived_ns - one.accepted_ns < 10 * STUCK_NS)
        ]
        offsets = np.array(others)
        agree = (np.abs(offsets[:, None] - offsets) <= CLOCK_NS).sum(axis=1)
        reference = int(offsets[agree.argmax()])
        apart = reference - stream.offset_ns
        if abs(apart) <= CLOCK_NS:
            self._say(stream.name, "wrong_clock", "")
            return False
        self._say(stream.name, "wrong_clock", f"its stamps are {apart * NS:+.1f} s from other streams")
        return True

    def _is_next(self, stream: Stream, message: Tracks, arrived_ns: int) -> bool:
        """Return whether a message may still count."""
        stamp = message.stamp_ns
        late = stamp <= max(stream.used_ns, self.grid_ns - GRID_NS)
        late |= message.session != stream.session and stamp <= stream.newest_ns
        if late and stream.newest_ns >= 0 and arrived_ns - stream.accepted_ns > STUCK_NS:
            stream.looks.clear()
            stream.newest_ns = stream.used_ns = -1
            late = stamp <= self.grid_ns - GRID_NS
        if late or any(one.stamp_ns == stamp for one in stream.looks):
            self.counters["late" if late else "repeated"] += 1
            stream.newest_ns = max(stream.newest_ns, stamp)  # the next common time waits for this stream
            return False
        return True

    def _look(self, stream: Stream, message: Tracks, vectors: NDArray[np.float32] | None) -> Look:
        sure = message.existence >= EXISTS if message.confirmed is None else message.confirmed > 0
        joined = message.object if message.object is not None else message.id
        own = np.where(joined >= 0, joined, message.id)
        rows = np.flatnonzero(sure)
        if len(rows) > MOST_TRACKS:
            self._say(stream.name, "too_many_tracks", f"{len(rows)} tracks, of which the first {MOST_TRACKS} count")
            rows = rows[:MOST_TRACKS]
        rows = rows[np.sort(np.unique(own[rows], return_index=True)[1])]
        place, covariance = stream.place, message.covariance[rows]
        speed = np.hypot(*message.velocity[rows].T)
        cos, sin = np.cos(place.yaw), np.sin(place.yaw)
        xx, yy = (np.clip(covariance[:, k, k], 1e-4, 1e4) for k in (0, 1))
        xy = np.clip(covariance[:, 0, 1], -0.99 * np.sqrt(xx * yy), 0.99 * np.sqrt(xx * yy))
        turned = np.column_stack(
            (
                cos**2 * xx - 2.0 * cos * sin * xy + sin**2 * yy,
                cos * sin * (xx - yy) + (cos**2 - sin**2) * xy,
                sin**2 * xx + 2.0 * cos * sin * xy + cos**2 * yy,
            )
        )
        unsure = 0.5 * (covariance[:, 2, 2] + np.square(speed) * np.clip(covariance[:, 3, 3], 0.0, 10.0))
        return Look(
            message.stamp_ns,
            stream.session_number,
            own[rows],
            message.id[rows],
            place.turned(message.center[rows, :2]) + np.array((place.x, place.y)),
            place.turned(message.velocity[rows]).astype(np.float32),
            turned.astype(np.float32),
            np.clip(unsure, 1e-3, 1e4).astype(np.float32),
            np.log(message.size[rows]).astype(np.float32),
            kinds_of(message.labels)[message.label[rows]].astype(np.int8),
            (1e9 * np.minimum(message.age[rows], 1e6)).astype(np.int64),
            (1e9 * np.minimum(message.time_since_detection[rows], 1e6)).astype(np.int64),
            None if vectors is None else vectors[rows],
        )

    def _advance(self) -> None:
        """Decide at all common times that are due."""
        newest = [one.newest_ns for one in self.streams.values() if one.newest_ns >= 0]
        latest = max(newest)
        until = min(one for one in newest if one >= latest - WAIT_NS)
        first = min(one.looks[0].stamp_ns for one in self.streams.values() if one.looks)
        if self.grid_ns < 0 or until - self.grid_ns > 10 * WAIT_NS:
            first = max(first, until - 10 * WAIT_NS)
            self.grid_ns = max(self.grid_ns, -(-first // GRID_NS) * GRID_NS)
        while self.grid_ns <= until:
            self._decide_at(self.grid_ns)
            self.grid_ns += GRID_NS

    def _decide_at(self, stamp_ns: int) -> None:
        before = len(self.objects)
        now = self._present(stamp_ns)
        linked = self.pairs["linked"].copy(), views.keys_of(self.pairs)
        if now is not None:
            self.pairs, self.biases, whole = views.sample(self.pairs, self.biases, now, stamp_ns)
            self.pairs = views.decide(self.pairs, now, self.rules.min_probability)
            self._say("", "crowded", "" if whole else "too many tracks at one place: only near pairs are looked at")
        ended = (self.objects["ended"] == 0) & (self.objects["last_ns"] <= stamp_ns - FRESH_NS)
        self.objects["ended"][ended] = 1
        revived = (self.objects["ended"] == 1) & (self.objects["last_ns"] > stamp_ns - FRESH_NS)
        self.objects["ended"][revived] = 0
        self._drop_pairs(stamp_ns)
        changed = before != len(self.objects) or len(self.part) != len(self.objects)
        if changed or not self._same_links(*linked) or ended.any() or revived.any():
            self._settle()
        if self._continue(stamp_ns, np.flatnonzero(ended)):
            self._settle()
        self._forget(stamp_ns)

    def _same_links(self, flags: NDArray[np.int8], keys: Index) -> bool:
        return np.array_equal(keys[flags > 0], views.keys_of(self.pairs)[self.pairs["linked"] > 0])

    def _present(self, stamp_ns: int) -> Present | None:
        """Return the tracks at a common time, and update their objects."""
        parts: list[tuple[Any, ...]] = []
        for stream in self.streams.values():
            look = stream.at(stamp_ns)
            if look is None:
                continue
            ahead = stamp_ns - look.stamp_ns
            keep = np.flatnonzero(look.since_ns + ahead < FRESH_NS)
            numbers = self._numbers(stream, look, keep)
            if look.stamp_ns > stream.used_ns:
                self._update(look, keep, numbers)
                stream.used_ns = look.stamp_ns
            seconds = ahead * NS
            place = look.place[keep] + seconds * look.velocity[keep]
            more = seconds**2 * look.variance[keep] + (0.5 * ACCELERATION * seconds**2) ** 2
            covariance = look.covariance[keep] + more[:, None] * (1.0, 0.0, 1.0)
            count = len(keep)
            columns = np.full(count, stream.number), look.kind[keep], np.full(count, stream.place.plane)
            stamps = np.full(count, look.stamp_ns)
            parts.append((numbers, *columns, stamps, place, look.velocity[keep], covariance))
        if not parts:
            return None
        now = Present._make(np.concatenate(one) for one in zip(*parts, strict=True))
        order = np.argsort(now.number, kind="stable")
        return Present._make(one[order] for one in now) if len(order) else None

    def _numbers(self, stream: Stream, look: Look, keep: Index) -> Index:
        """Return the numbers of the objects of rows of a message; new ones begin."""
        found = np.empty(len(keep), np.int64)
        new: list[int] = []
        for at, (one, identity) in enumerate(zip(look.object[keep].tolist(), look.id[keep].tolist(), strict=True)):
            if one != identity and (look.session, identity) in self.known:
                self._rename(look.session, identity, one)
            number = self.known.get((look.session, one), -1)
            if number < 0:
                number = self.known[look.session, one] = self.following
                self.following += 1
                new.append(at)
            found[at] = number
        if new:
            rows = keep[new]
            more = np.zeros(len(new), OBJECT)
            more["number"], more["session"], more["stream"] = found[new], look.session, stream.number
            more["object"] = look.object[rows]
            more["first_ns"] = look.stamp_ns - np.where(look.age_ns[rows] < START_NS, look.age_ns[rows], 0)
            more["last_ns"] = look.stamp_ns - look.since_ns[rows]
            seconds = (look.stamp_ns - more["first_ns"]) * NS
            more["begin"] = look.place[rows] - seconds[:, None] * look.velocity[rows]
            more["end"], more["velocity"] = look.place[rows], look.velocity[rows]
            more["variance"], more["size"] = look.variance[rows], look.size[rows]
            more["known"] = more["first_ns"] > stream.begun_ns + START_NS
            more["kind"] = look.kind[rows]
            more["how"] = NONE
            more["global"] = [self._own_id(look.session, one) for one in more["object"].tolist()]
            self.objects = np.concatenate((self.objects, more))
        return found

    def _rename(self, session: int, identity: int, joined: int) -> None:
        """Note that a track continues an object of its session."""
        old = self.known.pop((session, identity))
        new = self.known.get((session, joined))
        if new is None:
            self.known[session, joined] = old
            self.objects["object"][np.searchsorted(self.objects["number"], old)] = joined
            return
        for side in ("a", "b"):
            self.pairs[side][self.pairs[side] == old] = new
        _, first = np.unique(views.keys_of(self.pairs), return_index=True)
        self.pairs = self.pairs[first]
        gone = self.objects["number"] == old
        self._changes += [
            self._row(n)._replace(ended=True) for n in np.flatnonzero(gone & (self.objects["told"] > 0)).tolist()
        ]
        self.objects, self.part = self.objects[~gone], np.zeros(0, np.int64)

    def _update(self, look: Look, keep: Index, numbers: Index) -> None:
        at = np.searchsorted(self.objects["number"], numbers)
        self.objects["last_ns"][at] = np.maximum(self.objects["last_ns"][at], look.stamp_ns - look.since_ns[keep])
        seen = look.since_ns[keep] == 0
        at, rows = at[seen], keep[seen]
        self.objects["end"][at], self.objects["velocity"][at] = look.place[rows], look.velocity[rows]
        self.objects["variance"][at], self.objects["size"][at] = look.variance[rows], look.size[rows]
        self.objects["kind"][at] = look.kind[rows]
        if look.vectors is not None:
            self._see(look, numbers[seen], rows)

    def _see(self, look: Look, numbers: Index, rows: Index) -> None:
        """Add vectors to objects, and count distances of vectors of one object and of different ones."""
        assert look.vectors is not None  # noqa: S101 - for the type checker
        fresh = [n for n, row in enumerate(rows.tolist()) if not np.isnan(look.vectors[row, 0])]
        vectors = {int(numbers[n]): look.vectors[rows[n]] for n in fresh}
        partners = self._partners()
        alive = self.objects["number"][self.objects["ended"] == 0]
        for number, vector in vectors.items():
            kind = int(self.objects["kind"][np.searchsorted(self.objects["number"], number)])
            linked = {number, *partners.get(number, ())}
            others = [one for one in alive.tolist() if one in self.vectors and one not in linked][-OTHERS:]
            self._count(kind, 0, vector, partners.get(number, ()))
            self._count(kind, 1, vector, others)
        for number, vector in vectors.items():
            total = vector / np.linalg.norm(vector)
            if (old := self.vectors.get(number)) is not None and len(old[1]) == len(vector):
                total = total + old[1] * np.float32(0.9)
            self.vectors[number] = look.stamp_ns, total.astype(np.float32)

    def _count(self, kind: int, which: int, vector: NDArray[np.float32], others: Iterable[int]) -> None:
        for other in others:
            known = self.vectors.get(other)
            if known is None or len(known[1]) != len(vector):
                continue
            d = distance(vector, known[1], 0.0)
            if not np.isnan(d):
                self.counts[kind, which, bin_of(d)] += 1.0
        if self.counts[kind, which].sum() >= MOST_COUNTS:
            self.counts[kind, which] *= 0.5

    def _partners(self) -> dict[int, list[int]]:
        # Within a track vectors are more alike than in two views, and a link by vectors says nothing new of them.
        linked = self.pairs[(self.pairs["linked"] > 0) & (self.pairs["how"] < APPEARANCE)]
        found: dict[int, list[int]] = {}
        for a, b in zip(linked["a"].tolist(), linked["b"].tolist(), strict=True):
            found.setdefault(a, []).append(b)
            found.setdefault(b, []).append(a)
        return found

    def _drop_pairs(self, stamp_ns: int) -> None:
        """Forget pairs that say nothing any more, and withdraw links over a gap that was none."""
        pairs = self.pairs
        old = (pairs["evidence"] < views.LEAST) | (pairs["stamp_ns"] < stamp_ns - 2 * FRESH_NS)
        pairs = pairs[(pairs["linked"] > 0) | (~old & (pairs["how"] == 0))]
        apart = np.flatnonzero(pairs["how"] > 0)
        if len(apart):
            a, b = (np.searchsorted(self.objects["number"], pairs[side][apart]) for side in ("a", "b"))
            both = self.objects["last_ns"][a] > self.objects["first_ns"][b] + FRESH_NS
            self.counters["withdrawn"] += int(both.sum())
            pairs = np.delete(pairs, apart[both])
        self.pairs = pairs

    def _ends(self, rows: Index, *, begin: bool) -> End:
        own = self.objects[rows]
        place = own["begin" if begin else "end"]
        local = np.empty_like(place)
        by_number = {one.number: one for one in self.streams.values()}
        for stream in np.unique(own["stream"]).tolist():
            where = by_number[stream].place
            at = own["stream"] == stream
            local[at] = where._replace(yaw=-where.yaw).turned(place[at] - (where.x, where.y))
        planes = {number: one.place.plane for number, one in by_number.items()}
        return End(
            own["number"],
            own["stream"],
            np.array([planes[one] for one in own["stream"].tolist()], np.int64),
            own["kind"].astype(np.int64),
            place,
            local,
            own["velocity"].astype(np.float64),
            own["variance"].astype(np.float64),
            own["size"].astype(np.float64),
            own["first_ns" if begin else "last_ns"],
            own["known"] > 0 if begin else np.ones(len(own), np.bool_),
        )

    def _continue(self, stamp_ns: int, ended: Index) -> bool:
        """Link objects that began to lost ones; return whether there is a new link."""
        own = self.objects
        alive = np.bincount(self.part, own["ended"] == 0) > 0
        if len(ended):
            self.learned = self.learned.ended(self._ends(ended[~alive[self.part[ended]]], begin=False))
        decided = np.bincount(self.part, own["decided"]) > 0
        own["decided"] |= decided[self.part]
        _, oldest = np.unique(self.part, return_index=True)
        young = oldest[(own["decided"][oldest] == 0) & (own["ended"][oldest] == 0)]
        age = stamp_ns - own["first_ns"][young]
        waits = DECIDE_VECTORS_NS if self.rules.embedding_model else DECIDE_NS
        due = age >= waits
        if not due.any():
            return False
        lost = np.flatnonzero(~alive[self.part] & (own["last_ns"] > stamp_ns - round(self.rules.gap_s / NS)))
        lost = lost[np.lexsort((own["number"][lost], own["last_ns"][lost], self.part[lost]))]
        last = np.append(self.part[lost][1:] != self.part[lost][:-1], True)[: len(lost)]
        lost = lost[last]
        lost = np.sort(lost[np.argsort(-own["last_ns"][lost], kind="stable")[: gaps.MOST_SCORES // len(young)]])
        ends = self._ends(lost, begin=False), self._ends(young, begin=True), due
        names = {one.number: one.name for one in self.streams.values()}
        more, used = self._alike(own["number"][lost], own["number"][young], ends[1].kind)
        decision = gaps.decide(self.rules, names, self.learned, ends, more, stamp_ns)
        self.learned = decision.learned
        own["decided"][young[due]] = 1
        at = np.flatnonzero(decision.partner >= 0)
        if len(at) == 0:
            return False
        pairs = np.zeros(len(at), PAIR)
        partner = decision.partner[at]
        pairs["a"], pairs["b"] = own["number"][lost[partner]], own["number"][young[at]]
        pairs["stamp_ns"], pairs["probability"], pairs["linked"] = stamp_ns, decision.probability[at], 1
        pairs["how"] = np.where(used[partner, at], APPEARANCE, 1)
        self.pairs = np.concatenate((self.pairs, pairs))
        self.pairs = self.pairs[np.argsort(views.keys_of(self.pairs), kind="stable")]
        return True

    def _alike(self, lost: Index, young: Index, kind: Index) -> tuple[Array, NDArray[np.bool_]]:
        """Return what vectors say of pairs (L, Y), and of which they say something."""
        more = np.zeros((len(lost), len(young)))
        for m, number in enumerate(young.tolist()):
            if (own := self.vectors.get(number)) is None:
                continue
            for n, other in enumerate(lost.tolist()):
                if (old := self.vectors.get(other)) is not None and len(old[1]) == len(own[1]):
                    both = Vectors(np.array([number]), own[1][None], np.array([other]), old[1][None], self.counts)
                    more[n, m] = appearance_score(both, other, number, int(kind[m]))
        return more, more != 0.0

    def _settle(self) -> None:
        """Find the linked parts, and give each its global id."""
        own, pairs = self.objects, self.pairs
        linked = np.flatnonzero(pairs["linked"] > 0)
        a, b = (np.searchsorted(own["number"], pairs[side][linked]) for side in ("a", "b"))
        for _ in range(2):
            graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(own), len(own)))
            _, part = connected_components(graph, directed=False)
            order = np.lexsort((own["first_ns"], own["session"], part))
            one, following = order[:-1], order[1:]
            clash = (part[one] == part[following]) & (own["session"][one] == own["session"][following])
            clash &= own["first_ns"][following] < own["last_ns"][one]
            if not clash.any():
                break
            parts = np.unique(part[one[clash]])
            inside = np.isin(part[a], parts)
            stays = ~inside
            stays[inside] = self._compatible(linked[inside], a[inside], b[inside])
            pairs["linked"][linked[~stays]] = 0
            linked, a, b = linked[stays], a[stays], b[stays]
        _, oldest, self.part = np.unique(part, return_index=True, return_inverse=True)
        claim = own["global"][oldest]
        order = np.lexsort((oldest, claim[:, 0], claim[:, 1]))
        again = np.zeros(len(oldest), np.bool_)
        again[order[1:]] = (claim[order[1:]] == claim[order[:-1]]).all(axis=1)
        for n in np.flatnonzero(again).tolist():
            claim[n] = self._own_id(int(own["session"][oldest[n]]), int(own["object"][oldest[n]]))
        own["global"] = claim[self.part]
        order = np.argsort(pairs["probability"][linked], kind="stable")
        own["how"], own["probability"] = NONE, 1.0
        for side in (a, b):
            own["how"][side[order]] = pairs["how"][linked[order]]
            own["probability"][side[order]] = pairs["probability"][linked[order]]
        size = np.bincount(self.part)[self.part]
        state = 1 + 2 * own["ended"]
        told = (size > 1) | (own["told"] > 0)
        new = np.flatnonzero(told & ((own["told"] != state) | (own["global"] != own["shown"]).any(axis=1)))
        own["shown"][new], own["told"][new] = own["global"][new], state[new]
        self._changes += [self._row(n) for n in new.tolist()]

    def _compatible(self, links: Index, a: Index, b: Index) -> NDArray[np.bool_]:
        """Return which links of parts with a clash stay: no two tracks of a session at once; the oldest links first."""
        own, pairs = self.objects, self.pairs
        stays = np.zeros(len(links), np.bool_)
        members: dict[int, list[int]] = {}
        where: dict[int, int] = {}
        for n in np.lexsort((-pairs["probability"][links], own["first_ns"][a] + own["first_ns"][b])).tolist():
            one, other = (where.setdefault(int(row), int(row)) for row in (a[n], b[n]))
            left, right = members.setdefault(one, [one]), members.setdefault(other, [other])
            if one != other:
                if any(self._at_once(x, y) for x in left for y in right):
                    continue
                left += right
                for row in right:
                    where[row] = one
            stays[n] = True
        return stays

    def _at_once(self, one: int, other: int) -> bool:
        x, y = self.objects[one], self.objects[other]
        return bool(
            x["session"] == y["session"] and max(x["first_ns"], y["first_ns"]) < min(x["last_ns"], y["last_ns"])
        )

    def _own_id(self, session: int, identity: int) -> NDArray[np.uint64]:
        own = f"{self.rules.name} {' '.join(self.sessions[session])} {identity}".encode()
        return np.frombuffer(blake2b(own, digest_size=16).digest(), np.uint64)

    def _forget(self, stamp_ns: int) -> None:
        """Drop parts that have ended long ago, and the oldest ended ones of too many objects."""
        own = self.objects
        if len(own) == 0:
            return
        newest = np.zeros(self.part.max() + 1, np.int64)
        np.maximum.at(newest, self.part, np.where(own["ended"] > 0, own["last_ns"], np.iinfo(np.int64).max))
        gone = newest[self.part] < stamp_ns - round(self.rules.gap_s / NS) - WAIT_NS
        if (surplus := len(own) - int(gone.sum()) - self.rules.most) > 0:
            order = np.lexsort((own["number"], own["last_ns"], own["ended"] == 0, ~gone))
            gone[order[: int(gone.sum()) + surplus]] = True
            self._say("", "too_many_objects", f"more than {self.rules.most} objects: the oldest are forgotten")
        else:
            self._say("", "too_many_objects", "")
        if not gone.any():
            return
        numbers = own["number"][gone]
        for row in own[gone]:
            self.known.pop((int(row["session"]), int(row["object"])), None)
            self.vectors.pop(int(row["number"]), None)
        self.objects, self.part = own[~gone], np.unique(self.part[~gone], return_inverse=True)[1]
        self.pairs = self.pairs[~np.isin(self.pairs["a"], numbers) & ~np.isin(self.pairs["b"], numbers)]
        used = set(self.objects["session"].tolist()) | {one.session_number for one in self.streams.values()}
        used |= {look.session for one in self.streams.values() for look in one.looks}
        self.sessions = {number: one for number, one in self.sessions.items() if number in used}

    def _row(self, at: int) -> Row:
        row = self.objects[at]
        stream, session = self.sessions[int(row["session"])]
        how, ended = HOW[int(row["how"])], bool(row["ended"])
        return Row(row["global"].tobytes(), stream, session, int(row["object"]), float(row["probability"]), how, ended)
