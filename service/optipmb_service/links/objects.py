"""Objects of the sessions of an area: a row for each, and its number.

Objects are numbered as they come. A track that continues an object of its session is merged into it.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import TYPE_CHECKING, Final

import numpy as np

from optipmb_service.links.gaps import End

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from optipmb.model.rows import Index
    from optipmb_service.links.looks import InputStream, Look

    Table = NDArray[np.void]

START_NS: Final = 2 * 10**9
"""Objects that are there within this time of the start of a session have not begun there."""
APPEARANCE: Final = 2
NONE: Final = 3

OBJECT: Final = np.dtype([
    ("number", "i8"), ("session", "i8"), ("object", "i8"), ("global", "u8", 2), ("first_ns", "i8"), ("last_ns", "i8"),
    ("begin", "f8", 2), ("end", "f8", 2), ("velocity", "f4", 2), ("variance", "f4"), ("size", "f4", 3),
    ("probability", "f4"), ("stream", "i1"), ("kind", "i1"), ("how", "i1"), ("decided", "i1"), ("known", "i1"),
    ("ended", "i1"), ("told", "i1"),
])  # fmt: skip
"""An object of a session: ends in the plane of the area; `known`: it began while it was looked for; `told`: bits of
kind of the last publication, of the present id (1: any, 2: the end); `how`: of a pair, or `NONE`."""


class Objects:
    """The objects of an area.

    Attributes:
        table: `OBJECT`, by number.
        sessions: stream and session by number.
        following: the number of the next object or session.

    Args:
        area: its name.
    """

    def __init__(self, area: str) -> None:
        self._area = area
        self.table: Table = np.zeros(0, OBJECT)
        self.sessions: dict[int, tuple[str, str]] = {}
        self.following = 0
        self._known: dict[tuple[int, int], int] = {}

    def begin(self, stream: InputStream, session: str, stamp_ns: int) -> None:
        """Begin a session of a stream."""
        stream.session, stream.session_number, stream.begun_ns = session, self.following, stamp_ns
        self.sessions[self.following] = stream.name, session
        self.following += 1

    def restore(self, table: Table, sessions: list[tuple[int, tuple[str, str]]], following: int) -> None:
        """Take the objects of a state."""
        self.table, self.following = table, following
        self.sessions = {number: (one[0], one[1]) for number, one in sessions}
        rows = zip(table["session"].tolist(), table["object"].tolist(), table["number"].tolist(), strict=True)
        self._known = {(session, one): number for session, one, number in rows}

    def at(self, numbers: Index) -> Index:
        """Return the rows of numbers."""
        return np.searchsorted(self.table["number"], numbers)

    def id_of(self, row: int) -> NDArray[np.uint64]:
        """Return the id that an object has where nothing else gives it one."""
        session, identity = int(self.table["session"][row]), int(self.table["object"][row])
        own = f"{self._area} {' '.join(self.sessions[session])} {identity}".encode()
        return np.frombuffer(blake2b(own, digest_size=16).digest(), np.uint64)

    def continued(self, look: Look, keep: Index) -> list[tuple[int, int]]:
        """Return the numbers of tracks that continue other objects, by rows of a message, and of these.

        A track of an object that is not known yet becomes that object.
        """
        found: list[tuple[int, int]] = []
        if look.id is None:
            return found
        for one, identity in zip(look.object[keep].tolist(), look.id[keep].tolist(), strict=True):
            if one == identity or (old := self._known.pop((look.session, identity), None)) is None:
                continue
            if (new := self._known.get((look.session, one))) is not None:
                found.append((old, new))
            else:
                self._known[look.session, one] = old
                self.table["object"][self.at(np.array(old))] = one
        return found

    def numbers(self, stream: InputStream, look: Look, keep: Index) -> Index:
        """Return the numbers of the objects of rows of a message; new ones begin."""
        found = np.empty(len(keep), np.int64)
        new: list[int] = []
        for at, one in enumerate(look.object[keep].tolist()):
            number = self._known.get((look.session, one), -1)
            if number < 0:
                number = self._known[look.session, one] = self.following
                self.following += 1
                new.append(at)
            found[at] = number
        if new:
            rows, stamp_ns = keep[new], np.int64(look.stamp_ns)
            more = np.zeros(len(new), OBJECT)
            more["number"], more["session"], more["stream"] = found[new], look.session, stream.number
            more["object"] = look.object[rows]
            more["first_ns"] = stamp_ns - np.where(look.age_ns[rows] < START_NS, look.age_ns[rows], 0)
            more["last_ns"] = stamp_ns - look.since_ns[rows]
            seconds = (stamp_ns - more["first_ns"]) * 1e-9
            more["begin"] = look.place[rows] - seconds[:, None] * look.velocity[rows]
            more["end"], more["velocity"] = look.place[rows], look.velocity[rows]
            more["variance"], more["size"] = look.variance[rows], look.size[rows]
            more["known"] = more["first_ns"] > stream.begun_ns + START_NS
            more["kind"] = look.kind[rows]
            more["how"] = NONE
            first = len(self.table)
            self.table = np.concatenate((self.table, more))
            self.table["global"][first:] = [self.id_of(row) for row in range(first, len(self.table))]
        return found

    def update(self, look: Look, keep: Index, numbers: Index) -> tuple[Index, Index]:
        """Take the newest ends from rows of a message; return the numbers and rows of detected objects."""
        at = self.at(numbers)
        self.table["last_ns"][at] = np.maximum(self.table["last_ns"][at], np.int64(look.stamp_ns) - look.since_ns[keep])
        seen = look.since_ns[keep] == 0
        at, rows = at[seen], keep[seen]
        self.table["end"][at], self.table["velocity"][at] = look.place[rows], look.velocity[rows]
        self.table["variance"][at], self.table["size"][at] = look.variance[rows], look.size[rows]
        self.table["kind"][at] = look.kind[rows]
        return numbers[seen], rows

    def drop(self, gone: NDArray[np.bool_]) -> None:
        """Forget objects."""
        for row in self.table[gone]:
            key = int(row["session"]), int(row["object"])
            if self._known.get(key) == row["number"]:
                del self._known[key]
        self.table = self.table[~gone]

    def ends(self, rows: Index, streams: dict[int, InputStream], *, begin: bool) -> End:
        """Return the ends or beginnings of objects."""
        own = self.table[rows]
        place = own["begin" if begin else "end"]
        local = np.empty_like(place)
        for stream in np.unique(own["stream"]).tolist():
            frame = streams[stream].frame
            at = own["stream"] == stream
            local[at] = frame._replace(yaw=-frame.yaw).turned(place[at] - (frame.x, frame.y))
        return End(
            own["number"],
            own["stream"].astype(np.int64),
            np.array([streams[one].frame.plane for one in own["stream"].tolist()], np.int64),
            own["kind"].astype(np.int64),
            place,
            local,
            own["velocity"].astype(np.float64),
            own["variance"].astype(np.float64),
            own["size"].astype(np.float64),
            own["first_ns" if begin else "last_ns"],
            own["known"] > 0 if begin else np.ones(len(own), np.bool_),
        )
