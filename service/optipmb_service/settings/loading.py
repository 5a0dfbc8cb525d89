"""Where settings come from: a TOML file, over it the environment, over that the options of the command line.

Environment variables are ``OPTIPMB_`` and the name in capitals, nested names after ``__``
(``OPTIPMB_LIMITS__MAX_BYTES``); lists are written with commas there, tables as JSON.
"""

from __future__ import annotations

import os
import re
import tomllib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import BaseModel, ValidationError
from pydantic_settings import EnvSettingsSource, SettingsError

from optipmb_service.settings.model import PREFIX, Settings

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

Source = Literal["option", "environment", "file", "default"]

TABLES: Final = frozenset(
    name
    for name, field in Settings.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
)
"""The settings that are tables of settings and merged name by name; `profiles` is one value, whose order matters."""


class SettingsInvalidError(ValueError):
    """The settings cannot be used; the text is one clear line."""


@dataclass(frozen=True)
class Loaded:
    """Settings and, for every one of them, where its value came from."""

    settings: Settings
    sources: dict[str, Source]
    unknown: tuple[str, ...] = ()
    """Environment variables that look like settings and are none."""


def load(
    file: Path | None = None, options: Mapping[str, Any] | None = None, defaults: Mapping[str, Any] | None = None
) -> Loaded:
    """Merge the defaults of a command, the file, the environment and the options (None: not given); check the result.

    Raises:
        SettingsInvalidError: the file cannot be read, or a value is not allowed.
    """
    layers: list[tuple[Source, dict[str, Any]]] = [
        ("default", dict(defaults or {})),
        ("file", _read(file) if file is not None else {}),
        ("environment", _environment()),
        ("option", {name: value for name, value in (options or {}).items() if value is not None}),
    ]
    values: dict[str, Any] = {}
    sources: dict[str, Source] = dict.fromkeys(Settings.model_fields, "default")
    for source, layer in layers:
        for name, value in layer.items():
            old = values.get(name)
            if name in TABLES and isinstance(old, dict) and isinstance(value, dict):
                values[name] = {**old, **value}
            else:
                values[name] = value
            sources[name] = source
    try:
        settings = Settings(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        path = ".".join(str(part) for part in first["loc"]) or "settings"
        source = sources.get(str(first["loc"][0]) if first["loc"] else "", "default")
        where = f" (from the {source})" if source != "default" else ""
        message = first["msg"].removeprefix("Value error, ")
        raise SettingsInvalidError(f"setting {path}{where}: {message}") from error
    if not settings.endpoints and not settings.connect:
        raise SettingsInvalidError("setting listen: neither an endpoint to listen on nor one to connect to")
    if settings.fuse and not settings.rewind_s:
        raise SettingsInvalidError("setting fuse: sensors do not come in order of their stamps: rewind_s must not be 0")
    _check_cluster(settings)
    if settings.workers > 1 and settings.zenoh_config is not None and settings.is_router:
        # Its access control would be deaf to the workers, which come over a socket and without a certificate.
        raise SettingsInvalidError(
            "setting workers: with zenoh_config, a router of its own: start `optipmb-service router` and connect to it"
        )
    known = {f"{PREFIX}{name.upper()}" for name in Settings.model_fields}
    unknown = (name for name in os.environ if name.startswith(PREFIX) and name.split("__")[0] not in known)
    return Loaded(settings, sources, tuple(sorted(unknown)))


def _check_cluster(settings: Settings) -> None:
    """Refuse files for NATS servers that are not there or not used.

    Raises:
        SettingsInvalidError: there are such.
    """
    folder, file = settings.cluster_tls, settings.cluster_credentials
    for name, value in (("cluster_tls", folder), ("cluster_credentials", file)):
        if value is not None and not settings.cluster:
            raise SettingsInvalidError(f"setting {name}: without servers in `cluster`")
    if folder is not None:
        if any(not server.startswith("tls://") for server in settings.cluster):
            raise SettingsInvalidError("setting cluster_tls: servers in `cluster` as tls://host:4222 expected")
        if not (folder / "ca.pem").is_file():
            raise SettingsInvalidError(f"setting cluster_tls: {folder}: no file ca.pem in it")
        if (folder / "cert.pem").is_file() is not (folder / "key.pem").is_file():
            raise SettingsInvalidError(f"setting cluster_tls: {folder}: cert.pem and key.pem belong together")
    if file is not None and not file.is_file():
        raise SettingsInvalidError(f"setting cluster_credentials: {file}: no such file")


def _read(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8"
        raise SettingsInvalidError(f"settings file {file}: {reason}") from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsInvalidError(f"settings file {file}: not TOML: {error}") from error


def _environment() -> dict[str, Any]:
    try:
        return EnvSettingsSource(Settings)()
    except SettingsError as error:
        match = re.search(r'field "(\w+)"', str(error))
        name = f"{PREFIX}{match[1].upper()}" if match else "environment"
        example = '{"site/*/*": "kitti"}'
        raise SettingsInvalidError(f"{name}: tables are written as JSON, as '{example}'") from error
