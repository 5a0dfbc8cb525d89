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


def _endpoint(value: str) -> str:
    if not re.fullmatch(r"[a-z0-9]+/[^\s/#?]+:\d+([?#]\S*)?|[a-z0-9-]+/\S+", value):
        raise ValueError(f"an endpoint looks like {DEFAULT_LISTEN}, received {value!r}")
    return value


def address(value: str) -> str:
    """Return an address as it is, `host:port` or nothing.

    Raises:
        ValueError: it is none.
    """
    if value and not re.fullmatch(r"([A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.%]+\]):\d{1,5}", value):
        raise ValueError(f"an address looks like 127.0.0.1:8080, received {value!r}")
    return value


def _prefix(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", value):
        raise ValueError(f"chunks of [A-Za-z0-9_.-] separated by '/', received {value!r}")
    return value


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


def _server(value: str) -> str:
    if not re.fullmatch(r"(nats|tls)://\S+", value):
        raise ValueError(f"a NATS server looks like nats://127.0.0.1:4222, received {value!r}")
    return value


def _pattern(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.*-]+(/[A-Za-z0-9_.*-]+){2}", value):
        raise ValueError(f"a pattern of streams looks like site/*/lidar*, received {value!r}")
    return value


Prefix = Annotated[str, AfterValidator(_prefix)]
Address = Annotated[str, AfterValidator(address)]
Names = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_listed)]
Patterns = Annotated[tuple[Annotated[str, AfterValidator(_pattern)], ...], NoDecode, BeforeValidator(_listed)]
Servers = Annotated[tuple[Annotated[str, AfterValidator(_server)], ...], NoDecode, BeforeValidator(_listed)]
Endpoints = Annotated[tuple[Annotated[str, AfterValidator(_endpoint)], ...], NoDecode, BeforeValidator(_listed)]
