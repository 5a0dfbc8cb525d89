"""A session passes from member to member: each of its frames is tracked once, through all faults."""

from collections.abc import Callable
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from optipmb_service.cluster.leases import Change, partition_of
from optipmb_service.session.checkpoint import Checkpoint
from registries import Around, packet_of, streams_of
from router import Sensor

SENSOR = Sensor()
NAME = SENSOR.stream
PARTITION = partition_of(NAME)


class Cluster:
    """A store and a lease that two members share; their requests to the store wait for the test."""

    def __init__(self) -> None:
        self.kept: Checkpoint | None = None
        self.fence = 0
        self.held: Held | None = None
        self.asked: list[Callable[[], None]] = []
        """Reads and writes of the store that are under way."""


class Held(Around):
    def __init__(self, cluster: Cluster) -> None:
        super().__init__()
        self.cluster = cluster
        self.leaving = False
        self.streams = streams_of(self, standby_s=600)

    def holds(self, _: str) -> bool:
        return self.cluster.held is self and not self.leaving

    def fence(self, _: str) -> int | None:  # type: ignore[override]  # without a lease there is none
        return self.cluster.fence if self.cluster.held is self else None

    def may_write(self, _: str, fence: int | None) -> bool:  # type: ignore[override]  # both are given
        return fence is not None and fence == self.fence("")

    def put(self, checkpoint: Checkpoint, fence: int | None, then: Callable[[], None] | None = None) -> None:
        def write() -> None:
            if fence == self.cluster.fence:
                self.cluster.kept = checkpoint
            if then is not None:
                then()

        self.cluster.asked.append(write)

    def recall(self, stream: str, restore: Any, then: Any, _: object = None) -> None:
        del stream
        self.cluster.asked.append(lambda: then(restore(self.cluster.kept) if self.cluster.kept else None))


class World:
    def __init__(self, *, cached: bool) -> None:
        self.cluster = Cluster()
        self.members = [Held(self.cluster), Held(self.cluster)]
        self.sent = 0
        self._cached = cached
        self._receiving = list(self.members)
        self._take(self.members[0])

    def send(self) -> None:
        """Send a frame to its receivers: all members where no publisher has a cache."""
        for member in self._receiving if self._cached else self.members:
            member.streams.receive(packet_of(SENSOR.detections(self.sent)))
        self.sent += 1

    def turn(self) -> None:
        for member in self.members:
            member.turn()

    def answer(self) -> None:
        if self.cluster.asked:
            self.cluster.asked.pop(0)()

    def keep(self) -> None:
        for member in self.members:
            member.streams.keep()

    def recall(self) -> None:
        if (holder := self.cluster.held) is not None:
            holder.leaving = True
            holder.streams.changed(PARTITION, Change.RECALLED)

    def move(self) -> None:
        """Give the partition to the other member; where publishers have caches only when it was left in order."""
        holder = self.cluster.held
        if holder is None or (self._cached and not (holder.leaving and PARTITION not in holder.streams.occupied())):
            return
        other = self.members[holder is self.members[0]]
        self.cluster.held, holder.leaving = None, False
        holder.streams.changed(PARTITION, Change.LOST)
        self._take(other)

    def end(self) -> None:
        for _ in range(20):
            while self.cluster.asked:
                self.answer()
            for member in self.members:
                member.run()
        if (holder := self.cluster.held) is not None and holder.leaving:
            self.move()
            self.end()

    def _take(self, member: Held) -> None:
        self.cluster.held = member
        self.cluster.fence += 1
        member.streams.changed(PARTITION, Change.HELD)
        self._receiving.append(member)
        member.streams.hold(NAME)
        packets = [one for other in self.members if other is not member for one in other.streams.recent([NAME])]
        self._receiving = [member]
        member.streams.take_up(NAME, packets)


ACTIONS = st.sampled_from(["send"] * 3 + ["turn"] * 4 + ["answer"] * 3 + ["keep", "recall", "move"])


@settings(deadline=None, max_examples=60)
@given(st.lists(ACTIONS, max_size=60), st.booleans())
def test_each_frame_is_tracked_once(actions: list[str], cached: bool) -> None:  # noqa: FBT001 - drawn
    """However reads and writes of the store, turns, frames and moves follow each other.

    Frames of publishers with a cache come to the member alone that has the session; it gives up its state in order.
    Others come to both members, and the session may be taken at any time.
    """
    world = World(cached=cached)
    for action in actions:
        getattr(world, action)()
    world.end()
    holder = world.cluster.held
    assert holder is not None
    for stream in holder.streams.tracking():
        stream.flush()
    states = [one.counts.state(one.session) for one in holder.streams.tracking() if one.session is not None]
    assert sum(state.frames for state in states) == world.sent
    assert sum(member.streams.totals().shed for member in world.members) == 0
