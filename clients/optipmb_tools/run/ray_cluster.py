"""Tasks on a Ray cluster: the one module that imports Ray.

Ray places tasks, and repeats those whose worker or node is gone. Values come back as bytes, so that their arrays are
not in shared memory. All nodes must have this package in this version, and see data and results under the same paths.
"""

import os
import pickle
import signal
import socket
import tempfile
import threading
from concurrent.futures import Future
from importlib.metadata import version
from pathlib import Path
from typing import Any

import ray
from optipmb_client.errors import ClientError
from ray.exceptions import RayError, RayTaskError

from optipmb_tools.run.bulk import ATTEMPTS, Executor, Failed, Function, WorkerDiedError, attempt, processors

LOCAL = "local"  # the address of a cluster that is started here and ends with the command
STORE_BYTES = 256 * 2**20  # shared memory of a local cluster; the rest is written to disk
WAITING = 2  # tasks submitted for each processor: one runs, the next is there when it ends
PATIENCE_S = 10.0  # for the connection to a head


class RayCluster(Executor):
    """A Ray cluster.

    Args:
        address: Of its head, `auto` for the one of this machine, or `local` for one that is started here.
        jobs: Tasks at once; 0: as many as the cluster has processors.

    Raises:
        ClientError: No cluster answers there.
    """

    attempts = 1  # Ray repeats them

    def __init__(self, address: str, jobs: int = 0) -> None:
        self._jobs = jobs
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        options: dict[str, Any] = {"address": address}
        if address == LOCAL:
            os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
            self._folder = tempfile.TemporaryDirectory(prefix="optipmb-ray-", ignore_cleanup_errors=True)
            options |= {
                "num_cpus": jobs or processors(),
                "object_store_memory": STORE_BYTES,
                "include_dashboard": False,
                "_node_ip_address": "127.0.0.1",  # nothing listens to other machines
                "_temp_dir": self._folder.name,
                "_system_config": {"task_oom_retries": ATTEMPTS - 1},  # without end by default
            }
        else:
            _answers(address)
        handler = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(**options, log_to_driver=False, logging_level="error")
        except Exception as error:  # Ray raises many kinds, plain exceptions among them
            self._cleanup()
            raise ClientError(f"--ray {address}: {error}") from error
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)  # Ray has put its own in the place of the command's

    @property
    def width(self) -> int:  # type: ignore[override]  # read-only
        """Tasks at once; a cluster may grow and shrink."""
        return self._jobs or max(1, WAITING * int(ray.cluster_resources().get("CPU", 1)))

    def start(self, function: Function, shared: Any) -> None:
        """Bring the call to the cluster, once for all tasks."""
        self._call = ray.put(pickle.dumps((function, shared), pickle.HIGHEST_PROTOCOL))
        self._task = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(_run)

    def submit(self, task: Any) -> Future[Any]:
        future: Future[Any] = self._task.remote([self._call], str(Path.cwd()), version("optipmb"), task).future()
        return future

    def take(self, future: Future[Any]) -> Any:
        """Unpack the value, which is there; a task whose cluster is gone has an error of Ray's."""
        try:
            return pickle.loads(future.result())  # noqa: S301  our own task wrote it
        except RayTaskError as error:  # before or after the task: this package is not there, or is another
            return Failed(f"on a node of Ray: {str(error).strip().splitlines()[-1]}")
        except RayError as error:
            raise WorkerDiedError(f"Ray has given up after {ATTEMPTS} attempts ({type(error).__name__})") from error

    def __exit__(self, *_: object) -> None:
        ray.shutdown()
        self._cleanup()

    def _cleanup(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()


def _answers(address: str) -> None:
    """Raise where nothing listens: Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or "/" in host:
        if address == "auto":
            return
        raise ClientError(f"--ray {address}: expected HOST:PORT of the head of a Ray cluster, or auto")
    try:
        socket.create_connection((host.strip("[]"), int(port)), PATIENCE_S).close()
    except OSError as error:
        raise ClientError(f"--ray {address}: no Ray cluster answers ({error.strerror or error})") from error


_held: tuple[str, tuple[Function, Any]] | None = None


def _run(call: list[Any], folder: str, wanted: str, task: Any) -> bytes:
    """Run a task in a worker of Ray, which keeps the call for the next one."""
    global _held  # noqa: PLW0603  a worker has no other place to keep anything
    if version("optipmb") != wanted:
        raise RuntimeError(f"optipmb {version('optipmb')} is installed there, here it is {wanted}")
    os.chdir(folder)  # relative paths are the caller's
    (reference,) = call
    if _held is None or _held[0] != reference.hex():
        _held = None
        _held = reference.hex(), pickle.loads(ray.get(reference))  # noqa: S301  the caller wrote it
    return pickle.dumps(attempt(*_held[1], task), pickle.HIGHEST_PROTOCOL)
