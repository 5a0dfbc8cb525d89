"""Zenoh routers and plain clients inside the test's own process, for tests that need a network and no service."""

import fcntl
import json
import os
import socket
import tempfile
from pathlib import Path
from typing import Final

import zenoh

PORTS: Final = range(10_000, 20_000)
"""Below those that the system gives to outgoing connections, and to whom asks for any: these are nobody's by chance."""

_taken: set[int] = set()
"""The ports that this process was given."""

_locks = (Path(tempfile.gettempdir()) / f"optipmb-test-ports-{os.getuid()}").open("ab")
"""The byte at the number of a port is locked by the process that was given the port, until that ends."""


def free_endpoint() -> str:
    """A free endpoint on the loopback interface, which no other test gets before this process ends."""
    first = os.getpid() * 61 + len(_taken)
    for number in range(len(PORTS)):
        port = PORTS[(first + number) % len(PORTS)]
        if port in _taken:
            continue
        try:
            fcntl.lockf(_locks, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, port)
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # whose connections are closing is free
                probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        _taken.add(port)
        return f"tcp/127.0.0.1:{port}"
    raise AssertionError("no port is free")


def open_router(endpoint: str, *others: str, adminspace: bool = False) -> zenoh.Session:
    """A router that listens at `endpoint`, linked to others; close it (it is a context manager)."""
    values: dict[str, object] = {"mode": "router", "listen/endpoints": [endpoint], "connect/endpoints": list(others)}
    # Half a second, in which routers find others; without others there is nothing to wait for.
    delay: dict[str, object] = {} if others else {"scouting/delay": 0}
    return _open(values | delay | {"adminspace/enabled": adminspace})


def open_client(endpoint: str) -> zenoh.Session:
    return _open({"mode": "client", "connect/endpoints": [endpoint]})


def _open(values: dict[str, object]) -> zenoh.Session:
    config = zenoh.Config()
    drop = "transport/link/tx/queue/congestion_control/drop"
    always = {
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        # As patient as the product: by default a busy machine drops a large message after a millisecond.
        f"{drop}/wait_before_drop": 1_000_000,
        f"{drop}/max_wait_before_drop_fragments": 5_000_000,
    }
    for key, value in (values | always).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
