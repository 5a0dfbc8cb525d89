"""Zenoh routers and plain clients inside the test's own process, for tests that need a network and no service."""

import json
import socket

import zenoh


def free_endpoint() -> str:
    """An endpoint on the loopback interface where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def open_router(endpoint: str) -> zenoh.Session:
    """A router that listens at `endpoint`; close it (it is a context manager)."""
    return _open({"mode": "router", "listen/endpoints": [endpoint]})


def open_client(endpoint: str) -> zenoh.Session:
    """A plain Zenoh client of the router at `endpoint`; close it (it is a context manager)."""
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
