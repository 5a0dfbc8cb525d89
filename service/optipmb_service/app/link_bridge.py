"""The role that links the tracks of streams: reads tracks, publishes which of their objects are one.

Each area has a `Linker`, whose state is a checkpoint in the store of the sessions. After a restart the caches of the
publishers bring the missed frames. Of two processes with one area the later one goes on: it takes the fence, and the
other one is refused when it saves.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from fnmatch import fnmatchcase
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import optipmb_schemas as schemas
import structlog

import optipmb
from optipmb import Georeference
from optipmb_service.app.storage import open_store
from optipmb_service.cluster.store import Fenced, StoreError, Write, load_newest
from optipmb_service.links.linker import Linker
from optipmb_service.links.looks import MOST_STREAMS
from optipmb_service.links.places import WorldFrame
from optipmb_service.session.problems import problem_of
from optipmb_service.telemetry.health import Component
from optipmb_service.telemetry.problem_reporter import ProblemReporter

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_client.incoming import Arrival
    from optipmb_client.zenoh.handles import Query

    from optipmb_service.cluster.store import LeaseStore
    from optipmb_service.settings import LinkSettings, Settings
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")

SAVE_S: Final = 1.0
WHOLE_S: Final = 10.0
PROBLEMS_S: Final = 5.0
HISTORY_S: Final = 2.0
"""Time from the start in which messages come from caches, which are up to"""
CACHED_NS: Final = 10 * 10**9
"""so old."""
CLOSE_S: Final = 1.0
CACHE: Final = 100
QUERIES: Final = 16
VECTORS: Final = 64
"""Frames of a stream whose vectors wait for their tracks."""
VECTOR_S: Final = 1.0
"""Least time between two vectors of a stream."""
REACH_S: Final = 10.0
"""Longest wait for the store, and for its record of an area."""
PAUSE_S: Final = 0.1


class LinkedArea:
    """One area: its linker, its publisher and its checkpoint.

    Args:
        name: of the area.
        settings: of the process.
        client: on the network.

    Raises:
        StoreError: the store cannot be used.
    """

    def __init__(self, name: str, settings: Settings, client: Client, store: Any) -> None:
        self.name, self.settings = name, settings.links[name]
        self._client, self._store, self._instance = client, store, settings.instance
        self._kept = f"links/{name}/state"
        about = name, self.settings, _frames(self.settings, settings)
        kept = load_newest(store, self._kept, partial(Linker.restored, *about), ValueError, self._torn)
        self.linker = kept or Linker(*about)
        self.lock = threading.Lock()
        self.replaced = False
        """Whether another process has taken the area."""
        self._revision = 0
        self._fence: int | None = None
        until = time.monotonic() + REACH_S
        while self._fence is None:
            record = store.get(f"link/{name}")
            self._fence = store.put(Write(f"link/{name}", settings.instance, record.revision if record else 0))
            if self._fence is None and time.monotonic() > until:
                raise StoreError(f"link/{name}: other processes take the area again and again")
            if self._fence is None:
                time.sleep(PAUSE_S)
        self._saved = b""
        key = client.keys.links(name)
        self._sender = client.cached_sender(key, schemas.encoding_of(schemas.Links), cache=CACHE)
        refusal = problem_of(
            "refused",
            path="key",
            expected=f"at most {QUERIES} queries at once",
            received="more",
            subject=name,
            stream="",
            instance=settings.instance,
        )
        self._key = client.keys.links_query(name)
        self._queries = client.serve(self._key, self._answer, most=QUERIES, refusal=refusal)
        self.whole_s = 0.0

    def take(self, message: schemas.Tracks, arrived_ns: int, vectors: Any) -> None:
        """Accept tracks, and publish what changes."""
        with self.lock:
            if self.replaced:
                return
            self.linker.take(message, arrived_ns, vectors)
            if changes := self.linker.changes():
                self._sender.put(schemas.encode(self._message(changes, whole=False)))

    def work(self) -> None:
        """Save the state, and publish the whole when it is due; to be called often.

        Raises:
            StoreError: it cannot be saved.
        """
        now = time.monotonic()
        with self.lock:
            state = self.linker.state()
            if now >= self.whole_s and not self.replaced:
                self.whole_s = now + WHOLE_S
                self._sender.put(schemas.encode(self._message(self.linker.rows(), whole=True)))
        if state == self._saved or self.replaced or self._fence is None:
            return
        if self._store.save({self._kept: Fenced(f"link/{self.name}", self._fence, state)}):
            self.replaced = True
            log.error("links_taken", area=self.name, hint="another optipmb-service link has this area now")
        self._saved = state

    def close(self) -> None:
        self._queries.close(CLOSE_S)
        self._sender.close()

    def _answer(self, query: Query) -> None:
        with self.lock:
            message = self._message(self.linker.rows(), whole=True)
        query.answer(self._key, message)
        query.finish()

    def _message(self, rows: list[schemas.LinkedObject], *, whole: bool) -> schemas.Links:
        self._revision = max(self._revision + 1, time.time_ns() // 1_000_000)
        stamp_ns, objects = max(self.linker.grid_ns, 0), tuple(rows)
        return schemas.Links(area=self.name, revision=self._revision, stamp_ns=stamp_ns, whole=whole, objects=objects)

    def _torn(self, error: ValueError) -> None:
        log.error("links_torn", area=self.name, error=str(error))


class LinkBridge(Component):
    """The areas of a process; the client is closed by the caller, after this.

    Raises:
        StoreError: the store cannot be used.
    """

    def __init__(self, settings: Settings, client: Client) -> None:
        optipmb.warm_up(rejoin=True)  # before the first message, whose areas would not answer while kernels compile
        super().__init__(client)
        self._client, self._instance = client, settings.instance
        self._limits = settings.limits.limits()
        self.messages: Counter[str] = Counter()
        self.reporter = ProblemReporter(client.publish_problem)
        self._store, self._why = open_store(settings, None)
        _reach(self._store)
        self.areas = [LinkedArea(name, settings, client, self._store) for name in settings.links]
        self._vectors: dict[str, OrderedDict[tuple[bytes, int], Any]] = {}
        self._begun = time.monotonic()
        self._due_s = 0.0
        tracks = {one for area in self.areas for one in area.settings.streams}
        detections = {one for area in self.areas if area.settings.embedding_model for one in area.settings.streams}
        self._subscriptions = [
            client.subscribe(client.keys.matching(_whole(one), "detections"), self._see) for one in sorted(detections)
        ]
        self._subscriptions += [
            client.subscribe(client.keys.matching(one, "tracks"), self._take, history=True)
            for one in sorted({_whole(one) for one in tracks})
        ]

    @property
    def failure(self) -> str:
        """Why nothing can be received, or nothing is kept; empty while it works."""
        taken = [area.name for area in self.areas if area.replaced]
        return self.unlinked or (self._why or "") or (f"links: another process has {', '.join(taken)}" if taken else "")

    def counts(self) -> dict[str, int]:
        """Return how many messages and objects were left out since the start of the state, by reason."""
        total = Counter(self.messages)
        for area in self.areas:
            with area.lock:
                total.update(area.linker.inputs.counters)
        return {name: count for name, count in total.items() if name != "taken"}

    def objects(self, *, linked: bool) -> dict[str, int]:
        """Return how many objects each area remembers, or has linked."""
        return {one.name: one.linker.linked if linked else len(one.linker.objects.table) for one in self.areas}

    def work(self) -> None:
        """Save and report; to be called often."""
        try:
            for area in self.areas:
                area.work()
            self._why = None
        except StoreError as error:
            if not self._why:
                log.error("links_not_saved", error=str(error))  # noqa: TRY400 - the text says all
            self._why = str(error)
        now = time.monotonic()
        if now >= self._due_s:
            self._due_s = now + PROBLEMS_S
            for area in self.areas:
                with area.lock:
                    wrong = area.linker.wrong()
                for (stream, code), text in wrong.items():
                    self._report(stream, code, text)
        self.reporter.flush(time.monotonic_ns())

    def close(self) -> None:
        """Save the newest state, and end."""
        for subscription in self._subscriptions:
            subscription.close(CLOSE_S)
        self.work()
        for area in self.areas:
            area.close()
        self._store.close(CLOSE_S)

    def _report(self, stream: str, path: str, text: str) -> None:
        problem = problem_of(
            "links",
            stream=stream,
            instance=self._instance,
            path=path,
            expected="tracks that can be linked",
            received=text,
            message=f"{stream or 'links'}: {text}.",
        )
        self.reporter.report(problem, time.monotonic_ns())

    def _decoded(self, message: Arrival, kind: Any) -> Any:
        try:
            stream = self._client.keys.stream_of(message.key)
            content = schemas.decode(message.payload, kind, encoding=message.encoding, limits=self._limits)
            if content.stream != stream:
                raise schemas.MessageError("invalid_value", "stream", stream, content.stream)  # noqa: TRY301 - as others
        except schemas.MessageError as error:
            self.messages["invalid"] += 1
            self._report("", error.path or "message", f"{message.key}: {error}")
            return None
        return content

    def _take(self, message: Arrival) -> None:
        areas = self._areas_of(message.key)
        content = self._decoded(message, schemas.Tracks) if areas else None
        if content is None:
            return
        self.messages["taken"] += 1
        arrived_ns, delivery = time.time_ns(), content.delivery
        if delivery is not None and time.monotonic() < self._begun + HISTORY_S:
            # From a cache: it was published before this process was there.
            arrived_ns = min(arrived_ns, max(delivery.published_ns, arrived_ns - CACHED_NS))
        vectors = self._vectors_of(content)
        for area in areas:
            area.take(content, arrived_ns, vectors if area.settings.embedding_model else None)

    def _areas_of(self, key: str) -> list[LinkedArea]:
        stream = self._client.keys.stream_of(key)
        return [one for one in self.areas if any(fnmatchcase(stream, part) for part in one.settings.streams)]

    def _see(self, message: Arrival) -> None:
        """Keep the vectors of a frame until its tracks come, at most once a second of a stream."""
        areas = self._areas_of(message.key)
        content = self._decoded(message, schemas.Detections) if areas else None
        if content is None or content.embedding is None:
            return
        if content.embedding_model not in {area.settings.embedding_model for area in areas}:
            self.messages["other_model"] += 1
            return
        if content.stream not in self._vectors and len(self._vectors) >= MOST_STREAMS * len(self.areas):
            self.messages["too_many_streams"] += 1
            return
        kept = self._vectors.setdefault(content.stream, OrderedDict())
        newest = next(reversed(kept.values()), None)
        if newest is not None and 0 <= content.stamp_ns - newest[0] < VECTOR_S * 1e9:
            return
        kept[content.epoch, content.seq] = content.stamp_ns, content.embedding
        if len(kept) > VECTORS:
            kept.popitem(last=False)

    def _vectors_of(self, tracks: schemas.Tracks) -> Any:
        """Return the vectors of tracks (N, E), None where there are none."""
        kept = self._vectors.get(tracks.sensor or tracks.stream)
        found = kept.get((tracks.epoch, tracks.seq)) if kept else None
        if found is None or not len(found[1]):
            return None
        rows = np.full((len(tracks.id), found[1].shape[1]), np.nan, np.float32)
        detected = np.flatnonzero((tracks.detection >= 0) & (tracks.detection < len(found[1])))
        rows[detected] = found[1][tracks.detection[detected]]
        return rows


def _reach(store: LeaseStore) -> None:
    """Wait for a store that connects in the background.

    Raises:
        StoreError: it cannot be reached.
    """
    until = time.monotonic() + REACH_S
    while True:
        try:
            store.get("link")
        except StoreError:
            if time.monotonic() > until:
                raise
            time.sleep(PAUSE_S)
        else:
            return


def _whole(pattern: str) -> str:
    """Return a pattern whose parts are `*` or names; further matches are left out later."""
    return "/".join("*" if "*" in part else part for part in pattern.split("/"))


def _frames(own: LinkSettings, settings: Settings) -> Callable[[str], WorldFrame]:
    """Return what places the world frames of streams in an area, with its first site in `sites` as the plane."""
    planes: dict[str, int] = {}
    places = {site: Georeference(one.origin, one.x_heading) for site, one in settings.sites.items()}
    first = next((places[one] for one in sorted(places)), None)

    def frame(stream: str) -> WorldFrame:
        site = stream.partition("/")[0]
        if (given := own.frames.get(site)) is not None:
            return WorldFrame(0, *given.translation, given.yaw)
        if site not in places or first is None:
            # Of a site whose place is not known, the places can be compared with each other alone.
            return WorldFrame(planes.setdefault(site, 1 + len(planes)))
        corners = places[site].to_geographic(np.array(((0.0, 0.0, 0.0), (100.0, 0.0, 0.0))), np.zeros(2))
        (x, y, _), (u, v, _) = first.to_world(corners.lat, corners.lon, corners.alt).tolist()
        return WorldFrame(0, x, y, float(np.arctan2(v - y, u - x)))

    return frame
