"""The forms of texts in settings: endpoints, addresses, patterns of streams, and lists of them."""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator
from pydantic_settings import NoDecode

DEFAULT_LISTEN: Final = "tcp/127.0.0.1:7447"
DEFAULT_GRPC: Final = "127.0.0.1:50051"
DEFAULT_NATS: Final = "127.0.0.1:4222"


def form_of(pattern: str, expected: str) -> AfterValidator:
    """Return the check of a text: it matches a regular expression in full, or the error says what was expected."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise ValueError(f"{expected}, received {value!r}")
        return value

    return AfterValidator(check)


def address(value: str) -> str:
    """Return an address as it is, `host:port` or nothing.

    Raises:
        ValueError: it is none.
    """
    if value and not re.fullmatch(r"([A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.%]+\]):\d{1,5}", value):
        raise ValueError(f"an address looks like 127.0.0.1:8080, received {value!r}")
    return value


def without_password(server: str) -> str:
    """Return the address of a server as it may be shown."""
    return re.sub(r"(?<=//)[^/@]*@", "***@", server)


def _listed(value: Any) -> Any:
    """Take a text for a list: JSON, or names separated by commas."""
    if not isinstance(value, str):
        return value
    if not value.startswith("["):
        return [part.strip() for part in value.split(",") if part.strip()]
    try:
        return json.loads(value)
    except ValueError as error:
        raise ValueError(f"names separated by commas, or a JSON list, received {value!r}") from error


Prefix = Annotated[str, form_of(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", "chunks of [A-Za-z0-9_.-] separated by '/'")]
Address = Annotated[str, AfterValidator(address)]
Pattern = Annotated[
    str, form_of(r"[A-Za-z0-9_.*-]+(/[A-Za-z0-9_.*-]+){2}", "a pattern of streams looks like site/*/lidar*")
]
Server = Annotated[str, form_of(r"(nats|tls)://\S+", "a NATS server looks like nats://127.0.0.1:4222")]
Endpoint = Annotated[
    str,
    form_of(r"[a-z0-9]+/[^\s/#?]+:\d+([?#]\S*)?|[a-z0-9-]+/\S+", f"an endpoint looks like {DEFAULT_LISTEN}"),
]
Names = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_listed)]
Patterns = Annotated[tuple[Pattern, ...], NoDecode, BeforeValidator(_listed)]
Servers = Annotated[tuple[Server, ...], NoDecode, BeforeValidator(_listed)]
Endpoints = Annotated[tuple[Endpoint, ...], NoDecode, BeforeValidator(_listed)]
