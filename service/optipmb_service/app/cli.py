"""The command `optipmb-service`: run the service (the default), ask how it is, or print the settings in force.

Exit status: 0 after SIGINT or SIGTERM, 1 when the network cannot be used or the end hung, 2 for a wrong option, path or
setting; an error is one clear line on stderr.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import sys
import sysconfig
from importlib import import_module
from inspect import Parameter, Signature, signature
from pathlib import Path  # noqa: TC003 - typer reads the annotations at run time
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn, TypedDict, Unpack, get_type_hints

import structlog
import typer
from optipmb_schemas.installation import install_command
from typer.main import get_command

from optipmb_service import __version__
from optipmb_service.app import ENDING, WRONG_USE, health_command
from optipmb_service.app.configuration import Loaded, SettingsInvalidError, load, missing_files
from optipmb_service.app.lifecycle import leave_or_restart
from optipmb_service.app.processes import run_bridge, run_gateway, run_link, run_log, run_ros2, run_router
from optipmb_service.cluster.store import StoreError
from optipmb_service.settings import (
    DEFAULT_GRPC,
    DEFAULT_LISTEN,
    DEFAULT_NATS,
    Settings,
    address,
    state_home,
    without_password,
)
from optipmb_service.telemetry import logs

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

PASSED_ON: Final = {"allow_extra_args": True, "ignore_unknown_options": True}

NATS: Final = "nats-server"
NATS_PAYLOAD_MB: Final = 8  # largest message; a checkpoint may have three quarters of it; the default of NATS is 1

app = typer.Typer(add_completion=False)


class RouterOptions(TypedDict, total=False):
    """What a router and the service take; None: not given."""

    settings: Annotated[Path | None, typer.Option("--settings", metavar="FILE", help="Settings, a TOML file.")]
    listen: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Endpoint to listen on, repeatable; as tcp/127.0.0.1:7447."),
    ]
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Router to connect to, repeatable; as tcp/10.0.0.1:7447."),
    ]
    zenoh_config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Zenoh configuration (JSON5): TLS, access control, limits.")
    ]
    instance: Annotated[str | None, typer.Option(metavar="NAME", help="Name of this instance.")]
    http: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Serve health and metrics there; as 127.0.0.1:8080.")
    ]
    log_format: Annotated[str | None, typer.Option(metavar="console|json", help="Form of the log lines on stderr.")]
    log_level: Annotated[str | None, typer.Option(metavar="LEVEL", help="debug, info, warning or error.")]


class LogOptions(RouterOptions, total=False):
    """What the bridge into the log and the service take beyond that."""

    cluster: Annotated[
        str | None,
        typer.Option(metavar="SERVERS", help="NATS servers that the members share; as nats://10.0.0.1:4222,nats://…"),
    ]
    cluster_tls: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder with certificates for tls:// servers of --cluster.")
    ]
    cluster_credentials: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Credentials, user:password or token for --cluster.")
    ]


class GatewayOptions(RouterOptions, total=False):
    """What a gateway and the service take beyond that."""

    grpc: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Serve gRPC there; as 127.0.0.1:50051.")]
    grpc_tls: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder with the certificates of gRPC; default: no TLS.")
    ]


class Options(GatewayOptions, LogOptions, total=False):
    """What the service takes beyond that."""

    router: Annotated[
        bool | None,
        typer.Option("--router/--no-router", help="Be a Zenoh router oneself. Default: yes unless --connect is given."),
    ]
    profile: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Profile of streams that no pattern in the settings names.")
    ]
    fuse: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN", help="Streams whose sensors feed one session per node, repeatable; as 'site/*/lidar*'."
        ),
    ]
    workers: Annotated[int | None, typer.Option(metavar="N", help="Processes that track, each a share of the streams.")]


def _taking(options: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command with `**given` the options of a class: typer reads a command's signature, and no `Unpack`."""

    def spread(command: Callable[..., None]) -> Callable[..., None]:
        own = [
            one
            for one in signature(command, eval_str=True).parameters.values()
            if one.kind is not Parameter.VAR_KEYWORD
        ]
        shared = [
            Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
            for name, annotation in get_type_hints(options, include_extras=True).items()
        ]
        command.__signature__ = Signature([*shared, *own])  # type: ignore[attr-defined]  # read by inspect.signature
        return command

    return spread


@app.command("run")
@_taking(Options)
def run_command(**given: Unpack[Options]) -> None:
    """Run the service until SIGINT or SIGTERM. Prints one line, `ready …`, when it can be used; logs go to stderr."""
    settings = _begin(_load(given))
    if settings.cluster:
        _needed("optipmb_service.cluster.jetstream", "cluster")
    if settings.grpc:
        _needed("grpc", "grpc")
    if settings.traces:
        _needed("optipmb_service.streams.traces", "traces")
    if settings.workers > 1:
        from optipmb_service.app.workers import supervise  # noqa: PLC0415 - a process that tracks needs none

        leave_or_restart(asyncio.run(supervise(settings)))
    # It takes the tracker along: 150 MB and seconds.
    from optipmb_service.app import worker  # noqa: PLC0415 - neither a parent nor a question needs it

    leave_or_restart(worker.run(settings))


def _version(value: bool) -> None:  # noqa: FBT001 - the parser calls it so
    if value:
        typer.echo(f"optipmb-service {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
@_taking(Options)
def without_command(
    *,
    context: typer.Context,
    _show: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    **given: Unpack[Options],
) -> None:
    """Track objects in detections that come in over Zenoh. Without a command: run, with these options."""
    if context.invoked_subcommand is None:
        run_command(**given)
    elif any(value is not None for value in given.values()):
        _wrong(f"options of a command stand behind it: optipmb-service {context.invoked_subcommand} [OPTIONS]")


@app.command("config")
@_taking(Options)
def config_command(
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with where each value came from.")] = False,
    **given: Unpack[Options],
) -> None:
    """Print the settings in force as TOML, each with its origin; nothing is started. A named file must exist."""
    loaded = _load(given)
    if missing := missing_files(loaded.settings):
        _wrong("; ".join(missing))
    values = loaded.settings.model_dump(mode="json")
    values |= {"router": loaded.settings.is_router, "listen": list(loaded.settings.endpoints)}
    values["cluster"] = [without_password(server) for server in loaded.settings.cluster]
    if as_json:
        typer.echo(json.dumps({"settings": values, "sources": loaded.sources}, indent=2))
        return
    plain = {name: value for name, value in values.items() if not isinstance(value, dict)}
    for name, value in plain.items():
        # TOML has no null: a setting without a value is a comment; some may not be set and empty.
        shown = f"# {name} is not set" if value is None or value == "" else f"{name} = {_toml(value)}"
        typer.echo(f"{shown}  # {loaded.sources[name]}")
    for name in values.keys() - plain.keys():
        typer.echo(f"\n[{name}]  # {loaded.sources[name]}")
        for key, value in values[name].items():
            shown = f"{_toml(key) if name in {'profiles', 'sensors'} else key} = {_toml(value)}"
            typer.echo(f"# {key} is not set" if value is None else shown)


@app.command("router")
@_taking(RouterOptions)
def router_command(**given: Unpack[RouterOptions]) -> None:
    """Run a Zenoh router alone, without tracking. SIGINT and SIGTERM end it."""
    leave_or_restart(asyncio.run(run_router(_begin(_load({**given, "router": True})))))


@app.command("grpc")
@_taking(GatewayOptions)
def grpc_command(**given: Unpack[GatewayOptions]) -> None:
    """Run a gRPC gateway alone, a client of routers. Prints one line, `ready …`; SIGINT and SIGTERM end it."""
    settings = _client(given, grpc=DEFAULT_GRPC)
    _needed("optipmb_service.edges.grpc.server", "grpc")
    leave_or_restart(asyncio.run(run_gateway(settings)))


@app.command("ros2")
@_taking(RouterOptions)
def ros2_command(**given: Unpack[RouterOptions]) -> None:
    """Run a bridge to ROS 2 (rmw_zenoh) alone, a client of routers. SIGINT and SIGTERM end it. See docs/ros2.md."""
    settings = _client(given)
    if not settings.ros2.streams:
        _wrong("setting ros2.streams: expected a table of streams and their topics in --settings, received none")
    _needed("optipmb_service.edges.ros2.node", "ros2")
    leave_or_restart(asyncio.run(run_ros2(settings)))


@app.command("mqtt")
@_taking(RouterOptions)
def mqtt_command(
    *,
    broker: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Broker; as mqtt://127.0.0.1:1883, or mqtts:// with TLS.")
    ] = None,
    payload: Annotated[
        Path | None, typer.Option("--try", metavar="FILE", help="Print what a payload becomes, and end.")
    ] = None,
    stream: Annotated[str, typer.Option("--input", metavar="STREAM", help="Stream in `mqtt.inputs`, of --try.")] = "",
    **given: Unpack[RouterOptions],
) -> None:
    """Connect a client of routers to an MQTT broker: tracks and events as JSON, detections. SIGINT, SIGTERM end it."""
    settings = _client({**given, "mqtt": broker and {"broker": broker}})
    _needed("optipmb_service.edges.mqtt", "mqtt")
    if payload is not None:
        from optipmb_service.edges.mqtt_inputs import tried  # noqa: PLC0415 - an extra that only this needs

        try:
            print(tried(settings, stream, payload.read_bytes()))  # noqa: T201 - it is what was asked for
        except (OSError, ValueError) as error:
            _wrong(str(error))
        return
    leave_or_restart(asyncio.run(run_bridge(settings, "mqtt")))


@app.command("link")
@_taking(LogOptions)
def link_command(**given: Unpack[LogOptions]) -> None:
    """Link the tracks of streams that see the same objects, a client of routers: see docs/links.md."""
    settings = _client(given)
    if not settings.links:
        _wrong("setting links: expected a table of areas and their streams in --settings, received none")
    if settings.cluster:
        _needed("optipmb_service.cluster.jetstream", "cluster")
    leave_or_restart(asyncio.run(run_link(settings)))


@app.command("log")
@_taking(LogOptions)
def log_command(**given: Unpack[LogOptions]) -> None:
    """Put detections and tracks into the message log of a cluster, a client of routers. SIGINT and SIGTERM end it."""
    settings = _client(given, cluster=[f"nats://{DEFAULT_NATS}"])
    _needed("optipmb_service.app.log_bridge", "cluster")
    leave_or_restart(asyncio.run(run_log(settings)))


@app.command("nats")
def nats_command(
    listen: Annotated[str, typer.Option(metavar="ADDRESS", help="Where it listens.")] = DEFAULT_NATS,
    store: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of its files; default: one of its own.")
    ] = None,
) -> None:
    """Run one NATS server for `--cluster`, from the package that the extra brings. SIGINT and SIGTERM end it."""
    try:
        address(listen)
    except ValueError as error:
        _wrong(f"option listen: {error}")
    server = nats_server()
    if server is None:
        _wrong(f"this needs {NATS}, which is not installed: {install_command('cluster')}")
    folder = (store or state_home() / "nats").absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "nats.conf").write_text(nats_configuration(listen, folder), encoding="utf-8")
        # The process becomes the server, so signals and exit status are the server's own.
        os.execv(server, [server, "--config", str(folder / "nats.conf")])  # noqa: S606 - no shell is wanted
    except OSError as error:
        _wrong(f"{error.filename}: {error.strerror}")


def nats_server() -> str | None:
    """Return the path of the NATS server of this environment, else of the system; None without one."""
    return shutil.which(NATS, path=sysconfig.get_path("scripts")) or shutil.which(NATS)


def nats_configuration(listen: str, folder: Path) -> str:
    """Return the configuration of a server, by where it listens and the folder of its files."""
    return f"""listen: "{listen}"
max_payload: {NATS_PAYLOAD_MB}MB
jetstream {{ store_dir: "{folder}" }}
"""


@app.command("copy")
def copy_command(
    cluster: Annotated[str, typer.Option(metavar="SERVERS", help="NATS servers of the cluster, as for `run`.")],
    store: Annotated[Path | None, typer.Option(metavar="DIR", help="The folder; default: the setting `store`.")] = None,
    settings: Annotated[Path | None, typer.Option(metavar="FILE", help="Settings, a TOML file.")] = None,
) -> None:
    """Copy the sessions of this machine's folder into a cluster, before its members start; their ids go on there."""
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL)  # an interrupted copy is no success
    given: dict[str, Any] = {"settings": settings, "cluster": cluster, "store": store and str(store)}
    loaded = _begin(_load(given))
    _needed("optipmb_service.cluster.jetstream", "cluster")
    from optipmb_service.app.storage import copy_folder  # noqa: PLC0415 - it takes the tracker along

    try:
        copied, known = copy_folder(loaded)
    except StoreError as error:
        typer.echo(f"optipmb-service: {error}", err=True)
        raise typer.Exit(1) from None
    typer.echo(f"copied {copied} sessions; left out {known} of streams that the cluster has sessions of")


@app.command("health", add_help_option=False, context_settings=PASSED_ON)
def health(context: typer.Context) -> None:
    """Ask a running service for its health: status 0 or 1. See `health --help`."""
    raise typer.Exit(health_command.main(context.args))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        status = get_command(app).main(given, prog_name="optipmb-service", standalone_mode=False)
    except Exception as error:
        # Errors of use are not of one public class in all versions of typer; all of them know this method.
        describe = getattr(error, "format_message", None)
        if describe is None:
            raise
        _wrong(describe())
    sys.exit(status if isinstance(status, int) else 0)


def _load(given: Mapping[str, Any], **defaults: Any) -> Loaded:
    """Return the settings in force with what the command line gives; None and no endpoints: not given."""
    options = {name: value or None if name in {"listen", "connect"} else value for name, value in given.items()}
    file = options.pop("settings")
    try:
        return load(file, options, defaults)
    except SettingsInvalidError as error:
        _wrong(str(error))


def _begin(loaded: Loaded) -> Settings:
    """Configure the logs, and warn of settings that are allowed but unsafe or unknown."""
    logs.configure(loaded.settings.log_format, loaded.settings.log_level)
    log = structlog.get_logger("optipmb_service")
    if loaded.unknown:
        log.warning("unknown_environment", names=loaded.unknown)
    if loaded.settings.unprotected:
        log.warning("unprotected", addresses=loaded.settings.unprotected)
    return loaded.settings


def _client(given: Mapping[str, Any], **defaults: Any) -> Settings:
    settings = _begin(_load(given, connect=[DEFAULT_LISTEN], **defaults))
    return settings.model_copy(update={"router": False, "listen": ()})


def _needed(module: str, extra: str) -> Any:
    """Return a module that needs an extra; say what to install where it is not."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("optipmb"):
            raise
        _wrong(f"this needs {error.name}, which is not installed: {install_command(extra)}")


def _wrong(message: str) -> NoReturn:
    typer.echo(f"optipmb-service: {' '.join(message.split())}", err=True)
    raise SystemExit(WRONG_USE)


def _toml(value: object) -> str:
    """Return a value as TOML: as JSON, but for tables."""
    if not isinstance(value, dict):
        return json.dumps(value)
    pairs = (f"{json.dumps(name)} = {_toml(one)}" for name, one in value.items())
    return "{" + ", ".join(pairs) + "}"
