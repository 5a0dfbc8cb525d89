"""A process that has imported service and client and loaded the kernels, and forks for each start asked of it.

Run by `forked`, as `fork_server.py FD`. A request comes as one packet with the three files that the new process is to
have. The packet is JSON: the module that is run and its words, the environment, the folder. The answer is the number
of the new process. That one is forked twice, so that it has no parent here; the caller takes it as a child of its
own.
"""

from __future__ import annotations

import gc
import json
import os
import runpy
import socket
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

LARGEST = 1 << 18
FILES = 3
SERVICE = ("optipmb_service.app.cli", "optipmb_service.app.worker", "optipmb_service.edges.http.page")
TASKS = Path("/proc/self/task")


def load() -> None:
    """Import what a service imports until it is ready, as it does, and the client; load the kernels."""
    for name in SERVICE:
        import_module(name)
    with suppress(ModuleNotFoundError):  # an extra that not all tests need
        import_module("optipmb_service.cluster.jetstream")
    import_module("optipmb_service.app.worker").warm_up()
    import_module("optipmb_tools.cli")
    gc.collect()
    gc.freeze()


def serve(asking: socket.socket) -> str:
    """Fork for every request until the socket closes; return in the new process the module to run."""
    while True:
        packet, files, _, _ = socket.recv_fds(asking, LARGEST, FILES)
        if not packet:
            os._exit(0)
        reading, writing = os.pipe()
        between = os.fork()
        if between == 0:
            child = os.fork()
            if child == 0:
                os.close(reading)
                os.close(writing)
                asking.close()
                return become(json.loads(packet), files)
            os.write(writing, str(child).encode())
            os._exit(0)
        os.close(writing)
        os.waitpid(between, 0)  # before the answer: from here on the new process belongs to the caller
        asking.send(os.read(reading, 32))
        for one in (reading, *files):
            os.close(one)


def become(request: dict[str, Any], files: list[int]) -> str:
    """Take over files, environment, folder and words of the request, as a new interpreter does; returns its module."""
    for number, one in enumerate(files):
        os.dup2(one, number)
        os.close(one)
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:1] = [request["folder"], *filter(None, paths)]
    sys.modules.pop("sitecustomize", None)
    with suppress(ModuleNotFoundError):
        import_module("sitecustomize")
    module, *sys.argv[1:] = request["words"]
    return str(module)


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as asking_here:
        load()
        asking_here.send(str(len(list(TASKS.iterdir()))).encode())
        run_here = serve(asking_here)
    runpy.run_module(run_here, run_name="__main__", alter_sys=True)
