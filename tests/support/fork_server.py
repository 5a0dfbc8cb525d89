"""A process that has imported service and client and loaded the kernels, and forks for each start asked of it.

Run by `forked`, as `fork_server.py FD`. An order comes as one packet with the three files that the new process is to
have. The packet is JSON: the module that is run and its words, the environment, the folder. The answer is the number
of the new process. That one is forked twice, so that it has no parent here; whoever asked takes it as a child of its
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
from pathlib import Path
from typing import Any

LARGEST = 1 << 18
FILES = 3
TASKS = Path("/proc/self/task")


def load() -> None:
    """Import what a service imports until it is ready, as it does, and the client; load the kernels."""
    from optipmb_service.app.collector import collector_paused  # noqa: PLC0415 - as the command does it
    from optipmb_service.app.optional import without  # noqa: PLC0415

    with collector_paused(), without("rich"):
        from optipmb_service.app import cli, worker  # noqa: F401, PLC0415
        from optipmb_service.http import page  # noqa: F401, PLC0415
    with suppress(ModuleNotFoundError):  # an extra that not all tests need
        from optipmb_service.cluster import jetstream  # noqa: F401, PLC0415
    from optipmb_service.app.kernels import warm_up  # noqa: PLC0415

    warm_up()
    import optipmb_client.cli  # noqa: F401, PLC0415 - after the service, which does without rich

    gc.collect()
    gc.freeze()


def serve(asking: socket.socket) -> str:
    """Fork for every order, until nobody is there to give one; returns in a new process: what it is to run."""
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
        os.waitpid(between, 0)  # before the answer: from here on the new process belongs to whoever asked
        asking.send(os.read(reading, 32))
        for one in (reading, *files):
            os.close(one)


def become(order: dict[str, Any], files: list[int]) -> str:
    """Take over files, environment, folder and words of the order; returns its module."""
    for number, one in enumerate(files):
        os.dup2(one, number)
        os.close(one)
    os.environ.clear()
    os.environ.update(order["environment"])
    os.chdir(order["folder"])
    sys.path[0] = order["folder"]
    module, *sys.argv[1:] = order["words"]
    return str(module)


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as asking_here:
        load()
        asking_here.send(str(len(list(TASKS.iterdir()))).encode())
        run_here = serve(asking_here)
    runpy.run_module(run_here, run_name="__main__", alter_sys=True)
