"""Zones, lines and counts: when tracked objects enter and leave areas, stay there, and cross lines.

    zones = (Zone("crossing", polygon=[(0, 0), (20, 0), (20, 12), (0, 12)]), Zone("gate", line=[(0, -5), (0, 5)]))
    state = ZoneState()
    state, events = observe(zones, state, stamp_ns, tracks, labels)

`observe` is pure, as the step of the tracker is. Only frames in which a track was detected move it. Events of a track
come when it is confirmed. Where tracks are joined over gaps (`optipmb.joining.decision`), they come when its object is
decided. Then a track goes on with the visits of the object's track before, as if that had been detected again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping  # noqa: TC003 - checkpoints read the records by their annotations
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.errors import ParameterError
from optipmb.model.polygons import crosses_itself, inside

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from numpy.typing import NDArray

    from optipmb.model.relocation import Relocation
    from optipmb.model.rows import Array, Index
    from optipmb.model.tracks import Tracks

Point = tuple[float, float]
Place = tuple[float, float, float]
Moment = tuple[int, Place]
"""A time, -1 where unknown, and a place."""
Kind = Literal["entered", "left", "stayed", "crossed"]
How = Literal["crossed", "appeared", "lost", "ended", ""]

MOST: Final = 256
"""Zones and lines of a session."""
COUNTS: Final = ("inside", "entered", "left", "appeared", "lost", "to_left", "to_right", "distinct")
_SECOND: Final = 1_000_000_000
_OUTSIDE, _NEAR, _INSIDE = 0, 1, 2


@dataclass(frozen=True)
class Zone:
    """A polygon or a line in the world frame.

    Args:
        name: in events.
        polygon: 3 to 1000 corners, m; closed by itself, without crossing itself.
        line: 2 to 100 points, m.
        z: heights, m, between which centres are inside.
        classes: the classes that count; empty: all.
        margin: m; an object leaves farther outside than this, and is at a line nearer than this.
        min_s: visits that are shorter give no event.
        lost_s: an object that was not detected for longer has left.
        dwell_s: times inside after which there is an event.

    Raises:
        ParameterError: neither a polygon nor a line, or both, or one that is none.
    """

    name: str
    polygon: tuple[Point, ...] = ()
    line: tuple[Point, ...] = ()
    z: tuple[float, float] = (-math.inf, math.inf)
    classes: tuple[str, ...] = ()
    margin: float = 0.3
    min_s: float = 0.5
    lost_s: float = 2.0
    dwell_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if bool(self.polygon) is bool(self.line):
            raise ParameterError(self.name, "a polygon or a line", "both" if self.line else "neither")
        least, most = (3, 1000) if self.polygon else (2, 100)
        if not least <= len(self.polygon or self.line) <= most:
            raise ParameterError(self.name, f"{least} to {most} points", str(len(self.polygon or self.line)))
        if self.polygon and crosses_itself(self.polygon):
            raise ParameterError(f"{self.name}.polygon", "edges that do not cross", "others")

    @cached_property
    def digest(self) -> str:
        """All that its events follow from."""
        return repr(self)


class Event(NamedTuple):
    """What happened; `n` counts the events of a zone and kind from 1."""

    zone: str
    kind: Kind
    n: int
    id: int
    label: str
    at_ns: int
    position: Place
    speed: float
    yaw: float
    how: How = ""
    dwell_s: float = 0.0
    direction: Literal["left", "right", ""] = ""
    object: int | None = None
    """id of the first track of the object; set when the event is sent"""


class Visit(NamedTuple):
    """An object in a zone."""

    label: str
    since_ns: int
    last_ns: int
    """last time inside: of the last detection there, or of the border that it passed since"""
    place: Place
    """where it was then"""
    entered: Event | None
    """not yet sent: it is too short"""
    stays: int = 0
    """times of `dwell_s` that have passed"""


class Seen(NamedTuple):
    """A track at its last detection."""

    stamp_ns: int
    place: Place
    known: int
    """bits of the zones that know where it was; not: it appears there"""
    visits: Mapping[str, Visit]
    near: Mapping[str, Moment]
    """lines that it is near: where it was before it came near"""
    confirmed: bool = False
    held: tuple[Event, ...] = ()
    entered: tuple[str, ...] = ()
    """zones that its object is counted in"""


@dataclass(frozen=True)
class ZoneState:
    """State of all zones after a frame."""

    tracks: Mapping[int, Seen] = field(default_factory=dict)
    counts: Mapping[str, Mapping[str, Mapping[str, int]]] = field(default_factory=dict)
    """by zone, name of `COUNTS` and class"""
    numbers: Mapping[str, int] = field(default_factory=dict)
    """events so far, by `zone/kind`"""
    zones: tuple[str, ...] = ()
    """the zones that it is of, as `Zone.digest`"""
    session: str = ""
    """in which the ids of its tracks are unique"""
    objects: Mapping[int, int] = field(default_factory=dict)
    """object of each track, where it is decided and tracks are joined"""


class Shapes(NamedTuple):
    """Zones as arrays."""

    corners: Array  # (K, 2)
    first: Index  # (Z + 1,)
    closed: NDArray[np.bool_]  # (Z,)
    height: Array  # (Z, 2)
    margin: Array  # (Z,)

    @classmethod
    def of(cls, zones: Sequence[Zone]) -> Shapes:
        """Return the arrays of zones."""
        points = [one.polygon or one.line for one in zones]
        return cls(
            np.array([xy for part in points for xy in part], np.float64).reshape(-1, 2),
            np.cumsum([0, *map(len, points)]).astype(np.int64),
            np.array([bool(one.polygon) for one in zones], np.bool_),
            np.array([one.z for one in zones], np.float64).reshape(-1, 2),
            np.array([one.margin for one in zones], np.float64),
        )


@kernel
def locate(
    center: Array, before: Array, corners: Array, first: Index, closed: NDArray[np.bool_], height: Array, margin: Array
) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Return where centres (N, 3) are, and how often they crossed lines since `before` (N, 2), NaN where unknown.

    Returns:
        (N, Z) 2 inside a zone, 1 outside but within its margin, or a line's, 0 elsewhere; (N, Z) crossings
        of a line to the left less those to the right.
    """
    where = np.zeros((len(center), len(closed)), np.int8)
    net = np.zeros((len(center), len(closed)), np.int8)
    for k in range(len(closed)):
        begin, end = first[k], first[k + 1]
        shape = corners[begin:end]
        left, right = shape[:, 0].min() - margin[k], shape[:, 0].max() + margin[k]
        low, high = shape[:, 1].min() - margin[k], shape[:, 1].max() + margin[k]
        for i in range(len(center)):
            x, y, z = center[i]
            p, q = before[i]
            if not closed[k] and not (
                max(x, p) < left or min(x, p) > right or max(y, q) < low or min(y, q) > high or math.isnan(p)
            ):
                net[i, k] = crossings(shape, p, q, x, y)[0]
            if x < left or x > right or y < low or y > high:
                continue
            within, nearest = closed[k] and inside(shape, x, y), np.inf
            for j in range(len(shape) if closed[k] else len(shape) - 1):
                x1, y1 = shape[j]
                x2, y2 = shape[(j + 1) % len(shape)]
                dx, dy = x2 - x1, y2 - y1
                long = dx * dx + dy * dy
                share = min(1.0, max(0.0, ((x - x1) * dx + (y - y1) * dy) / long)) if long > 0.0 else 0.0
                nearest = min(nearest, math.hypot(x1 + share * dx - x, y1 + share * dy - y))
            beyond = max(height[k, 0] - z, z - height[k, 1], 0.0)
            if not closed[k]:
                where[i, k] = 1 if nearest < margin[k] else 0
            elif within and beyond == 0.0:
                where[i, k] = 2
            elif max(0.0 if within else nearest, beyond) <= margin[k]:
                where[i, k] = 1
    return where, net


@kernel
def crossings(line: Array, ax: float, ay: float, bx: float, by: float) -> tuple[int, float]:
    """Return how often a move from a to b crosses a line to its left, less how often to its right, and the last place.

    That is a share of the move, -1 without any. A point of the line on the path counts as left of the path, in all
    pieces that it belongs to. So a line and its parts, and a line and its reverse, are crossed equally.
    """
    net, share = 0, -1.0
    for j in range(len(line) - 1):
        x1, y1 = line[j]
        x2, y2 = line[j + 1]
        first = (bx - ax) * (y1 - ay) - (by - ay) * (x1 - ax) >= 0.0
        last = (bx - ax) * (y2 - ay) - (by - ay) * (x2 - ax) >= 0.0
        a = (x2 - x1) * (ay - y1) - (y2 - y1) * (ax - x1)
        b = (x2 - x1) * (by - y1) - (y2 - y1) * (bx - x1)
        if first != last and (a > 0.0) != (b > 0.0):
            net += 1 if first else -1
            share = max(share, a / (a - b))
    return net, share


def observe(
    zones: Sequence[Zone],
    state: ZoneState,
    stamp_ns: int,
    tracks: Tracks,
    labels: Sequence[str],
    shapes: Shapes | None = None,
    joined: tuple[Index, float] | None = None,
) -> tuple[ZoneState, tuple[Event, ...]]:
    """Return the state after a frame, and its events ordered by time, zone and id.

    Args:
        zones: the zones and lines, by name.
        state: after the frame before.
        stamp_ns: of the frame.
        tracks: of the frame.
        labels: the classes.
        shapes: the zones as arrays, where they are at hand.
        joined: (N,) id of the first track of the object of each track, -1 while that is not decided, and the longest
            gap of a join, s; None: tracks are not joined.
    """
    known, numbers = dict(state.tracks), dict(state.objects)
    objects, gap_s = joined or (None, 0.0)
    if objects is not None:
        _rejoined(zones, known, numbers, stamp_ns, dict(zip(tracks.id.tolist(), objects.tolist(), strict=True)))
    events: list[Event] = []
    rows = np.flatnonzero(tracks.detection >= 0)
    identities = tracks.id.tolist()
    nowhere = (math.nan, math.nan)
    seen_before = [known.get(identities[row]) for row in rows.tolist()]
    before = np.array([one.place[:2] if one else nowhere for one in seen_before]).reshape(-1, 2)
    center = np.ascontiguousarray(tracks.center[rows])
    where, net = locate(center, before, *(shapes or Shapes.of(zones)))
    marked = ((where != 0) | (net != 0)).any(axis=1).tolist()
    everywhere = (1 << len(zones)) - 1
    velocity, yaws, label = tracks.velocity, tracks.yaw, tracks.label
    for at, (row, (x, y, z), old) in enumerate(zip(rows.tolist(), center.tolist(), seen_before, strict=True)):
        identity = identities[row]
        seen = Seen(stamp_ns, (x, y, z), everywhere, {}, {}, *(old[5:] if old else ()))
        if marked[at] or (old and (old.visits or old.near)):
            speed, yaw = math.hypot(*velocity[row].tolist()), float(yaws[row])
            now = Event("", "entered", 0, identity, labels[label[row]], stamp_ns, (x, y, z), speed, yaw)
            seen, more = _moved(zones, old, seen, now, where[at].tolist(), net[at].tolist())
            if seen.confirmed:  # once is enough
                events += more
            else:
                seen = seen._replace(held=(*seen.held, *more))
        known[identity] = seen
    for row in np.flatnonzero(tracks.confirmed if objects is None else objects >= 0).tolist():
        seen_now = known.get(identities[row])
        if seen_now is not None and not seen_now.confirmed:
            events += seen_now.held
            known[identities[row]] = seen_now._replace(confirmed=True, held=())
    first = set()
    for one in events:
        if one.kind == "entered" and one.zone not in (seen_now := known[one.id]).entered:
            known[one.id] = seen_now._replace(entered=(*seen_now.entered, one.zone))
            first.add((one.zone, one.id, one.at_ns))
    times = [_ns(one.lost_s) for one in zones if one.polygon] or [_ns(Zone.lost_s)]
    soonest_ns, longest_ns = min(times), max(times)
    here = set(identities)
    for identity in tuple(known):
        silent_ns = stamp_ns - known[identity].stamp_ns
        if silent_ns <= soonest_ns:
            continue
        seen, more = _lost(zones, identity, known[identity], silent_ns, "lost")
        events += more
        known[identity] = seen
        if silent_ns > max(longest_ns, _ns(gap_s)) and identity not in here:
            del known[identity]
    events = [one._replace(object=numbers.get(one.id)) for one in events] if numbers else events
    kept = {identity: number for identity, number in numbers.items() if identity in known}
    return _counted(replace(state, tracks=known, objects=kept), events, first)


def _rejoined(
    zones: Sequence[Zone], known: dict[int, Seen], numbers: dict[int, int], stamp_ns: int, objects: Mapping[int, int]
) -> None:
    """Let tracks whose objects are decided now continue their visits; long gaps cross no line.

    Args:
        zones: the zones and lines.
        known: the tracks.
        numbers: the objects that are decided.
        stamp_ns: of the frame.
        objects: of the tracks of the frame.
    """
    before = {number: identity for identity, number in numbers.items()}
    lasts_ns = max(_ns(one.lost_s) for one in zones)
    for identity, number in objects.items():
        if number < 0 or identity in numbers:
            continue
        numbers[identity] = number
        last = before.get(number)
        if last is None or (seen := known.pop(last, None)) is None:
            continue
        del numbers[last]
        silent_ns = stamp_ns - seen.stamp_ns
        if silent_ns > lasts_ns and identity in known:
            known[identity] = known[identity]._replace(entered=seen.entered)
            continue
        far = {one.name: (-1, seen.place) for one in zones if one.line and silent_ns > _ns(one.lost_s)}
        known[identity] = seen._replace(near={**seen.near, **far})


def adapted(zones: Sequence[Zone], state: ZoneState) -> ZoneState:
    """Return the state for these zones: new and changed ones start empty, except for their numbers."""
    digests = tuple(one.digest for one in zones)
    if digests == state.zones:
        return state
    old = {digest: 1 << place for place, digest in enumerate(state.zones)}
    kept = {one.name for one in zones if one.digest in old}
    tracks = {
        identity: seen._replace(
            known=sum(1 << place for place, one in enumerate(digests) if seen.known & old.get(one, 0)),
            visits={name: one for name, one in seen.visits.items() if name in kept},
            near={name: one for name, one in seen.near.items() if name in kept},
            held=tuple(one for one in seen.held if one.zone in kept),
            entered=tuple(name for name in seen.entered if name in kept),
        )
        for identity, seen in state.tracks.items()
    }
    counts = {name: one for name, one in state.counts.items() if name in kept}
    return replace(state, tracks=tracks, counts=counts, zones=digests)


def relocated(state: ZoneState, relocation: Relocation) -> ZoneState:
    """Return the state in a world that has moved, in which zones stay where they are: no move crosses a border by it.

    An object that is inside a zone then, and was not before, has appeared there.
    """

    def event(one: Event) -> Event:
        return one._replace(position=relocation.place(one.position), yaw=one.yaw + relocation.theta)

    def visit(one: Visit) -> Visit:
        entered = None if one.entered is None else event(one.entered)
        return one._replace(place=relocation.place(one.place), entered=entered)

    tracks = {
        identity: seen._replace(
            place=relocation.place(seen.place),
            known=0,
            visits={name: visit(one) for name, one in seen.visits.items()},
            near={name: (at_ns, relocation.place(place)) for name, (at_ns, place) in seen.near.items()},
            held=tuple(event(one) for one in seen.held),
        )
        for identity, seen in state.tracks.items()
    }
    return replace(state, tracks=tracks)


def end(zones: Sequence[Zone], state: ZoneState) -> tuple[ZoneState, tuple[Event, ...]]:
    """Return the state after a session ends, whose ids mean nothing to the next one, and its last events."""
    events = [event for identity, one in state.tracks.items() for event in _lost(zones, identity, one, 0, "ended")[1]]
    events = [one._replace(object=state.objects.get(one.id)) for one in events]
    return _counted(replace(state, tracks={}, objects={}), events)


def _moved(
    zones: Sequence[Zone], old: Seen | None, seen: Seen, now: Event, where: list[int], net: list[int]
) -> tuple[Seen, list[Event]]:
    """Return a track after a detection, and its events."""
    events: list[Event] = []
    visits, near = (dict(old.visits), dict(old.near)) if old else ({}, {})
    known, last = seen.known, (old.stamp_ns, old.place) if old else (-1, now.position)
    for k, zone in enumerate(zones):
        if not (where[k] or net[k] or zone.name in visits or zone.name in near):
            continue
        counts, bit = not zone.classes or now.label in zone.classes, 1 << k
        if zone.line:
            began = near.pop(zone.name, None)
            if where[k]:
                near[zone.name] = began or last
                continue
            if (net[k] or began) and counts and (began or last)[0] >= 0:
                crossed, at_ns, place = _crossing(zone.line, began or last, now)
                event = now._replace(zone=zone.name, kind="crossed", at_ns=at_ns, position=place)
                events += [event._replace(direction="left" if crossed > 0 else "right")] if crossed else []
            continue
        ring = (*zone.polygon, zone.polygon[0])
        visit = visits.get(zone.name)
        if where[k] == _INSIDE and (visit or counts):
            if visit is None:
                comes = old is not None and old.known & bit
                _, at_ns, place = _crossing(ring, last, now) if comes else (0, now.at_ns, now.position)
                entry = now._replace(
                    zone=zone.name, at_ns=at_ns, position=place, how="crossed" if comes else "appeared"
                )
                visit = Visit(now.label, at_ns, now.at_ns, now.position, entry)
            visit = visit._replace(last_ns=now.at_ns, place=now.position)
        elif visit is not None and (visit.last_ns, visit.place) == last:
            _, at_ns, place = _crossing(ring, last, now)
            visit = visit._replace(last_ns=at_ns, place=place)
        if visit is None:
            known &= ~bit if where[k] == _INSIDE else -1
            continue
        stayed_ns = visit.last_ns - visit.since_ns
        if visit.entered is not None and stayed_ns >= _ns(zone.min_s):
            events.append(visit.entered)
            visit = visit._replace(entered=None)
        for dwell_s in () if visit.entered else zone.dwell_s[visit.stays :]:
            if stayed_ns >= _ns(dwell_s):
                event = now._replace(zone=zone.name, kind="stayed", label=visit.label, dwell_s=dwell_s)
                events.append(event._replace(at_ns=visit.since_ns + _ns(dwell_s)))
                visit = visit._replace(stays=visit.stays + 1)
        visits[zone.name] = visit
        if where[k] == _OUTSIDE:
            del visits[zone.name]
            events += _left(zone, visit, now, "crossed")
    return seen._replace(visits=visits, near=near, known=known), events


def _lost(
    zones: Sequence[Zone], identity: int, seen: Seen, silent_ns: int, how: Literal["lost", "ended"]
) -> tuple[Seen, list[Event]]:
    """Return a track that is not detected, and the events of the zones that it has left by that."""
    events: list[Event] = []
    visits, known = dict(seen.visits), seen.known
    for k, zone in enumerate(zones):
        if how == "lost" and (zone.line or silent_ns <= _ns(zone.lost_s)):
            continue
        known &= ~(1 << k)
        if (visit := visits.pop(zone.name, None)) is not None:
            now = Event(zone.name, "left", 0, identity, visit.label, visit.last_ns, visit.place, 0.0, 0.0)
            events += _left(zone, visit, now, how)
    seen = seen._replace(visits=visits, known=known)
    return (seen, events) if seen.confirmed else (seen._replace(held=(*seen.held, *events)), [])


def _left(zone: Zone, visit: Visit, now: Event, how: How) -> list[Event]:
    if visit.entered is not None:
        return []
    dwell_s = (visit.last_ns - visit.since_ns) / _SECOND
    event = now._replace(zone=zone.name, kind="left", label=visit.label, how=how)
    return [event._replace(at_ns=visit.last_ns, position=visit.place, dwell_s=dwell_s)]


def _counted(
    state: ZoneState, events: Iterable[Event], first: Collection[tuple[str, int, int]] = ()
) -> tuple[ZoneState, tuple[Event, ...]]:
    """Return the state with events counted, and these with their numbers.

    Args:
        state: of the zones.
        events: of the frame.
        first: zone, id and time of the events by which objects enter a zone for the first time.
    """
    ordered = sorted(events, key=lambda one: (one.at_ns, one.zone, one.id, one.kind))
    if not ordered:
        return state, ()
    numbers = dict(state.numbers)
    counts = {zone: {name: dict(by_class) for name, by_class in one.items()} for zone, one in state.counts.items()}
    for place, one in enumerate(ordered):
        key = f"{one.zone}/{one.kind}"
        numbers[key] = numbers.get(key, 0) + 1
        ordered[place] = one._replace(n=numbers[key])
        steps = {
            "entered": {
                "inside": 1,
                "entered": 1,
                "distinct": (one.zone, one.id, one.at_ns) in first,
                "appeared": one.how == "appeared",
            },
            "left": {"inside": -1, "left": 1, "lost": one.how == "lost"},
            "crossed": {f"to_{one.direction}": 1},
            "stayed": {},
        }[one.kind]
        for name, step in steps.items():
            if step:
                by_class = counts.setdefault(one.zone, {}).setdefault(name, {})
                by_class[one.label] = by_class.get(one.label, 0) + int(step)
    return replace(state, counts=counts, numbers=numbers), tuple(ordered)


def _crossing(points: tuple[Point, ...], start: Moment, now: Event) -> tuple[int, int, Place]:
    """Return how often a move crossed a line, and when and where it did last; its end, where it did not."""
    since_ns, begin = start
    net, share = crossings(np.array(points, np.float64), *begin[:2], *now.position[:2])
    if share < 0.0:
        return net, now.at_ns, now.position
    x, y, z = (p + share * (q - p) for p, q in zip(begin, now.position, strict=True))
    return net, since_ns + round(share * (now.at_ns - since_ns)), (x, y, z)


def _ns(seconds: float) -> int:
    return round(seconds * _SECOND)
