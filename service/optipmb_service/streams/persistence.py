"""Checkpoints on their way to the store, off the path of the frames: one thread encodes and writes them all.

The tracking thread gives references to values that never change, which costs it microseconds. The checkpoint writer
waits before it writes: what a checkpoint contains must have left this process as tracks, or a kill between the
two would swallow them (frames tracked again after a restore are published again, frames in the checkpoint are not).
Then it writes all sessions that changed in one transaction.

A store that fails (disk full, read-only, gone) costs durability and nothing else: tracking goes on, the status of the
service is `degraded`, and every interval tries again with the newest state.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import structlog

from optipmb_service.cluster.leases import partition_key, partition_of
from optipmb_service.cluster.store import Fenced, StoreError, load_newest
from optipmb_service.session.checkpoint import (
    Checkpoint,
    CheckpointError,
    decode_checkpoint,
    encode_checkpoint,
    numbers_in,
    seal,
)
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from optipmb_service.cluster.member import Member
    from optipmb_service.cluster.store import LeaseStore
    from optipmb_service.session.identity import Incarnation

log = structlog.get_logger("optipmb_service")

DUMPS: Final = "quarantine"
"""Folder of the dumps of sessions whose step raised."""

DUMP_SUFFIX: Final = ".dump"
MAX_DUMPS: Final = 32

_T = TypeVar("_T")

FAILED_NS: Final = 60 * SECOND
"""Time after the last failure for which a stream's checkpoint counts as failing."""

EXPIRE_EVERY_NS: Final = 3600 * SECOND
FIRST_EXPIRY_NS: Final = 600 * SECOND
"""Time after the start in which streams come back whose checkpoints seem old: the process was off, or a clock wrong."""

MAX_FAILED: Final = 1024
"""Streams whose failure is remembered."""

SHOWN: Final = 3
"""Failing streams that are named at once."""

SETTLE_S: Final = 0.25
"""Between a checkpoint and its writing, time for the tracks to leave."""

LEAVE_SETTLE_S: Final = 0.03
"""The same where a stream is left and another member waits for it: this process is about to do nothing else."""

RETRY_S: Final = 0.1
"""Between two tries to read from a store that cannot be reached."""

READ_AT_ONCE: Final = 8
"""Checkpoints read at once from a store elsewhere: each waits for an answer."""

PAUSE_S: Final = 0.003
"""Between two checkpoints that are encoded; less where there are so many that it would take half the interval."""


class CheckpointWriter:
    """Writes and reads the checkpoints of one process.

    Args:
        store: where they go.
        interval_s: time between two rounds.
        member: knows what may be written, and under which fence.
        report: called with a stream whose checkpoint cannot be made, and why.
        keep_s: age at which the checkpoints of a stream go; 0: never.
        off: why none are kept, empty when none are to be; None: they are kept.
    """

    def __init__(
        self,
        store: LeaseStore,
        interval_s: float,
        member: Member,
        report: Callable[[str, str], None] = lambda *_: None,
        keep_s: float = 0.0,
        off: str | None = None,
    ) -> None:
        self._keep_s = keep_s
        self._expires_ns = time.monotonic_ns() + FIRST_EXPIRY_NS
        self._report = report
        self._store = store
        self.durable = off is None
        """Whether checkpoints are there after a restart."""
        self._interval_s = interval_s
        self._gather: Callable[[], None] = lambda: None
        self._kept: Callable[[Checkpoint], None] = lambda _: None
        self._member = member
        self._lock = threading.Lock()
        self._pending: dict[str, tuple[Checkpoint, int | None]] = {}
        self._writing: dict[str, tuple[Checkpoint, int | None]] = {}
        self._thens: list[tuple[str, Callable[[], None]]] = []
        self._reading = ThreadPoolExecutor(READ_AT_ONCE if off is None and store.remote else 1, "restore")
        self._hurry = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="checkpoints", daemon=True)
        self._whole = True
        self._store_failure = off or ""
        self._failed_streams: dict[str, tuple[int, str]] = {}
        self.written = 0
        """Checkpoints written since the start."""
        self.complete_ns = time.monotonic_ns() if off != "" else None
        """Monotonic time at which the store last had all that it should; None when nothing is to be kept."""

    def start(self, gather: Callable[[], None], kept: Callable[[Checkpoint], None] = lambda _: None) -> None:
        """Begin the rounds: `gather` has changed sessions give their states, `kept` gets each that was written."""
        self._gather, self._kept = gather, kept
        if self.durable:
            self._thread.start()

    @property
    def failure(self) -> str:
        """Present failure of the store, or of the checkpoint of a stream; empty while there is none."""
        if self._store_failure:
            return self._store_failure
        lately_ns = time.monotonic_ns() - FAILED_NS
        failed = sorted(
            f"checkpoint of {stream}: {why}"
            for stream, (at_ns, why) in tuple(self._failed_streams.items())
            if at_ns >= lately_ns
        )
        return "; ".join(failed[:SHOWN])

    def put(self, checkpoint: Checkpoint, fence: int | None, then: Callable[[], None] | None = None) -> None:
        """Have a checkpoint written in this round; with `then`, soon, and `then` called when that was tried."""
        if not self.durable:
            if then is not None:
                then()
            return
        with self._lock:
            self._pending[checkpoint.stream] = checkpoint, fence
            if then is not None:
                self._thens.append((checkpoint.stream, then))
        if then is not None:
            self._hurry.set()

    def recall(
        self,
        stream: str,
        restore: Callable[[Checkpoint], _T],
        then: Callable[[_T | None], None],
        unread: Callable[[Incarnation], None] = lambda _: None,
    ) -> None:
        """Call `then` with what `restore` makes of the newest checkpoint of a stream, None without one.

        `unread` is called before with the numbers that a stream has used whose checkpoints cannot be read, or have
        expired. All are called on another thread, soon: the tracking thread does not wait for the store.
        """
        if not self.durable:
            then(None)
            return

        def read() -> None:
            restored = None
            try:
                restored = self._recalled(stream, restore, unread)
            except Exception:
                log.exception("internal_error", stream=stream)  # the stream begins without it
            try:
                then(restored)
            except Exception:
                log.exception("internal_error", stream=stream)

        with contextlib.suppress(RuntimeError):  # at the end: it has closed
            self._reading.submit(read)

    def forget(self, stream: str) -> None:
        """Drop the pending checkpoint of a stream."""
        with self._lock:
            self._pending.pop(stream, None)

    def _recalled(
        self, stream: str, restore: Callable[[Checkpoint], _T], unread: Callable[[Incarnation], None]
    ) -> _T | None:
        """Return what `restore` makes of the newest whole checkpoint of a stream; None when there is none.

        None also when the store fails: then the session begins empty. A store that cannot be reached is awaited while
        the stream is to be tracked here: an empty session would use track ids a second time.
        """

        def torn(error: CheckpointError) -> None:
            log.warning("checkpoint_torn", stream=stream, reason=str(error))
            if error.incarnation is not None:
                unread(error.incarnation)

        with self._lock:
            pending, fence = self._pending.get(stream) or self._writing.get(stream) or (None, None)
        if pending is not None and fence == self._member.fence(stream):
            return restore(pending)
        while True:
            try:
                restored = load_newest(
                    self._store,
                    stream,
                    lambda data: restore(decode_checkpoint(data)),
                    CheckpointError,
                    torn,
                )
                if restored is None and (numbers := self._store.numbers(stream)) is not None:
                    with contextlib.suppress(CheckpointError):
                        unread(numbers_in(numbers))
            except StoreError as error:
                self._failed(error)
                waits = self._store.remote and self._member.fence(stream) is not None
                if not waits or self._ended.wait(RETRY_S):
                    return None
            else:
                return restored

    def close(self, timeout: float) -> bool:
        """Write the pending checkpoints and end, within so long (s); to be called when nothing is tracked any more.

        Returns:
            Whether all is written that is still this member's.
        """
        if not self.durable:
            return not self._store_failure
        self._ended.set()
        self._hurry.set()
        self._reading.shutdown(wait=False, cancel_futures=True)
        if self._thread.is_alive():
            self._thread.join(timeout)
            if self._thread.is_alive():
                self._failed(StoreError(f"what is to be kept at the end is not written after {timeout:.1f} s"))
                return False
        return self._whole and not self._pending

    def _run(self) -> None:
        try:
            while self._serve(max(0.0, self._interval_s - SETTLE_S)):
                self._expire()
                self._gather()
                if self._serve(SETTLE_S):
                    if self._hurry.is_set():  # what somebody waits for was put just now
                        self._ended.wait(LEAVE_SETTLE_S)
                    self._write()
        finally:
            self._write()

    def _serve(self, seconds: float) -> bool:
        """For so long, and no longer, write at once what somebody waits for, and nothing else; False at the end."""
        ends = time.monotonic() + seconds
        while not self._ended.is_set():
            if (left_s := ends - time.monotonic()) <= 0.0 or not self._hurry.wait(left_s):
                return True
            self._hurry.clear()
            if not self._ended.wait(LEAVE_SETTLE_S):
                self._write(waited_for=True)
        return False

    def _expire(self) -> None:
        """Forget streams that have been silent for too long, now and then."""
        now_ns = time.monotonic_ns()
        if not self._keep_s or now_ns < self._expires_ns:
            return
        self._expires_ns = now_ns + EXPIRE_EVERY_NS
        try:
            if gone := self._store.expire(self._keep_s):
                log.info("checkpoints_expired", streams=gone)
                self._expires_ns = now_ns  # the next ones in the next round: checkpoints go first
        except StoreError as error:
            self._failed(error)

    def _write(self, *, waited_for: bool = False) -> None:
        """Write all that is pending; what the store refuses, and what must wait for a write lease, stays pending.

        Args:
            waited_for: write only what somebody waits for.
        """
        with self._lock:
            thens, self._thens = self._thens, []
            streams = {stream for stream, _ in thens} if waited_for else self._pending.keys()
            taken = self._writing = {stream: one for stream, one in self._pending.items() if stream in streams}
            self._pending = {stream: one for stream, one in self._pending.items() if stream not in streams}
        mine = {stream: one for stream, one in taken.items() if self._member.may_write(stream, one[1])}
        # A lease that lapsed is renewed, or the stream is lost: until that is known its newest state is kept.
        lapsed = {
            stream: one
            for stream, one in taken.items()
            if stream not in mine and one[1] == self._member.fence(stream) is not None
        }
        waiting = again = {} if self._ended.is_set() else lapsed
        try:
            self._save(mine)
        except Exception as error:
            if not isinstance(error, StoreError):
                log.exception("internal_error", thread="checkpoints")
            self._failed(error)
            again = mine | waiting
        else:
            if not (waited_for or waiting or self.failure):  # all sessions that changed have given their states
                self.complete_ns = time.monotonic_ns()
            self._whole = not (lapsed or self._failed_streams)
        with self._lock:
            self._pending, self._writing = again | self._pending, {}
            self._thens += [one for one in thens if one[0] in waiting]
        for stream, then in thens:
            if stream not in waiting:
                then()

    def _save(self, checkpoints: Mapping[str, tuple[Checkpoint, int | None]]) -> None:
        """Encode and save checkpoints with their fences, and note what the store has taken.

        Of a state that is too large the numbers are saved in its place: ids do not come again.
        """
        encoded = self._encoded({stream: one for stream, (one, _) in checkpoints.items()}) if checkpoints else {}
        most, fenced = self._store.max_bytes, {}
        for stream, data in encoded.items():
            checkpoint, fence = checkpoints[stream]
            if fence is not None:
                numbers = seal(b"", checkpoint.incarnation)
                kept = data if len(data) <= most else numbers
                fenced[stream] = Fenced(partition_key(partition_of(stream)), fence, kept, numbers)
        lost = self._store.save(fenced) if fenced else ()
        self.written += len(encoded) - len(lost)
        for stream, data in encoded.items():
            if len(data) > most:
                self._fail(stream, f"{len(data)} bytes, and the store takes {most}: the next ids alone are kept")
                continue
            self._failed_streams.pop(stream, None)
            if stream in lost:
                log.warning("checkpoint_refused", stream=stream)
            else:
                self._kept(checkpoints[stream][0])
        if encoded and self._store_failure:
            self._store_failure = ""
            log.info("store_back")

    def _encoded(self, checkpoints: Mapping[str, Checkpoint]) -> dict[str, bytes]:
        """Encode one after the other, with pauses between them.

        Encoding holds the interpreter's lock for a millisecond. Forty in a row are forty milliseconds in which frames
        only get what the interpreter takes away from this thread; a pause gives the lock to threads that wait for it.
        """
        pause_s = 0.0 if self._ended.is_set() else min(PAUSE_S, self._interval_s / 2 / len(checkpoints))
        encoded = {}
        for stream, one in checkpoints.items():
            try:
                encoded[stream] = encode_checkpoint(one)
            except Exception as error:  # noqa: BLE001 - an error of one stream must not keep the others
                self._fail(stream, f"{type(error).__name__}: {error}")
            if pause_s:
                self._ended.wait(pause_s)
        return encoded

    def _fail(self, stream: str, why: str) -> None:
        """Note that the checkpoint of one stream cannot be made."""
        if stream not in self._failed_streams:
            log.error("checkpoint_failed", stream=stream, error=why)
        while len(self._failed_streams) >= MAX_FAILED:
            self._failed_streams.pop(next(iter(self._failed_streams)))
        self._failed_streams[stream] = time.monotonic_ns(), why
        self._report(stream, why)

    def _failed(self, error: Exception) -> None:
        if not self._store_failure:
            log.error("store_failed", error=str(error))
        self._store_failure = str(error)


def save_dump(state: Path | None, stream: str, dump: bytes) -> str:
    """Write a dump into the folder of the state, whole or not at all; of too many the oldest go.

    Returns:
        The file: the name of the stream and a number that counts up. Empty where nothing is kept or can be written.
    """
    if state is None:
        return ""
    try:
        return str(_write_dump(state / DUMPS, stream, dump))
    except OSError as error:
        log.warning("store_failed", error=str(error))
        return ""


def _write_dump(folder: Path, stream: str, dump: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + max((_number_of(file) for file in folder.glob(f"*{DUMP_SUFFIX}")), default=0)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", stream)
    handle, temporary = tempfile.mkstemp(dir=folder)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(dump)
            file.flush()
            os.fsync(file.fileno())
        target = folder / f"{name}-{number:06d}{DUMP_SUFFIX}"
        Path(temporary).replace(target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    for old in sorted(folder.glob(f"*{DUMP_SUFFIX}"), key=_number_of)[:-MAX_DUMPS]:
        old.unlink(missing_ok=True)
    return target


def _number_of(file: Path) -> int:
    match = re.search(r"-(\d+)$", file.name.removesuffix(DUMP_SUFFIX))
    return int(match[1]) if match else 0
