"""Sessions taken along from the folder of one machine into a cluster that nobody tracks in yet."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from optipmb_service.cluster.leases import NOBODY, PARTITIONS, partition_key, partition_of
from optipmb_service.cluster.store import Fenced, StoreError, Write

if TYPE_CHECKING:
    from optipmb_service.cluster.sqlite import SqliteStore
    from optipmb_service.cluster.store import LeaseStore

AT_ONCE: Final = 32
"""Checkpoints in memory."""


class Copied(NamedTuple):
    """What became of the sessions of a folder."""

    copied: int
    known: int
    """Left out: the cluster has a session of the same stream."""


def copy_sessions(source: SqliteStore, target: LeaseStore) -> Copied:
    """Copy the newest checkpoint of each stream that the target has none of; interrupted, it may be begun again.

    Every partition gets a record that says that nobody holds it, and its revision is the fence of what is copied: a
    member that takes a partition meanwhile makes the copy fail, and not the other way round.

    Args:
        source: a store that no member uses.
        target: of a cluster without members.

    Raises:
        StoreError: a store cannot be used, or a member holds a partition of the target.
    """
    fences: dict[int, int] = {}
    for partition in range(PARTITIONS):
        key = partition_key(partition)
        record = target.get(key)
        if record is not None and record.value != NOBODY:
            raise _held(record.value)
        fence = target.put(Write(key, NOBODY, record.revision if record else 0))
        if fence is None:
            raise _held("a member that has just begun")
        fences[partition] = fence
    copied = known = 0
    streams = iter(source.streams())
    while some := list(islice(streams, AT_ONCE)):
        batch: dict[str, Fenced] = {}
        for stream in some:
            data = source.load(stream)
            if target.load(stream) is not None:
                known += 1
            elif data is not None:
                partition = partition_of(stream)
                batch[stream] = Fenced(partition_key(partition), fences[partition], data)
        if target.save(batch):
            raise _held("a member that has just begun")
        copied += len(batch)
    return Copied(copied, known)


def _held(member: str) -> StoreError:
    return StoreError(f"{member} tracks in the cluster: end its members, copy, and start them again")
