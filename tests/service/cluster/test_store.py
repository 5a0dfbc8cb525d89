"""Where checkpoints are kept: whole batches, the last two of each, torn ones aside, one owner at a time."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from optipmb_service.cluster.store import ASIDE, MemoryStore, SqliteStore, Store, StoreError, load_newest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Make = Callable[[str], Store]


@pytest.fixture(params=["memory", "sqlite"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Make:
    """Makes stores of the same contents for several owners."""
    if request.param == "sqlite":
        return lambda owner: SqliteStore(tmp_path / "checkpoints.sqlite", owner)
    shared = MemoryStore()
    return lambda owner: MemoryStore(owner, shared)


def test_the_newest_is_loaded(make: Make) -> None:
    """What was saved last comes back, also from another process."""
    one, other = make("one"), make("other")
    assert one.load("a/b/c") is None
    one.save({"a/b/c": b"1", "a/b/d": b"2"})
    one.save({"a/b/c": b"3"})
    assert other.load("a/b/c") == b"3"
    assert {stream: other.load(stream) for stream in other.streams()} == {"a/b/c": b"3", "a/b/d": b"2"}
    assert other.streams() == ("a/b/c", "a/b/d")
    one.delete("a/b/c")
    assert other.streams() == ("a/b/d",)


def test_a_torn_one_is_set_aside_and_the_one_before_it_is_used(make: Make) -> None:
    """Nothing is deleted: the torn bytes are kept with the reason, and the last good checkpoint is the newest again."""
    store = make("")
    for data in (b"good 1", b"good 2", b"torn"):
        store.save({"s": data})
    told: list[str] = []

    def read(data: bytes) -> bytes:
        if not data.startswith(b"good"):
            raise ValueError("half of it is missing")
        return data

    assert load_newest(store, "s", read, ValueError, told.append) == b"good 2"
    assert told == ["half of it is missing"]
    assert store.aside() == [("s", "half of it is missing", b"torn")]  # type: ignore[attr-defined]  # both have it
    assert store.load("s") == b"good 2"


def test_when_all_are_torn_there_is_none(make: Make) -> None:
    """A stream without a readable checkpoint begins anew."""
    store = make("")
    store.save({"s": b"torn"})
    assert load_newest(store, "s", int, ValueError, lambda _: None) is None
    assert store.streams() == ()


def test_what_is_kept_is_bounded(make: Make) -> None:
    """Two checkpoints per stream, and the newest of those set aside."""
    store = make("")
    for number in range(ASIDE + 10):
        store.save({"s": b"%d" % number})
        store.set_aside("s", "torn")
    assert len(store.aside()) == ASIDE  # type: ignore[attr-defined]  # both have it
    for number in range(5):
        store.save({"s": b"%d" % number})
    found = []
    while (data := store.load("s")) is not None:
        found.append(data)
        store.set_aside("s", "looked at")
    assert found == [b"4", b"3"]


def test_only_the_last_one_to_claim_a_stream_writes_it(make: Make) -> None:
    """A process that was frozen and wakes up cannot overwrite what its successor has saved."""
    one, other = make("one"), make("other")
    one.claim(["s", "t"])
    assert one.save({"s": b"1", "t": b"1"}) == frozenset()
    other.claim(["s"])
    other.save({"s": b"2"})
    assert one.save({"s": b"late", "t": b"3"}) == {"s"}
    assert (one.load("s"), one.load("t")) == (b"2", b"3")


def test_a_closed_store_says_so(tmp_path: Path) -> None:
    """After `close`, which may come twice, the one error is raised."""
    store = SqliteStore(tmp_path / "s")
    store.close()
    store.close()
    with pytest.raises(StoreError, match="closed"):
        store.save({"s": b"1"})


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    """A file of something else, or a folder that is not there, ends in one clear error."""
    (tmp_path / "text").write_text("no database " * 100, encoding="utf-8")
    with pytest.raises(StoreError, match="text"):
        SqliteStore(tmp_path / "text")
    with pytest.raises(StoreError, match="nowhere"):
        SqliteStore(tmp_path / "nowhere" / "s")


def test_a_full_disk_is_an_error_and_loses_nothing(tmp_path: Path) -> None:
    """When the file may not grow, saving fails as a whole, and what was there stays."""
    store = SqliteStore(tmp_path / "s")
    store.save({"a": b"1", "b": b"1"})
    store._connection.execute("PRAGMA max_page_count = 40")  # type: ignore[union-attr]  # it is open
    with pytest.raises(StoreError, match="full"):
        store.save({"a": b"2", "b": bytes(10**6)})
    assert (store.load("a"), store.load("b")) == (b"1", b"1")
    assert store.save({"a": b"3"}) == frozenset()


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_read_only_folder_is_an_error(tmp_path: Path) -> None:
    """So that the service can say that it is degraded."""
    tmp_path.chmod(0o500)
    with pytest.raises(StoreError):
        SqliteStore(tmp_path / "s")


KILLED = """
import os, sys
from pathlib import Path
from optipmb_service.cluster.store import SqliteStore
store = SqliteStore(Path(sys.argv[1]))
number = 0
while True:
    number += 1
    store.save({f"stream-{i}": b"%d" % number * 5000 for i in range(20)})
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
        child.wait()
        child.stdout.close()
        store = SqliteStore(tmp_path / "s")
        found = {store.load(stream) for stream in store.streams()}
        assert found in ({b"%d" % done * 5000}, {b"%d" % (done + 1) * 5000})
        for stream in store.streams():
            store.delete(stream)
        store.close()


def test_what_was_silent_for_long_expires(tmp_path: Path) -> None:
    """Checkpoints of which nothing was saved for an age go, with their owners; newer ones stay."""
    now = [1000.0]
    store = SqliteStore(tmp_path / "store.db", "one", lambda: now[0])
    store.claim(["a/b/old", "a/b/new"])
    store.save({"a/b/old": b"1", "a/b/new": b"1"})
    now[0] += 500
    store.save({"a/b/new": b"2"})
    now[0] += 600
    assert store.expire(1000.0) == 1
    assert (store.streams(), store.load("a/b/new")) == (("a/b/new",), b"2")
    store.close()
