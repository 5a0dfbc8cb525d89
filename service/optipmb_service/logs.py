"""Logs: one line per event that an operator can act on, on stderr; stdout holds nothing but the ready line."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING, Final, Literal

import structlog

if TYPE_CHECKING:
    from structlog.typing import Processor

EVENTS: Final = {
    "starting": "The service compiles or loads its kernels; the first start after an installation takes a minute.",
    "connecting": "As a client it waits for a router; nothing else happens until one answers. Check `connect`.",
    "http": "Health and metrics are served at `address`.",
    "ready": "Streams and queries are served. stdout has the ready line.",
    "unknown_environment": "Variables that start with `OPTIPMB_` and are no setting: usually a typing error.",
    "peer_connected": "A node, router or service is linked to this process.",
    "peer_lost": "That link is gone. A client links again by itself and recovers what the caches still hold.",
    "session_opened": "A stream sent its first valid message, or parameters were set for it.",
    "session_restored": "A stream's session goes on from its checkpoint; what it missed is asked of the publishers.",
    "session_begun": "A density began: `first` frame, `publisher` restarted with a jump, a `jump` of stamps, `reset`, "
    "`parameters`. Repeated jumps: check the sensor's clock.",
    "session_closed": "A session was freed: `idle` for long, by a `query`, or `superseded` by another instance.",
    "checkpoint_torn": "A checkpoint cannot be read; it is set aside and the one before it is used.",
    "checkpoint_refused": "Another instance has taken the stream over; this one's checkpoint was not written.",
    "store_failed": "Checkpoints cannot be written (disk full, read-only?): tracking goes on, the state is `degraded`.",
    "store_back": "Checkpoints are written again.",
    "tenure_lapsed": "This process was frozen, starved or cut off: nothing is published until it has looked whether"
    " another instance took over.",
    "tenure_renewed": "It has looked; what is still its own goes on.",
    "stream_stale": "No frame for `stale_s`: check the publisher.",
    "stream_back": "Frames came again.",
    "problem": "Something was refused or lost; `count` equal ones since the last line. See the problems below.",
    "claim_failed": "The tracks of a stream cannot be published; the network is closing.",
    "publish_failed": "Tracks could not be handed to Zenoh; the network is closing.",
    "reply_failed": "Who asked was gone before the answer.",
    "query": "A query was answered (level debug).",
    "internal_error": "A fault of the service, with its traceback: report it. The stream goes on.",
    "stop_asked": "SIGINT or SIGTERM came; the service ends within two seconds.",
    "stop_asked_again": "Another signal came; it changes nothing.",
    "stopped": "The end. `drained` is false when a step was abandoned because it took too long.",
}
"""Every event that is logged, and what an operator makes of it."""


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
