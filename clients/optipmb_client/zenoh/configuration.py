"""The configuration of a Zenoh session: endpoints, a file, and values that suit large messages on busy machines."""

import json
import math
from pathlib import Path

import zenoh

from optipmb_client.errors import ConnectionFailed

__all__ = ["DEFAULT_ENDPOINT", "configuration"]

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
WAIT_BEFORE_DROP_US = 50_000  # with the defaults (1 ms) large messages are lost whenever the machine is busy
WAIT_BEFORE_DROP_FRAGMENTS_US = 500_000
LEASE_MS = 3000  # after so long a router takes a silent client for gone, and lets it in again; by default 10 s
CLOUD_BATCHES = 16  # of 64 kB on the way to the network: with the default of 2 sending a cloud takes four times as long


def configuration(endpoints: tuple[str, ...], config: str | Path | None, timeout: float) -> zenoh.Config:
    """Return what opens a session; arguments as for `Connection`.

    Raises:
        ConnectionFailed: An endpoint, the file or the timeout is unusable.
    """
    if not timeout >= 0:  # NaN is not
        raise ConnectionFailed(f"timeout: expected seconds, 0 or more, received {timeout!r}", endpoints=endpoints)
    try:
        settings = zenoh.Config() if config is None else zenoh.Config.from_file(config)
        own = json.loads(settings.get_json("id"))
        if config is None:
            values: dict[str, object] = {
                "mode": "client",
                "transport/link/tx/queue/size/data_low": CLOUD_BATCHES,
                "scouting/multicast/enabled": False,
                "transport/link/tx/lease": LEASE_MS,
                "transport/shared_memory/enabled": False,
                "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
                "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": (
                    WAIT_BEFORE_DROP_FRAGMENTS_US
                ),
            }
            for key, value in values.items():
                settings.insert_json5(key, json.dumps(value))
        if endpoints:
            settings.insert_json5("connect/endpoints", json.dumps(endpoints))
        settings.insert_json5("connect/timeout_ms", json.dumps(-1 if timeout == math.inf else int(timeout * 1e3)))
        retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
        settings.insert_json5("connect/retry", json.dumps(retry))
    except (zenoh.ZError, OSError) as error:
        if config is not None and not Path(config).is_file():
            raise ConnectionFailed(f"there is no Zenoh configuration file at {config}") from error
        where = " ".join([*endpoints, *([str(config)] if config else [])])
        raise ConnectionFailed(
            f"not a usable Zenoh endpoint or configuration: {where} (an endpoint looks like {DEFAULT_ENDPOINT})",
            endpoints=endpoints,
        ) from error
    if own is not None:  # Zenoh numbers what a session sends, and drops what comes again from a session of the same id
        raise ConnectionFailed(
            f'{config}: id: expected none, received "{own}": nobody would hear the second run of this program, nor'
            " another one of that id; remove it"
        )
    return settings
