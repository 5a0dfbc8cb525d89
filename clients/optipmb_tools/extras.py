"""Which extra of the installation brings a package, and the command that installs it."""

import importlib.util
from collections.abc import Mapping
from typing import Final

from optipmb_client.errors import ClientError
from optipmb_schemas.installation import install_command

_EXTRAS: Final[Mapping[str, str]] = {
    "client": "zenoh typer rich",
    "service": "prometheus_client pydantic_settings starlette structlog uvicorn",
    "evaluation": "scipy",
    "tune": "optuna",
    "plot": "matplotlib",
    "table": "pyarrow",
    "ray": "ray",
    "record": "mcap foxglove",
    "ros2": "rosbags",
    "watch": "rerun",
}
_EXTRA_OF: Final = {package: extra for extra, packages in _EXTRAS.items() for package in packages.split()}


def to_install(package: str, what: str = "this") -> str | None:
    """Return the line that says how to install a package that is missing; None for one that no extra brings."""
    extra = _EXTRA_OF.get(package.partition(".")[0])
    return None if extra is None else f"{what} needs {package}, which is not installed: {install_command(extra)}"


def needed(what: str, extra: str, *packages: str, need: str = "needs") -> None:
    """Raise where packages of extras are missing, before anything else is done; name them all.

    Raises:
        ClientError: with the command that installs the extras.
    """
    if missing := [package for package in packages if importlib.util.find_spec(package) is None]:
        verb = "are" if len(missing) > 1 else "is"
        raise ClientError(f"{what} {need} {', '.join(missing)}, which {verb} not installed: {install_command(extra)}")
