"""The settings as Zenoh's configuration, and the session that they open.

Messages wait 50 ms before congestion drops them (500 ms for large ones): with Zenoh's defaults, large messages are lost
whenever the machine is busy. Implicit shared memory is off unless asked for.
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas
from optipmb_client.zenoh.configuration import BUSY, certificates, configured, loaded
from optipmb_client.zenoh.session import opened as open_session

from optipmb_service.stream.ports import TransportError

if TYPE_CHECKING:
    from pathlib import Path

    from optipmb_client.zenoh.session import Opened

    from optipmb_service.settings import Settings

WAIT_BEFORE_CLOSE_US: Final = 30_000_000
"""How long a client waits to declare something where its router is slow to read, before Zenoh closes the link.

Zenoh's own 5 s make it worse: all that was declared on the link is withdrawn, and declared again on the next one. A
router that does not answer at all is left when its lease ends.
"""

RETRY_MS: Final = {"period_init_ms": 100, "period_max_ms": 2000, "period_increase_factor": 2}

RUNTIME_VARIABLE: Final = "ZENOH_RUNTIME"
RUNTIME: Final = "(rx: (handover: app))"
"""A client has one link, and one thread that waits for its socket and reads it; after that was lost, Zenoh has two.

By default one thread waits and wakes one of two others to read: two more threads are woken for each message.
Sending has a thread of its own, so a callback that waits for the lock of the interpreter keeps nothing from leaving.
"""

LISTENING: Final = "zenoh_listen"
"""Use of the certificate of a listener, which Zenoh reads at its start alone."""

MESSAGE_HEADROOM: Final = 4
"""A message up to this many times the limit is received and answered by a problem; a larger one is dropped by Zenoh."""


def opened(settings: Settings) -> Opened:
    """Open a session; a client does not return before it has a router.

    Raises:
        TransportError: an endpoint is in use or unusable, or the file of the settings is.
    """
    config = configured(_values(settings), settings.zenoh_config, router=settings.is_router)
    # Read when the first session of a process opens; neither a later router nor a child is to find it.
    sets_runtime = not settings.is_router and RUNTIME_VARIABLE not in os.environ
    if sets_runtime:
        os.environ[RUNTIME_VARIABLE] = RUNTIME
    try:
        return open_session(config)
    except TransportError as error:
        where = ", ".join((*settings.endpoints, *settings.connect))
        if "Address already in use" in str(error):
            reason = f"cannot listen on {where}: the address is in use; is another optipmb-service running?"
        else:
            reason = f"cannot open {where}: {error}"
        raise TransportError(reason) from error
    finally:
        if sets_runtime:
            del os.environ[RUNTIME_VARIABLE]


def certificates_of(settings: Settings) -> dict[str, Path]:
    """Return the files of the certificates that the Zenoh configuration names, by their use.

    Raises:
        TransportError: the file of the configuration cannot be read.
    """
    uses = {"connect_certificate": "zenoh", "listen_certificate": LISTENING, "root_ca_certificate": "zenoh_authority"}
    return {uses[name]: file for name, file in certificates(loaded(settings.zenoh_config)).items()}


def _values(settings: Settings) -> dict[str, object]:
    values: dict[str, object] = {
        **BUSY,
        "mode": "router" if settings.is_router else "client",
        "listen/endpoints": list(settings.endpoints),
        "connect/endpoints": list(settings.connect),
        "connect/timeout_ms": -1,
        "connect/retry": RETRY_MS,
        "scouting/delay": 0,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": settings.shared_memory,
        "transport/link/tx/lease": round(settings.lease_s * 1e3),
        "transport/link/rx/max_message_size": MESSAGE_HEADROOM * settings.limits.max_bytes,
    }
    if settings.is_router:
        values["connect/exit_on_failure"] = False  # a router starts without the routers that it looks for
    else:
        values["transport/link/tx/queue/congestion_control/block/wait_before_close"] = WAIT_BEFORE_CLOSE_US
    # One interest in the subscribers of all tracks, and one in heartbeats, in place of two for each stream:
    # a router compares every subscription with all interests.
    tracks = schemas.Keys(settings.prefix).all("tracks")
    aggregated = json.loads(loaded(settings.zenoh_config).get_json("aggregation/publishers"))
    values["aggregation/publishers"] = [*aggregated, tracks, f"{tracks}/@adv/**"]
    return values
