"""Values of the settings, and checks of settings that depend on each other.

A TOML file, over it the environment, over that the options of the command line. Environment variables are ``OPTIPMB_``
and the name in capitals, nested names after ``__`` (``OPTIPMB_LIMITS__MAX_BYTES``); lists are written with commas
there, tables as JSON.
"""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from optipmb_schemas import Keys, MessageError
from pydantic import BaseModel, ValidationError
from pydantic_settings import EnvSettingsSource, SettingsError

from optipmb_service.settings import MOST_ZONES, PREFIX, Settings, overlap, without_password

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from optipmb_service.settings import MqttInput

Source = Literal["option", "environment", "file", "default"]

TABLES: Final = frozenset(
    name
    for name, field in Settings.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
)
"""The settings that are tables of settings and merged name by name; `profiles` is one value, whose order matters."""


FILES: Final = tuple(name for name, field in Settings.model_fields.items() if field.annotation == Path | None)
"""The settings that are files or folders."""


class SettingsInvalidError(ValueError):
    """The settings cannot be used; the text is one clear line."""


@dataclass(frozen=True)
class Loaded:
    """Settings and, for every one of them, where its value came from."""

    settings: Settings
    sources: dict[str, Source]
    unknown: tuple[str, ...] = ()
    """Environment variables that look like settings and are none, with the ones that may have been meant."""


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
        if first["type"] == "extra_forbidden":
            message = f"unknown setting{_near(first['loc'])}"
        elif isinstance(first["input"], str | int | float):
            message = f"{message[:1].lower()}{message[1:]}; received {first['input']!r}"
        raise SettingsInvalidError(f"setting {path}{where}: {without_password(message)}") from error
    if not settings.endpoints and not settings.connect:
        raise SettingsInvalidError("setting listen: neither an endpoint to listen on nor one to connect to")
    if settings.fuse and not settings.rewind_s:
        raise SettingsInvalidError("setting fuse: sensors do not come in order of their stamps: rewind_s must not be 0")
    _check_tokens(settings)
    _check_patterns(settings)
    _check_fused(settings)
    _check_names(settings)
    _check_cluster(settings)
    _check_zones(settings)
    _check_formats(settings)
    _check_mqtt(settings)
    if settings.workers > 1 and settings.zenoh_config is not None and settings.is_router:
        # Its access control would be deaf to the workers, which come over a socket and without a certificate.
        raise SettingsInvalidError(
            "setting workers: with zenoh_config, a router of its own: start `optipmb-service router` and connect to it"
        )
    known = {f"{PREFIX}{name.upper()}" for name in Settings.model_fields} | {f"{PREFIX}COMPILE_PROCESSES"}  # tracker's
    unknown = sorted(name for name in os.environ if name.startswith(PREFIX) and name.split("__")[0] not in known)
    return Loaded(settings, sources, tuple(f"{name}{_near_variable(name)}" for name in unknown))


def missing_files(settings: Settings) -> list[str]:
    """Return a text for each file and folder that the settings name and that is not there."""
    named: dict[str, Any] = {name: getattr(settings, name) for name in FILES}
    named |= {"profile": settings.profile} | {f"profiles.{key}": value for key, value in settings.profiles.items()}
    named |= {f"sensors.{key}.profile": one.profile for key, one in settings.sensors.items()}
    named |= {f"inputs.{key}.camera": str(one.camera) for key, one in settings.inputs.items() if one.camera}
    return [
        f"setting {name}: {value}: no such file"
        for name, value in named.items()
        if value is not None and (name in FILES or value.endswith(".toml")) and not Path(value).exists()
    ]


def _near_variable(name: str) -> str:
    near = _near((name.removeprefix(PREFIX).lower().partition("__")[0],))
    return near and f"; did you mean {PREFIX}{near.rpartition(' ')[2].upper()}"


def _near(place: tuple[int | str, ...]) -> str:
    """Return the setting whose name is like an unknown one, as a question; nothing where there is none."""
    field = Settings.model_fields.get(str(place[0])) if len(place) > 1 else None
    table: Any = Settings if field is None else field.annotation
    near = difflib.get_close_matches(str(place[-1]), getattr(table, "model_fields", ()), 1)
    return f"; did you mean {near[0]}?" if near else ""


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


def _check_tokens(settings: Settings) -> None:
    """Refuse settings of tokens that are there and empty, as of a variable of a shell that is not set.

    Raises:
        SettingsInvalidError: there is one.
    """
    for name in ("http_tokens", "grpc_tokens"):
        if name in settings.model_fields_set and not getattr(settings, name):
            raise SettingsInvalidError(f"setting {name}: expected tokens, received nothing; leave it out to have none")


def _check_patterns(settings: Settings) -> None:
    """Refuse patterns of which an earlier one matches all: the first match applies.

    Raises:
        SettingsInvalidError: there are such.
    """
    for name in ("profiles", "sensors", "outputs", "inputs", "rejoin", "cpm"):
        patterns = list(getattr(settings, name))
        for number, pattern in enumerate(patterns):
            if before := next((one for one in patterns[:number] if fnmatchcase(pattern, one)), None):
                reason = f"never applies, for {before} is before it and matches all of it: put the narrower one first"
                raise SettingsInvalidError(f"setting {name}.{pattern}: {reason}")


def _check_fused(settings: Settings) -> None:
    """Refuse streams that would feed two sessions, and streams of a node with the name of the sessions.

    Raises:
        SettingsInvalidError: there are such.
    """
    if settings.fused and not settings.rewind_s:
        raise SettingsInvalidError(
            "setting fused: sensors do not come in order of their stamps: rewind_s must not be 0"
        )
    sessions = [(f"fused.{name}.streams", one.streams) for name, one in settings.fused.items()]
    others = [("fuse", settings.fuse)] if settings.fuse else []
    for number, (path, patterns) in enumerate(sessions):
        if node := next((one for one in patterns if one.split("/")[1] == "fused"), ""):
            raise SettingsInvalidError(f"setting {path}: no node is named fused, received {node}")
        for other, theirs in (*sessions[:number], *others):
            both = next(((one, two) for one in patterns for two in theirs if overlap(one, two)), None)
            if both is not None:
                streams = f"a stream feeds one session, {both[0]} and {both[1]} of {other} have some in common"
                raise SettingsInvalidError(f"setting {path}: {streams}")


def _check_names(settings: Settings) -> None:
    """Refuse sensors that have the name of a fused session.

    Raises:
        SettingsInvalidError: a setting names one.
    """
    named: dict[str, Iterable[str]] = {"fuse": settings.fuse, "inputs": settings.inputs}
    named["ros2.streams"] = settings.ros2.streams
    named["mqtt.inputs"] = [re.sub(r"\{\d\}", "*", one) for one in settings.mqtt.inputs]
    for path, name in ((path, name) for path, names in named.items() for name in names):
        node, _, sensor = name.rpartition("/")
        fuses = any(overlap(node, one.rpartition("/")[0]) for one in settings.fuse)
        if (sensor == "fused" and fuses) or (node.endswith("/fused") and settings.fused):
            part = "sensor" if sensor == "fused" else "node"
            raise SettingsInvalidError(f"setting {path}: no {part} is named fused, as its tracks, received {name}")


def _check_zones(settings: Settings) -> None:
    """Refuse geographic zones whose place is not known or not right, and too many zones of one pattern.

    Raises:
        SettingsInvalidError: there are such.
    """
    for name, zone in settings.zones.items():
        for pattern in zone.streams if zone.geo else ():
            sites = [site for site in settings.sites if fnmatchcase(site, pattern.partition("/")[0])]
            if not sites:
                raise SettingsInvalidError(f"setting zones.{name}.geo: the site of {pattern} is not in `sites`")
            try:
                for site in sites:
                    settings.zone(name, site)
            except ValueError as error:
                shape = "polygon" if zone.polygon else "line"
                reason = str(error).partition(": ")[2]
                raise SettingsInvalidError(f"setting zones.{name}.{shape} in sites.{site}: {reason}") from error
    for pattern in {pattern for one in settings.zones.values() for pattern in one.streams}:
        if (count := len(settings.zones_of(pattern))) > MOST_ZONES:
            raise SettingsInvalidError(f"setting zones: at most {MOST_ZONES} for a session, {pattern} has {count}")


def _check_formats(settings: Settings) -> None:
    """Refuse inputs whose format lacks what it needs.

    Raises:
        SettingsInvalidError: there are such.
    """
    for pattern, one in settings.inputs.items():
        path = f"setting inputs.{pattern}"
        if one.format == "frigate" and "after.camera" not in one.only:
            expected = 'the camera of the stream, as { "after.camera" = "gate" }'
            raise SettingsInvalidError(f"{path}.only: {expected}: Frigate's events are of all cameras")
        if (one.format == "mapped") is not (one.mapping is not None):
            raise SettingsInvalidError(f"{path}.mapping: with the format mapped, and only with it")


def _check_mqtt(settings: Settings) -> None:
    """Refuse input topics that are output topics, do not say their stream, or have a stream or a topic in common.

    Raises:
        SettingsInvalidError: there are such.
    """
    seen: dict[str, tuple[MqttInput, Mapping[str, object]]] = {}
    for stream, one in settings.mqtt.inputs.items():
        path, pattern = f"setting mqtt.inputs.{stream}", re.sub(r"\{\d\}", "*", stream)
        try:
            Keys().detections(pattern.replace("*", "x"))
        except MessageError as error:
            raise SettingsInvalidError(f"{path}: {error.expected}, received {stream!r}") from None
        if other := next((each for each in seen if overlap(each, pattern)), None):
            raise SettingsInvalidError(f"{path}: one input for a stream, {other} has it, too")
        values = settings.input_of(pattern).only
        if other := next((each for each, theirs in seen.items() if _have_in_common(one, values, *theirs)), None):
            raise SettingsInvalidError(f"{path}.topic: one input for a topic, {other} has some of {one.topic!r}, too")
        seen[pattern] = one, values
        parts = one.pattern.split("/")
        if any("+" in part and part != "+" for part in parts):
            raise SettingsInvalidError(f"{path}.topic: + stands for a whole part, received {one.topic!r}")
        wanted = {str(number) for number in range(1, parts.count("+") + 1)}
        if set(re.findall(r"\{(\d)\}", stream)) != wanted:
            numbers = ", ".join(f"{{{number}}}" for number in sorted(wanted)) or "no number in braces"
            raise SettingsInvalidError(f"{path}.topic: a stream with {numbers} for {one.topic!r}")
        output = re.escape(one.pattern).replace(r"\+", "[^/]*")
        kinds = (f"{settings.prefix}/x/x/x/{kind}" for kind in settings.mqtt.topics)
        if one.pattern.startswith(f"{settings.prefix}/") or any(re.fullmatch(output, kind) for kind in kinds):
            raise SettingsInvalidError(f"{path}.topic: other topics than those that are published, {one.topic!r}")


def _have_in_common(
    one: MqttInput, values: Mapping[str, object], other: MqttInput, theirs: Mapping[str, object]
) -> bool:
    """Return whether some message of a topic may be of two inputs, whose payloads have values by paths alone."""
    apart = any(values[path] != theirs[path] for path in values.keys() & theirs.keys())
    return not apart and overlap(*(each.pattern.replace("*", "?").replace("+", "*") for each in (one, other)))


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
