"""Logs: one line per event that an operator can act on, on stderr; stdout holds nothing but the ready line."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING, Literal

import structlog

if TYPE_CHECKING:
    from structlog.typing import Processor


def configure(form: Literal["console", "json"], level: str) -> None:
    """Send the log lines to stderr, as coloured text on a terminal, plain text elsewhere, or JSON."""
    processors: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    if form == "json":
        processors += [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    else:
        plain = structlog.dev.plain_traceback
        colors = sys.stderr.isatty()
        processors.append(structlog.dev.ConsoleRenderer(colors=colors, pad_event_to=0, exception_formatter=plain))
    structlog.configure(
        processors=processors,
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=structlog.WriteLoggerFactory(file=sys.stderr),
    )


def unknown_environment(names: tuple[str, ...]) -> None:
    """Log environment variables that look like settings and are none: usually a typing error."""
    if names:
        structlog.get_logger("optipmb_service").warning("unknown_environment", names=names)
