"""`optipmb set`: another profile for a stream."""

from typing import Annotated

import typer
from optipmb_schemas import SessionParameters

from optipmb_client.commands.options import AsJson, print_json, say
from optipmb_client.commands.service_options import ServiceOptions
from optipmb_client.sessions import set_parameters


def set_profile(
    stream: Annotated[str, typer.Argument(help="Name of the stream, site/node/sensor.")],
    profile: Annotated[str, typer.Option("--profile", metavar="NAME", help="Profile of the service.")],
    *,
    restart: Annotated[
        bool, typer.Option("--restart", help="Restart a session that has tracked frames: its tracks end, ids continue.")
    ] = False,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Track a stream with another profile, in place of the one in its checkpoint or in the settings."""
    wanted = SessionParameters(profile=profile, restart=restart)
    with service.connection(2.0) as connection:
        in_force = set_parameters(connection, stream, wanted, prefix=service.prefix)
    if as_json:
        print_json({"command": "set", "stream": stream, "profile": in_force.profile, "session": in_force.session})
    else:
        say(f"{stream} is tracked with {in_force.profile}")
