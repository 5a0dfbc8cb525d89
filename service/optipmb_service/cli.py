"""The command `optipmb-service`: run the service (the default), ask how it is, or print the settings in force.

Exit status: 0 after SIGINT or SIGTERM, 1 when the network cannot be used, 2 for a wrong option, path or setting; an
error is one clear line on stderr.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer
from typer.main import get_command

from optipmb_service import __version__, health, logs
from optipmb_service.loops import leave
from optipmb_service.router import route
from optipmb_service.settings import Loaded, Settings, SettingsInvalidError, load

if TYPE_CHECKING:
    from collections.abc import Sequence

WRONG_USE: Final = 2
PASSED_ON: Final = {"allow_extra_args": True, "ignore_unknown_options": True}

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Track objects in detections that come in over Zenoh. Without a command: run.",
)

SettingsFile = Annotated[Path | None, typer.Option("--settings", metavar="FILE", help="Settings, a TOML file.")]
Router = Annotated[
    bool | None,
    typer.Option("--router/--no-router", help="Be a Zenoh router oneself. Default: yes unless --connect is given."),
]
Listen = Annotated[
    list[str] | None, typer.Option(metavar="ENDPOINT", help="Endpoint to listen on, repeatable; as tcp/127.0.0.1:7447.")
]
Connect = Annotated[
    list[str] | None, typer.Option(metavar="ENDPOINT", help="Router to connect to, repeatable; as tcp/10.0.0.1:7447.")
]
Instance = Annotated[str | None, typer.Option(metavar="NAME", help="Name of this instance.")]
Profile = Annotated[
    str | None, typer.Option(metavar="NAME|FILE", help="Profile of streams that no pattern in the settings names.")
]
Workers = Annotated[int | None, typer.Option(metavar="N", help="Processes that track, each a share of the streams.")]
Http = Annotated[str | None, typer.Option(metavar="ADDRESS", help="Serve health and metrics there; as 127.0.0.1:8080.")]
ZenohConfig = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Zenoh configuration (JSON5): TLS, access control, limits.")
]
LogFormat = Annotated[str | None, typer.Option(metavar="console|json", help="Form of the log lines on stderr.")]
LogLevel = Annotated[str | None, typer.Option(metavar="LEVEL", help="debug, info, warning or error.")]


@app.command("run")
def run_command(  # noqa: PLR0913 - one argument per option of the command
    *,
    settings: SettingsFile = None,
    router: Router = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    instance: Instance = None,
    profile: Profile = None,
    workers: Workers = None,
    http: Http = None,
    log_format: LogFormat = None,
    log_level: LogLevel = None,
) -> None:
    """Run the service until SIGINT or SIGTERM. Prints one line, `ready …`, when it can be used; logs go to stderr."""
    loaded = _load(
        settings,
        router=router,
        listen=listen or None,
        connect=connect or None,
        zenoh_config=zenoh_config,
        instance=instance,
        profile=profile,
        workers=workers,
        http=http,
        log_format=log_format,
        log_level=log_level,
    )
    logs.configure(loaded.settings.log_format, loaded.settings.log_level)
    logs.unknown_environment(loaded.unknown)
    leave(_run_one(loaded.settings) if loaded.settings.workers == 1 else _run_many(loaded.settings))


@app.command("config")
def config_command(  # noqa: PLR0913 - one argument per option of the command
    *,
    settings: SettingsFile = None,
    router: Router = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    instance: Instance = None,
    profile: Profile = None,
    workers: Workers = None,
    http: Http = None,
    log_format: LogFormat = None,
    log_level: LogLevel = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with where each value came from.")] = False,
) -> None:
    """Print the settings in force as TOML, each with where it came from, and do nothing else."""
    loaded = _load(
        settings,
        router=router,
        listen=listen or None,
        connect=connect or None,
        zenoh_config=zenoh_config,
        instance=instance,
        profile=profile,
        workers=workers,
        http=http,
        log_format=log_format,
        log_level=log_level,
    )
    values = loaded.settings.model_dump(mode="json")
    values |= {"router": loaded.settings.is_router, "listen": list(loaded.settings.endpoints)}
    if as_json:
        typer.echo(json.dumps({"settings": values, "sources": loaded.sources}, indent=2))
        return
    plain = {name: value for name, value in values.items() if not isinstance(value, dict)}
    for name, value in plain.items():
        # TOML has no null: what is not set is a comment.
        shown = f"# {name} is not set" if value is None else f"{name} = {_toml(value)}"
        typer.echo(f"{shown}  # {loaded.sources[name]}")
    for name in values.keys() - plain.keys():
        typer.echo(f"\n[{name}]  # {loaded.sources[name]}")
        for key, value in values[name].items():
            typer.echo(f"{_toml(key) if name == 'profiles' else key} = {_toml(value)}")


@app.command("router")
def router_command(
    *,
    settings: SettingsFile = None,
    listen: Listen = None,
    connect: Connect = None,
    zenoh_config: ZenohConfig = None,
    instance: Instance = None,
    http: Http = None,
    log_format: LogFormat = None,
    log_level: LogLevel = None,
) -> None:
    """Run a Zenoh router alone, without tracking, until SIGINT or SIGTERM."""
    loaded = _load(
        settings,
        router=True,
        listen=listen or None,
        connect=connect or None,
        zenoh_config=zenoh_config,
        instance=instance,
        http=http,
        log_format=log_format,
        log_level=log_level,
    )
    logs.configure(loaded.settings.log_format, loaded.settings.log_level)
    logs.unknown_environment(loaded.unknown)
    leave(route(loaded.settings))


@app.command("health", add_help_option=False, context_settings=PASSED_ON)
def health_command(context: typer.Context) -> None:
    """Ask a running service how it is; status 0 when well, else 1. See `health --help`."""
    raise typer.Exit(health.main(context.args))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        typer.echo(f"optipmb-service {__version__}")
        return
    if given[:1] != ["--help"] and (not given or given[0].startswith("-")):
        given = ["run", *given]
    try:
        status = get_command(app).main(given, prog_name="optipmb-service", standalone_mode=False)
    except Exception as error:
        # Errors of use are not of one public class in all versions of typer; all of them know this method.
        describe = getattr(error, "format_message", None)
        if describe is None:
            raise
        _wrong(describe())
    sys.exit(status if isinstance(status, int) else 0)


def _run_one(settings: Settings) -> int:
    # Imported here, for it takes the tracker along: 150 MB and seconds that neither a parent nor a question needs.
    from optipmb_service.worker import run_alone  # noqa: PLC0415

    return run_alone(settings)


def _run_many(settings: Settings) -> int:
    from optipmb_service.supervisor import supervise  # noqa: PLC0415 - a process that tracks needs none

    return asyncio.run(supervise(settings))


def _load(file: Path | None, **options: Any) -> Loaded:
    """Return the settings; an option that is None was not given."""
    try:
        return load(file, options)
    except SettingsInvalidError as error:
        _wrong(str(error))


def _wrong(message: str) -> NoReturn:
    typer.echo(f"optipmb-service: {' '.join(message.split())}", err=True)
    raise SystemExit(WRONG_USE)


def _toml(value: object) -> str:
    """Return a value as TOML; for what settings hold, that is JSON."""
    return json.dumps(value)
