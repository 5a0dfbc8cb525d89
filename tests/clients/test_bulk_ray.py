"""Recordings on Ray clusters: workers and a node that are killed, and the bytes of one process."""

import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bulk_tasks
import pytest
from bulk_tasks import RECORDINGS, Dying, bytes_of, recordings, tracked_plainly
from commands import optipmb
from optipmb_tools.datasets import DatasetArguments
from optipmb_tools.run.bulk import Executor, executor_for
from optipmb_tools.run.profiles import profile_for
from optipmb_tools.run.tracking import TrackedSequence, Tracking, track

pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings("default")]  # warnings of Ray are its own

BYTES = 100 * 2**20
"""Shared memory of a node."""
WAIT_S = 300.0
SCENE = ("--dataset", "scene", "--option", "frames=12", "--option", "clouds=0", "--sequences", "0000", "0001")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recordings(tmp_path_factory.mktemp("recordings"))


@pytest.fixture(scope="module")
def plain(data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return tracked_plainly(data, tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module", autouse=True)
def surroundings() -> Iterator[None]:
    """Workers find the tasks of the tests, and nothing is reported; Ray is imported by `make ray` alone."""
    pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(bulk_tasks.__file__).parent))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        yield


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head that takes no tasks, and two nodes of one processor."""
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as folder:  # sockets need a short path
        common = {"object_store_memory": BYTES, "temp_dir": folder}
        head = {"num_cpus": 0, "include_dashboard": False, "_system_config": {"health_check_period_ms": 1000}}
        with pytest.MonkeyPatch.context() as patch:  # the head notes its address in a folder that it does not make
            patch.setenv("RAY_TMPDIR", folder)
            (Path(folder) / "ray").mkdir()
            made = pytest.importorskip("ray.cluster_utils").Cluster(
                initialize_head=True, head_node_args={**common, **head}
            )
        for _ in range(2):
            made.add_node(num_cpus=1, **common)
        yield made
        made.shutdown()


def with_word(word: str) -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            text = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has ended
            continue
        if word in text:
            found.append(text)
    return found


def gone(word: str) -> bool:
    until = time.monotonic() + WAIT_S
    while with_word(word):
        if time.monotonic() > until:
            return False
        time.sleep(0.1)
    return True


def tracked(data: Path, out: Path, executor: Executor) -> list[TrackedSequence]:
    asked = DatasetArguments("table", data)
    opened = asked.open()
    sequences = opened.sequences(["all"])
    parameters = profile_for("kitti", sequences)
    return list(track(opened, sequences, out, Tracking(parameters), executor=executor))


def test_killed_workers_of_a_local_cluster_lose_nothing(data: Path, plain: dict[str, bytes], tmp_path: Path) -> None:
    """Of 200 recordings, two workers killed in the middle of one, come the bytes of one process; nothing is left."""
    from ray._common.usage.usage_lib import usage_stats_enabled  # noqa: PLC0415  there is no public way to ask

    with executor_for(2, "local") as executor:
        folder = Path(executor._folder.name)  # type: ignore[attr-defined]  # of Ray's logs and sockets
        assert with_word(str(folder))
        assert not usage_stats_enabled()
        results = tracked(data, tmp_path / "out", Dying(executor, tmp_path, {"r004", "r012"}))
    assert len(results) == RECORDINGS
    assert bytes_of(tmp_path / "out") == plain
    assert len(list(tmp_path.glob("*.begun"))) == 2
    assert not folder.exists()
    assert gone(str(folder))


def test_commands_give_what_one_process_gives(cluster: Any, tmp_path: Path) -> None:
    """`track`, `evaluate` and `tune` with `--ray ADDRESS` write and print the same as in one process."""
    few = ("--trials", "2", "--folds", "0", "--profile", "kitti-paper", "--classes", "Car")
    for name, options in (("plain", ()), ("ray", ("--ray", cluster.address))):
        for out in (tmp_path / name / "files", tmp_path / name / "t.csv"):
            done = optipmb("track", *options, *SCENE, "--full", "--out", out)
            assert done.returncode == 0, done.stderr
        done = optipmb("evaluate", *SCENE, "--tracks", tmp_path / name / "files", *options)
        assert done.returncode == 0, done.stderr
        (tmp_path / name / "evaluation").write_text(done.stdout)
        done = optipmb("tune", *SCENE, *few, "--out", tmp_path / name / "tuned", *options)
        assert done.returncode == 0, done.stderr
        (tmp_path / name / "tuned" / "trials.db").unlink()  # it holds times
    one, other = bytes_of(tmp_path / "plain"), bytes_of(tmp_path / "ray")
    assert set(one) >= {"files/0000.txt", "files/0001.npz", "t.csv", "evaluation", "tuned/tuned.toml"}
    assert one == other


def test_a_killed_node_loses_nothing(cluster: Any, data: Path, plain: dict[str, bytes], tmp_path: Path) -> None:
    """With a node and a worker killed during recordings, results equal one process byte for byte."""
    mark = tmp_path / "r008.begun"
    victims: list[str] = []

    def kill() -> None:
        until = time.monotonic() + WAIT_S
        while not (mark.exists() and mark.read_text()) and time.monotonic() < until:
            time.sleep(0.05)
        (node,) = (one for one in cluster.worker_nodes if one.node_id == mark.read_text())
        victims.append(node.node_id)
        raylet = node.all_processes["raylet"][0].process
        raylet.kill()
        raylet.wait(60)  # its workers end when it is gone, and a zombie is not

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    with executor_for(0, cluster.address) as executor:
        results = tracked(data, tmp_path / "out", Dying(executor, tmp_path, {"r004"}, {"r008"}))
    killer.join(60)
    assert len(victims) == 1
    assert len(results) == RECORDINGS
    assert bytes_of(tmp_path / "out") == plain


def test_no_cluster_is_said() -> None:
    """An address at which no cluster answers is one line, and the status is 1."""
    done = optipmb("track", *SCENE, "--ray", "127.0.0.1:1")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("optipmb: --ray 127.0.0.1:1: ")
