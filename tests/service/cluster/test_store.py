"""Where checkpoints are kept: whole batches, the last two of each, torn ones aside."""

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from lease_log import Alone
from optipmb_service.cluster.sqlite import (
    ASIDE,
    ENDED_KEPT,
    LEASES,
    LOG_BYTES,
    MEMBERS,
    PAGE_BYTES,
    SLICE,
    SLICE_BYTES,
    SqliteStore,
)
from optipmb_service.cluster.store import ENDED, StoreError, Write, load_newest


@pytest.fixture(params=["memory", "file"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> SqliteStore:
    return SqliteStore(tmp_path / "sessions.db" if request.param == "file" else None)


def test_the_newest_is_loaded(tmp_path: Path) -> None:
    """The newest checkpoint comes back, also from another process."""
    one, other = SqliteStore(tmp_path / "s"), SqliteStore(tmp_path / "s")
    leases = Alone(one)
    assert one.load("a/b/c") is None
    leases.save({"a/b/c": b"1", "a/b/d": b"2"})
    leases.save({"a/b/c": b"3"})
    assert {stream: other.load(stream) for stream in other.streams()} == {"a/b/c": b"3", "a/b/d": b"2"}


def test_a_torn_one_is_set_aside_and_the_one_before_it_is_used(store: SqliteStore) -> None:
    """Nothing is deleted: the torn bytes are kept with the reason, and the last good checkpoint is the newest again."""
    leases = Alone(store)
    for data in (b"good 1", b"good 2", b"torn"):
        leases.save({"s": data})
    told: list[str] = []

    def read(data: bytes) -> bytes:
        if not data.startswith(b"good"):
            raise ValueError("half of it is missing")
        return data

    assert load_newest(store, "s", read, ValueError, told.append) == b"good 2"
    assert list(map(str, told)) == ["half of it is missing"]
    assert store.aside() == [("s", "half of it is missing", b"torn")]
    assert store.load("s") == b"good 2"


def test_when_all_are_torn_there_is_none(store: SqliteStore) -> None:
    """A stream without a readable checkpoint begins again."""
    leases = Alone(store)
    leases.save({"s": b"torn"})
    assert load_newest(store, "s", int, ValueError, lambda _: None) is None
    assert store.streams() == ()


def test_what_is_kept_is_bounded(store: SqliteStore) -> None:
    """Two checkpoints per stream, and the newest of those set aside."""
    leases = Alone(store)
    for number in range(ASIDE + 10):
        leases.save({"s": b"%d" % number})
        store.set_aside("s", "torn")
    assert len(store.aside()) == ASIDE
    for number in range(5):
        leases.save({"s": b"%d" % number})
    found = []
    while (data := store.load("s")) is not None:
        found.append(data)
        store.set_aside("s", "looked at")
    assert found == [b"4", b"3"]


def test_a_checkpoint_takes_few_pages(tmp_path: Path) -> None:
    """A new file has pages for the size of checkpoints; one that an earlier version made keeps its own, and goes on."""
    for name, page_bytes in (("new.db", PAGE_BYTES), ("old.db", 4096)):
        with contextlib.closing(sqlite3.connect(tmp_path / name)) as before:
            if name == "old.db":
                before.execute("PRAGMA journal_mode = WAL")
                before.execute("CREATE TABLE earlier (x)")
        store = SqliteStore(tmp_path / name)
        Alone(store).save({"a/b/c": bytes(90_000)})
        assert store.load("a/b/c") == bytes(90_000)
        store.close()
        with contextlib.closing(sqlite3.connect(tmp_path / name)) as after:
            assert after.execute("PRAGMA page_size").fetchone() == (page_bytes,)


def test_the_log_beside_the_file_stays_small(tmp_path: Path) -> None:
    """The write-ahead log stays within its bound, with pages of any size."""
    for name in ("new.db", "old.db"):
        if name == "old.db":
            with contextlib.closing(sqlite3.connect(tmp_path / name)) as before:
                before.execute("CREATE TABLE earlier (x)")
        store = SqliteStore(tmp_path / name)
        leases = Alone(store)
        for number in range(200):
            leases.save({"a/b/c": number.to_bytes(2) * 50_000})
        assert LOG_BYTES / 2 < (tmp_path / f"{name}-wal").stat().st_size < 2 * LOG_BYTES
        store.close()


def test_a_closed_store_says_so(tmp_path: Path) -> None:
    """After `close`, which may come twice, the one error is raised."""
    store = SqliteStore(tmp_path / "s")
    store.close()
    store.close()
    with pytest.raises(StoreError, match="closed"):
        store.load("s")


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    """A file of something else, or a folder that is not there, ends in one clear error."""
    (tmp_path / "text").write_text("no database " * 100, encoding="utf-8")
    with pytest.raises(StoreError, match="text"):
        SqliteStore(tmp_path / "text")
    with pytest.raises(StoreError, match="nowhere"):
        SqliteStore(tmp_path / "nowhere" / "s")


def test_a_full_disk_is_an_error_and_loses_nothing(tmp_path: Path) -> None:
    """When the file may not grow, saving fails as a whole, and the older checkpoints stay."""
    store = SqliteStore(tmp_path / "s")
    leases = Alone(store)
    leases.save({"a": b"1", "b": b"1"})
    store._checkpoints.connection.execute("PRAGMA max_page_count = 12")  # type: ignore[union-attr]  # it is open
    with pytest.raises(StoreError, match="full"):
        leases.save({"a": b"2", "b": bytes(10**6)})
    assert (store.load("a"), store.load("b")) == (b"1", b"1")
    assert leases.save({"a": b"3"}) == frozenset()


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_read_only_folder_is_an_error(tmp_path: Path) -> None:
    """So that the service can say that it is degraded."""
    tmp_path.chmod(0o500)
    with pytest.raises(StoreError):
        SqliteStore(tmp_path / "s")


KILLED = """
import os, sys
from pathlib import Path
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import Fenced, Write
store = SqliteStore(Path(sys.argv[1]))
lease = store.get("partition/0")
fence = store.put(Write("partition/0", "one", lease.revision if lease else 0))
number = 0
while True:
    number += 1
    store.save({f"stream-{i}": Fenced("partition/0", fence, b"%d" % number * 5000) for i in range(20)})
    print(number, flush=True)
"""


def test_killed_while_saving_leaves_whole_batches(tmp_path: Path) -> None:
    """Of a process killed at any moment, the last batch that it finished is there, all of it or the one after it."""
    for _ in range(5):
        child = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "s")], stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        done = [int(child.stdout.readline()) for _ in range(5)][-1]
        child.kill()
        done = max([done, *map(int, child.stdout.read().split())])
        child.wait(60)
        child.stdout.close()
        store = SqliteStore(tmp_path / "s")
        found = {store.load(stream) for stream in store.streams()}
        assert found in ({b"%d" % done * 5000}, {b"%d" % (done + 1) * 5000})
        store.close()


def test_what_was_silent_for_long_expires(tmp_path: Path) -> None:
    """Checkpoints of which nothing was saved for an age go; newer ones stay."""
    now = [1000.0]
    store = SqliteStore(tmp_path / "store.db", lambda: now[0])
    leases = Alone(store)
    leases.save({f"a/b/{number}": b"1" for number in range(SLICE + 1)} | {"a/b/new": b"1"})
    now[0] += 500
    leases.save({"a/b/new": b"2"})
    now[0] += 600
    assert [store.expire(1000.0) for _ in range(3)] == [SLICE, 1, 0]
    assert (store.streams(), store.load("a/b/new")) == (("a/b/new",), b"2")
    store.close()


def test_a_renewal_waits_for_no_checkpoint(tmp_path: Path) -> None:
    """While one process or another writes checkpoints, for as long as its disk wants, records are read and written."""
    one, other = SqliteStore(tmp_path / "s"), SqliteStore(tmp_path / "s")
    with one._checkpoints.transaction():
        for number, store in enumerate((one, other)):
            assert store.put(Write(f"member/{number}/1", "alive", 0)) == number + 1
            assert len(store.follow(0)) == number + 1
    for store in (one, other):
        store.close()


def test_much_is_saved_in_parts(tmp_path: Path) -> None:
    """So that other processes have their turn in between: neither many checkpoints nor many bytes at once."""
    store = SqliteStore(tmp_path / "s")
    leases = Alone(store)
    done: list[str] = []
    store._checkpoints.connection.set_trace_callback(done.append)  # type: ignore[union-attr]  # it is open
    leases.save({str(number): b"1" for number in range(3 * SLICE)})
    assert done.count("COMMIT") == 3
    leases.save({str(number): bytes(SLICE_BYTES // 2) for number in range(6)})
    assert done.count("COMMIT") == 6
    store.close()


def test_a_damaged_file_of_leases_is_made_anew(tmp_path: Path) -> None:
    """It is not synced, and may be damaged after a power cut; while a member uses it, it is left alone."""
    store = SqliteStore(tmp_path / "s")
    Alone(store).save({"a": b"1"})
    store.close()
    for path in tmp_path.glob(f"{LEASES}*"):
        path.unlink()
    (tmp_path / LEASES).write_text("no database " * 100, encoding="utf-8")
    store = SqliteStore(tmp_path / "s")
    assert (store.follow(0), store.load("a")) == ([], b"1")
    assert store.put(Write("member/one/1", "alive", 0)) == 1
    for path in tmp_path.glob(f"{LEASES}*"):
        path.unlink()
    (tmp_path / LEASES).write_text("no database " * 100, encoding="utf-8")
    with pytest.raises(StoreError, match="not a database"):
        SqliteStore(tmp_path / "s")
    store.close()


def test_a_lock_that_somebody_removed_says_nothing(tmp_path: Path) -> None:
    """A member whose file was cleaned up is not taken for dead while it lives."""
    one, other = SqliteStore(tmp_path / "s"), SqliteStore(tmp_path / "s")
    assert one.put(Write("member/one/1", "alive", 0)) == 1
    (lock,) = (tmp_path / MEMBERS).iterdir()
    lock.unlink()
    assert not other.gone("one/1")
    for store in (one, other):
        store.close()


def test_a_member_that_is_killed_is_gone_at_once(tmp_path: Path) -> None:
    """Its lock goes with its process, and not before; also when it was frozen."""
    store = SqliteStore(tmp_path / "s")
    child = subprocess.Popen(
        [sys.executable, "-c", MEMBER, str(tmp_path / "s")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert child.stdin is not None
    assert child.stdout is not None
    assert child.stdout.readline() == "member\n"
    assert not store.gone("one/1")
    child.send_signal(signal.SIGSTOP)
    assert not store.gone("one/1")
    child.kill()
    child.wait(60)
    child.stdin.close()
    child.stdout.close()
    assert store.gone("one/1")
    assert store.put(Write("member/one/1", ENDED, 1)) == 2
    assert list((tmp_path / MEMBERS).iterdir()) == []


MEMBER = """
import sys
from pathlib import Path
from optipmb_service.cluster.sqlite import SqliteStore
from optipmb_service.cluster.store import Write
store = SqliteStore(Path(sys.argv[1]))
assert store.put(Write("member/one/1", "alive", 0)) == 1
print("member", flush=True)
sys.stdin.read()
"""


def test_few_records_of_ended_members_are_kept(tmp_path: Path) -> None:
    """However often a service is started: the newest stay, and revisions only grow."""
    store = SqliteStore(tmp_path / "s")
    revision = 0
    for number in range(ENDED_KEPT + 20):
        began = store.put(Write(f"member/one/{number}", "alive", 0))
        assert began == revision + 1
        revision = store.put(Write(f"member/one/{number}", ENDED, began)) or 0
        assert revision == began + 1
    assert len(store.follow(0)) == ENDED_KEPT + 1
    store.close()
