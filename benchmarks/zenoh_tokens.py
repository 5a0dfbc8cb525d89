"""A token that was withdrawn while a link was set up stays at the router of Zenoh (1.10.2, Python and Rust).

When a client gets a new link, Zenoh collects all that is declared under the lock of its tables, releases the lock, and
then sends the declarations. What another thread undeclares in between is sent at once, and overtakes its declaration.
The router takes the withdrawal for one of an unknown id, then keeps the token until that link ends. This restarts a
router and withdraws tokens meanwhile; four runs printed `3 of 11`, `5 of 6`, `40 of 47` and `5 of 11` tokens that stay.
Expected: 0. Remedy: send what is collected under the lock in an order of its own, or remember an id that was withdrawn
before it was declared.

    python benchmarks/zenoh_tokens.py
"""

import json
import subprocess
import sys
import threading
import time
from typing import Any

import zenoh

WHERE, PUT = "tcp/127.0.0.1:17447", zenoh.SampleKind.PUT


def opened(mode: str, **values: Any) -> zenoh.Session:
    """Open a session without scouting."""
    config = zenoh.Config()
    for key, value in ({"mode": mode, "scouting/multicast/enabled": False} | values).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def start() -> "subprocess.Popen[bytes]":
    """Start this file as a router."""
    router = subprocess.Popen([sys.executable, __file__, "router"], stdin=subprocess.PIPE)  # noqa: S603 - this file
    time.sleep(1)
    return router


def tokens_at_router() -> set[str]:
    """Return the keys of the tokens that the router has."""
    found: list[Any] = []
    ended = threading.Event()
    with opened("client", **{"connect/endpoints": [WHERE]}) as other:
        other.liveliness().get("t/*", zenoh.handlers.Callback(found.append, ended.set, indirect=False))
        ended.wait(10)
    return {str(reply.ok.key_expr) for reply in found if reply.ok}


if "router" in sys.argv:
    with opened("router", **{"listen/endpoints": [WHERE]}):
        sys.stdin.read()
    sys.exit()

router = start()
client = opened("client", **{"connect/endpoints": [WHERE], "connect/timeout_ms": -1})
tokens = [(f"t/{n}", client.liveliness().declare_token(f"t/{n}")) for n in range(2000)]
began, ended = threading.Event(), threading.Event()
withdrawn: set[str] = set()
listeners = (
    client.info.declare_transport_events_listener(
        zenoh.handlers.Callback(lambda event: event.kind == PUT and began.set(), indirect=False)
    ),
    client.info.declare_link_events_listener(
        zenoh.handlers.Callback(lambda event: event.kind == PUT and ended.set(), indirect=False)
    ),
)


def withdraw() -> None:
    """Withdraw tokens from the first sign of the transport until that of the link."""
    began.wait()
    while tokens and not ended.wait(1e-5):
        key, token = tokens.pop(0)
        token.undeclare()
        withdrawn.add(key)


router.kill()
thread = threading.Thread(target=withdraw)
thread.start()
router = start()
thread.join()
time.sleep(5)
print(len(withdrawn & tokens_at_router()), "of", len(withdrawn), "withdrawn tokens stay")  # noqa: T201 - a command
router.kill()
client.close()
