"""The configuration of a Zenoh session: a file, and values over it."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import zenoh

from optipmb_client.errors import ConnectionFailed
from optipmb_client.zenoh.handles import reason

__all__ = ["BUSY", "certificates", "configured", "loaded"]

BUSY: Mapping[str, object] = MappingProxyType(
    {
        "scouting/multicast/enabled": False,
        # It loses messages without a word when a receiver stalls, and leaves files behind.
        "transport/shared_memory/enabled": False,
        # With the defaults (1 ms) large messages are lost whenever the machine is busy.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 50_000,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 500_000,
    }
)
"""Values for large messages on busy machines."""


def loaded(file: str | Path | None) -> zenoh.Config:
    """Return a configuration file, or Zenoh's defaults.

    Raises:
        ConnectionFailed: The file cannot be used.
    """
    try:
        return zenoh.Config() if file is None else zenoh.Config.from_file(file)
    except (zenoh.ZError, OSError) as error:
        why = reason(error) if isinstance(error, zenoh.ZError) else str(error)
        raise ConnectionFailed(f"Zenoh configuration {file}: {why}") from error


def configured(values: Mapping[str, object], file: str | Path | None = None, *, router: bool = False) -> zenoh.Config:
    """Return a configuration file, or Zenoh's defaults, with values over it.

    Raises:
        ConnectionFailed: The file or a value cannot be used, or the file gives an id to a session that is no router.
            Zenoh numbers the messages of a session, and drops repeated numbers of the same id.
    """
    config = loaded(file)
    own = json.loads(config.get_json("id"))
    if own is not None and not router:
        raise ConnectionFailed(
            f'Zenoh configuration {file}: id: expected none, received "{own}": nobody would hear the second run of this'
            " program, nor another one of that id; remove it"
        )
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConnectionFailed(f"setting {key}: {reason(error)}") from error
    return config


def certificates(config: zenoh.Config) -> dict[str, Path]:
    """Return the files of the certificates that a configuration names, by Zenoh's names."""
    names = ("connect_certificate", "listen_certificate", "root_ca_certificate")
    found = {name: json.loads(config.get_json(f"transport/link/tls/{name}")) for name in names}
    return {name: Path(file) for name, file in found.items() if file}
