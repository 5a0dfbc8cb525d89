"""Options of the commands that talk to a service."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from optipmb_client.zenoh import DEFAULT_ENDPOINT, Connection
from optipmb_schemas import PREFIX

from optipmb_tools.run.replay import ReplayPace

Speed = Annotated[
    str, typer.Option("--speed", help="1: as recorded, 10: ten times as fast, max: as fast as tracks come back.")
]


@dataclass(frozen=True, kw_only=True)
class PaceOptions:
    """Options of how fast frames are sent."""

    speed: Speed = "max"
    window: Annotated[int, typer.Option("--window", min=1, help="Frames under way at most, with --speed max.")] = 8
    wait: Annotated[float, typer.Option("--wait", min=0.0, help="Seconds to wait for a service at the start.")] = 10.0
    patience: Annotated[
        float, typer.Option("--patience", min=1.0, help="End when no tracks come for so many seconds.")
    ] = 30.0

    def pace(self) -> ReplayPace:
        return ReplayPace(speed_of(self.speed), self.window, self.patience, self.wait)


def _endpoints(given: list[str] | None) -> list[str] | None:
    """Split endpoints at commas, as the service reads them from the same variable."""
    return [one for text in given for one in text.split(",")] if given else given


@dataclass(frozen=True, kw_only=True)
class ServiceOptions:
    """Options of the connection to a service."""

    connect: Annotated[
        list[str] | None,
        typer.Option(
            "--connect",
            metavar="ENDPOINT",
            envvar="OPTIPMB_CONNECT",
            callback=_endpoints,
            help=f"Router or service, several times for several; default: {DEFAULT_ENDPOINT}, or what --config says.",
            show_default=False,
        ),
    ] = None
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", envvar="OPTIPMB_ZENOH_CONFIG", help="Zenoh configuration file, for TLS and passwords."
        ),
    ] = None
    prefix: Annotated[
        str, typer.Option("--prefix", envvar="OPTIPMB_PREFIX", help="First part of all keys, as the service has it.")
    ] = PREFIX

    def connection(self, timeout: float = 5.0) -> Connection:
        """Return a connection over Zenoh."""
        return Connection(self.connect, config=self.config, timeout=timeout)


def speed_of(text: str) -> float | None:
    """Return the multiple of the recorded rate that an option asks for; None for `max`."""
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.0 < speed < float("inf"):
        raise typer.BadParameter(f"a positive number, or max, received {text!r}", param_hint="--speed")
    return speed
