"""How a Zenoh session comes about: the settings as Zenoh's configuration, a router, and one clear line for a failure.

Two settings of Zenoh's own that are not obvious:

- Implicit shared memory is off unless asked for: it loses messages when a receiver stalls, and leaves files behind.
- Messages wait 50 ms before congestion drops them (500 ms for large ones): with the defaults, large messages are lost
  whenever the machine is busy.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import optipmb_schemas as schemas
import structlog
import zenoh

from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh import key_numbers

if TYPE_CHECKING:
    from optipmb_service.settings import Settings

WAIT_BEFORE_DROP_US: Final = 50_000
WAIT_BEFORE_DROP_FRAGMENTS_US: Final = 500_000

WAIT_BEFORE_CLOSE_US: Final = 30_000_000
"""How long a client waits to declare something where its router is slow to read, before Zenoh closes the link.

Zenoh's own 5 s make it worse: all that was declared on the link is withdrawn, and declared again on the next one. A
router that does not answer at all is left when its lease ends.
"""

RETRY_MS: Final = {"period_init_ms": 100, "period_max_ms": 2000, "period_increase_factor": 2}

RUNTIME_VARIABLE: Final = "ZENOH_RUNTIME"
RUNTIME: Final = "(rx: (handover: app))"
"""A client has one link, and one thread that waits for its socket and reads it; after that was lost, Zenoh has two.

By default one thread waits and wakes one of two others to read: two more threads are woken for each message. What is
sent has a thread of its own, so a callback that waits for the lock of the interpreter keeps nothing from leaving.
"""

LISTENING: Final = "zenoh_listen"
"""Use of the certificate of a listener, which Zenoh reads at its start alone."""

MESSAGE_HEADROOM: Final = 4
"""A message up to this many times the limit is received and answered by a problem; a larger one is dropped by Zenoh."""


log = structlog.get_logger("optipmb_service")


def opened(settings: Settings) -> zenoh.Session:
    """Open a session; a client does not return before it has a router.

    Raises:
        TransportError: an endpoint is in use or unusable, or the file of the settings is.
    """
    config = _configuration(settings)
    # Read when the first session of a process opens; neither a later router nor a child is to find it.
    sets_runtime = not settings.is_router and RUNTIME_VARIABLE not in os.environ
    if sets_runtime:
        os.environ[RUNTIME_VARIABLE] = RUNTIME
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join((*settings.endpoints, *settings.connect))
        if "Address already in use" in str(error):
            reason = f"cannot listen on {where}: the address is in use; is another optipmb-service running?"
        else:
            reason = f"cannot open {where}: {line(error)}"
        raise TransportError(reason) from error
    finally:
        if sets_runtime:
            del os.environ[RUNTIME_VARIABLE]


def close(session: zenoh.Session) -> None:
    """Close a session, also one that is closed."""
    key_numbers.forget(session)
    with contextlib.suppress(zenoh.ZError):
        cast("Any", session).close()


def line(error: zenoh.ZError) -> str:
    """Return Zenoh's words without the places in its sources."""
    text = re.sub(r" at /\S+?:\d+\.?", "", str(error))
    return " ".join(text.split()).rstrip(".")[:300]


def log_link(event: zenoh.TransportEvent) -> None:
    """Log that a node or a router has linked to the session, or has gone."""
    came = event.kind == zenoh.SampleKind.PUT
    log.info(
        "peer_connected" if came else "peer_lost", peer=str(event.transport.zid), kind=str(event.transport.whatami)
    )


class Router:
    """A Zenoh router and nothing else.

    Args:
        settings: endpoints, and the file with everything else.

    Raises:
        TransportError: an endpoint is in use or unusable, or the file is.
    """

    def __init__(self, settings: Settings) -> None:
        self._session = opened(settings)

    def close(self) -> None:
        """Close the router; who is linked to it looks for another one."""
        close(self._session)


def _configuration(settings: Settings) -> zenoh.Config:
    values: dict[str, object] = {
        "mode": "router" if settings.is_router else "client",
        "listen/endpoints": list(settings.endpoints),
        "connect/endpoints": list(settings.connect),
        "connect/timeout_ms": -1,
        "connect/retry": RETRY_MS,
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": settings.shared_memory,
        "transport/link/tx/lease": round(settings.lease_s * 1e3),
        "transport/link/rx/max_message_size": MESSAGE_HEADROOM * settings.limits.max_bytes,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": WAIT_BEFORE_DROP_FRAGMENTS_US,
    }
    if settings.is_router:
        values["connect/exit_on_failure"] = False  # a router starts without the routers that it looks for
    else:
        values["transport/link/tx/queue/congestion_control/block/wait_before_close"] = WAIT_BEFORE_CLOSE_US
    config = _base(settings.zenoh_config)
    own = json.loads(config.get_json("id"))
    if own is not None and not settings.is_router:
        raise TransportError(
            f'Zenoh configuration {settings.zenoh_config}: id: expected none, received "{own}": nobody would hear the'
            " second run of a client with it; remove it"
        )
    # One interest in the subscribers of all tracks, and one in those of heartbeats, in place of two for each stream:
    # a router compares every subscription with all interests.
    tracks = schemas.Keys(settings.prefix).all("tracks")
    aggregated = json.loads(config.get_json("aggregation/publishers"))
    values["aggregation/publishers"] = [*aggregated, tracks, f"{tracks}/@adv/**"]
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise TransportError(f"setting {key}: {line(error)}") from error
    return config


def certificates_of(settings: Settings) -> dict[str, Path]:
    """Return the files of the certificates that the Zenoh configuration names, by their use.

    Raises:
        TransportError: the file of the configuration cannot be read.
    """
    config = _base(settings.zenoh_config)
    uses = {"zenoh": "connect_certificate", LISTENING: "listen_certificate", "zenoh_authority": "root_ca_certificate"}
    found = {use: json.loads(config.get_json(f"transport/link/tls/{name}")) for use, name in uses.items()}
    return {use: Path(file) for use, file in found.items() if file}


def _base(file: Path | None) -> zenoh.Config:
    """Return what the settings are laid over."""
    try:
        return zenoh.Config() if file is None else zenoh.Config.from_file(file)
    except (zenoh.ZError, OSError) as error:
        reason = line(error) if isinstance(error, zenoh.ZError) else str(error)
        raise TransportError(f"Zenoh configuration {file}: {reason}") from error
