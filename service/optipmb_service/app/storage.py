"""Where leases and checkpoints are kept: by the settings `cluster` and `store`."""

from __future__ import annotations

import time
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import structlog
from optipmb_schemas import Keys

from optipmb_service.cluster.leases import NOBODY, PARTITIONS, partition_key, partition_of
from optipmb_service.cluster.sqlite import SqliteStore, in_use
from optipmb_service.cluster.store import Fenced, StoreError, Write
from optipmb_service.streams.profiles import Fusion
from optipmb_service.streams.recovery import Log
from optipmb_service.units import DAY_S

if TYPE_CHECKING:
    from pathlib import Path

    from optipmb_service.cluster.store import LeaseStore
    from optipmb_service.settings import Settings

log = structlog.get_logger("optipmb_service")

STORE_FILE: Final = "sessions.db"
CLOSE_S: Final = 5.0
REACH_S: Final = 10.0
AGAIN_S: Final = 0.05
COPIED_AT_ONCE: Final = 32  # checkpoints in memory while they are copied


def open_store(settings: Settings, private: Path | None) -> tuple[LeaseStore, str | None]:
    """Return what the members share, and why it keeps no checkpoints; None: it keeps them.

    Without a folder, or with one that cannot be used, leases are kept for as long as this process lives, or its parent.

    Args:
        settings: of the process.
        private: folder that the workers of one parent share; None: this process has no parent.

    Raises:
        StoreError: the folder cannot be used, and others use it: a store of its own would give its streams two owners;
            or what the servers want to see cannot be read.
    """
    if settings.cluster:
        from optipmb_service.cluster.jetstream import JetStream  # noqa: PLC0415 - an extra

        return JetStream(settings.cluster, settings.prefix, settings.keep_days * DAY_S, nats_access(settings)), None
    folder, why = settings.folder, ""
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            store = SqliteStore(folder / STORE_FILE)
            kept = len(store.streams())
        except (OSError, StoreError) as error:
            if in_use(folder / STORE_FILE):
                raise StoreError(str(error)) from error
            # Tracking without memory is better than none; the status says that it is so.
            log.error("store_failed", error=str(error))  # noqa: TRY400 - the text says all
            why = str(error)
        else:
            if private is None and kept:
                log.info("sessions_stored", sessions=kept, folder=str(folder), hint="OPTIPMB_STORE=none keeps nothing")
            return store, None
    return SqliteStore(private and private / STORE_FILE), why


def nats_access(settings: Settings) -> dict[str, Any]:
    """Return the options that let NATS' client in at the servers of `cluster`.

    Raises:
        StoreError: a file cannot be read, or holds something else.
    """
    from optipmb_service.cluster.nats_connection import access  # noqa: PLC0415 - an extra

    return access(settings.cluster_tls, settings.cluster_credentials)


def copy_folder(settings: Settings) -> tuple[int, int]:
    """Copy the sessions of the folder `store` into the store of `cluster`, which must have no members yet.

    Returns:
        Number of copied sessions, and of those left out because the cluster has a session of the same stream.

    Raises:
        StoreError: either cannot be used, or a member uses it.
    """
    folder = settings.folder
    file = folder and folder / STORE_FILE
    if file is None or not file.exists():
        raise StoreError(f"{file or 'setting store'}: expected the checkpoints of a service, found none")
    if in_use(file):
        raise StoreError(f"{file}: a service uses it: end it first")
    source = SqliteStore(file)
    try:
        target, _ = open_store(settings, None)
        try:
            _reach(target)
            return _copy(source, target)
        finally:
            target.close(CLOSE_S)
    finally:
        source.close()


def _copy(source: SqliteStore, target: LeaseStore) -> tuple[int, int]:
    """Copy the newest checkpoint of each stream that the target has none of; interrupted, it may be begun again.

    Every partition gets a record without a holder, whose revision is the fence of the copies: when a member takes a
    partition meanwhile, the copy fails, and not the member.
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
    while some := list(islice(streams, COPIED_AT_ONCE)):
        batch: dict[str, Fenced] = {}
        for stream in some:
            data = source.load(stream)
            if target.load(stream) is not None:
                known += 1
            elif data is not None:
                partition = partition_of(stream)
                batch[stream] = Fenced(partition_key(partition), fences[partition], data, source.numbers(stream) or b"")
        if target.save(batch):
            raise _held("a member that has just begun")
        copied += len(batch)
    return copied, known


def _held(member: str) -> StoreError:
    return StoreError(f"{member} tracks in the cluster: end its members, copy, and start them again")


def _reach(store: LeaseStore) -> None:
    """Wait until a store can be used, which takes a moment where it is remote.

    Raises:
        StoreError: why it cannot, for long.
    """
    until_s = time.monotonic() + REACH_S
    while True:
        try:
            store.follow(0)
        except StoreError:
            if time.monotonic() > until_s:
                raise
            time.sleep(AGAIN_S)
        else:
            return


def open_log(settings: Settings) -> Log | None:
    """Return the log of frames and tracks, where there is a cluster."""
    if not settings.cluster:
        return None
    from optipmb_service.cluster.message_log import LogReader, MessageLog  # noqa: PLC0415 - an extra

    reader = LogReader(MessageLog(settings.cluster, settings.prefix, nats_access(settings)), settings.standby_s)
    return Log(reader, Keys(settings.prefix), Fusion.of(settings))
