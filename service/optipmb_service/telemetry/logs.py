"""Logs: one line per event that an operator can act on, on stderr; stdout holds nothing but the ready line.

A thread of its own writes the lines: logging never waits for the reader of stderr, which may have stopped
reading. Lines beyond the bound of the queue are dropped and counted.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Final, Literal, TextIO, cast

import structlog

if TYPE_CHECKING:
    from collections.abc import Callable

    from structlog.typing import EventDict, Processor, WrappedLogger

EVENTS: Final = {
    "log_lines_dropped": "stderr was not read in time: `count` lines were not written.",
    "starting": "The service compiles or loads its kernels.",
    "connecting": "Waits for a router. If this lasts, check `connect`.",
    "http": "Health, metrics and the live page are served at `address`.",
    "ready": "Streams and queries are served.",
    "keys_used_up": "The process has declared `restart_keys` keys, and restarts.",
    "grpc": "gRPC is served at `address`.",
    "grpc_call": "A call has ended (level debug).",
    "grpc_connections": "The limit of open files allows fewer connections than the setting.",
    "grpc_invalid": "An invalid message from the network was not forwarded to callers.",
    "edge_invalid": "An invalid message from the network was left out over HTTP or MQTT.",
    "http_certificates": "Changed files of `http_tls` cannot be used; the certificate before holds.",
    "grpc_certificates": "Renewed certificates cannot be read; the previous ones stay in use.",
    "certificate_ends": "Certificates that end within a week, in `days`: renew them.",
    "certificate_unusable": "A certificate does not fit its key: the one before is served. The state is `degraded`.",
    "certificate_ended": "A certificate has ended. Renew it, and restart what listens with it.",
    "tokens_unusable": "The file of tokens has changed and cannot be used: the tokens before hold.",
    "unprotected": (
        "Everybody who reaches these `addresses` may publish, read and command. Of `http`: all may read without "
        "`http_tokens`, and tokens are readable without `http_tls`. See `security.md`."
    ),
    "unknown_environment": "Variables `OPTIPMB_…` that are not settings, usually misspelt.",
    "peer_connected": "A node, router or service has connected.",
    "tracker_message": "A `text` of the tracker: it compiles, for up to a minute.",
    "leases_gone": "The store has lost its records; the member writes its own again.",
    "store_deleted": "A `file` of the store was deleted while in use, and was made again.",
    "peer_lost": "A connection is lost. A client reconnects and recovers what the caches hold.",
    "sessions_stored": "The `folder` has so many `sessions` of earlier runs, which continue.",
    "session_opened": "A stream's first valid message came, or parameters were set for it.",
    "session_restored": "A session continues from its checkpoint; missed frames are requested from publishers.",
    "profile_differs": (
        "A session continues with the `profile` of its checkpoint, and the settings name `configured`. `optipmb set "
        "STREAM --profile NAME --restart` changes it."
    ),
    "session_begun": (
        "A density began: `first` frame, restart of the `publisher`, `jump` of stamps, `reset`, `parameters`, "
        "implausible `pose`, too much `effort`, end of a `quarantine`."
    ),
    "session_quarantined": "Tracking a stream raised `error`. Its last frames are saved; see the problem `internal`.",
    "stream_degraded": "A message took `took_s` of processor time; its stream is refused for `refused_s`.",
    "session_closed": (
        "A session was freed: `idle`, by a `query`, `moved`, lacking `memory`, `evicted` for another site, or "
        "`superseded` by another instance."
    ),
    "checkpoint_torn": (
        "A checkpoint cannot be read, for `reason`: the one before it is used. Where `reason` names another format, "
        "start the release that wrote it."
    ),
    "checkpoint_refused": "A checkpoint was not written: another instance has taken the stream over.",
    "checkpoints_expired": "Checkpoints older than `keep_days` were deleted; their ids are kept.",
    "checkpoint_failed": (
        "The checkpoint of one stream cannot be made: a bug, report it. The stream continues; the state is `degraded`."
    ),
    "store_failed": "Checkpoints cannot be written (disk full, read-only): tracking goes on, the state is `degraded`.",
    "store_back": "Checkpoints are written again.",
    "partitions_held": "Number of partitions that this member holds, and the `members`.",
    "leases_damaged": "The `file` of the leases was damaged, as by a power cut, and is created again.",
    "lease_lost": "This member was frozen or cut off for `lease_s`, and others continue its streams. It joins again.",
    "leases_failed": "The servers of `cluster`, or the folder `store`, cannot be used, for `error`: after half of"
    " `lease_s` nothing is published, and the state is `paused`.",
    "leases_back": "They can be used again.",
    "leases_slow": (
        "Renewals of the lease take more than a quarter of `lease_s`: look for a slow disk or network, or raise "
        "`lease_s`."
    ),
    "leases_in_time": "A renewal of the lease was in time again.",
    "links_torn": "The state of the links of `area` cannot be read: it is set aside, and the one before is taken.",
    "links_not_saved": "The state of the links cannot be written, for `error`: a restart goes back to the last one.",
    "links_taken": "Another process links the streams of `area` now: this one does nothing there any more.",
    "message_log_failed": "The message log cannot be written, for `error`; the bridge tries again.",
    "message_log_back": "The message log can be written.",
    "message_log_unread": "The message log could not be read for the session of `streams`: frames may be missing.",
    "message_log_cut": "A session missed more of the message log than it takes: the oldest frames are left out.",
    "traces_lost": "The collector does not answer, or refuses: `spans` are lost, until `traces_back`.",
    "traces_back": "The collector takes spans again.",
    "traceparent_invalid": "A publisher sends the invalid trace context `received`: its frames begin new traces.",
    "traces_failed": "A `text` of OpenTelemetry: some spans are lost.",
    "stream_stale": "No frame for `stale_s`: check the publisher.",
    "stream_back": "Frames arrive again.",
    "problem": "`count` messages were refused or lost since the last line: see the table of problems.",
    "mqtt_connected": "The bridge has a connection to the `broker`, in this version of the `protocol`.",
    "mqtt_disconnected": "The broker cannot be used, for `reason`: the bridge holds 10,000 events and tries again.",
    "mqtt_refused": "The broker does not take messages of `topic`, for `reason`: they are left out.",
    "cpm_left_out": "The first `objects` of a `stream` without a place in its CPM, for `reason`:"
    " [standards](standards.md#collective-perception-messages) has them.",
    "mqtt_unsent": "So many `messages` were on their way to the broker when the bridge ended.",
    "ros2_mismatch": "An endpoint has another type, definition or quality of service; `message` says which.",
    "publisher_failed": "The tracks of a stream cannot be published; the network is closing.",
    "publish_failed": "Tracks cannot be passed to Zenoh; the network is closing.",
    "reply_failed": "The client of a query had left before the reply.",
    "query": "A query was answered (level debug).",
    "internal_error": "A bug, with its traceback: report it. The stream continues.",
    "worker_started": "The parent has started a worker.",
    "worker_not_started": (
        "The system refuses to start a worker. At the start the service ends with status 1, later it tries again."
    ),
    "worker_ended": (
        "A worker has ended by itself, with this status (below 0: signal). It is restarted after `again_s`."
    ),
    "worker_restarts": "A worker has declared `restart_keys` keys and restarts.",
    "worker_stuck": "A worker has not responded for `silent_s`; it is killed and restarted.",
    "worker_killed": "A worker did not end or respond in time and was killed.",
    "metrics_unreadable": "The metrics of a worker cannot be read and are left out.",
    "parent_gone": "The parent has died; its worker ends.",
    "stop_asked": (
        "A signal ends the service, or the parent its worker, within 8 s + `grace_s`, a parent of workers within 10 s "
        "+ `grace_s`."
    ),
    "stop_asked_again": "Another signal, which has no effect.",
    "step_hangs": (
        "`steps` of the end do not return. Checkpoints are written all the same; where `tracking` is among them, of "
        "older states. The exit status is 1."
    ),
    "end_hangs": "The end took too long, and the process was ended with status 1. `threads` is where each thread was.",
    "end_unbounded": "No thread can be started (a limit of processes or memory): the end may take any time.",
    "stopped": "The service has stopped; `drained` is false when not all is done.",
}
"""Every event that is logged, and what an operator makes of it."""


BURST: Final = 50  # lines of one event that are written at once
LINES_PER_SECOND: Final = 5.0  # lines of one event that are written in the long run


class Limiter:
    """Drops lines of an event that comes too often; the next one that is written says how many (`suppressed`).

    A thousand streams that fall silent together must neither fill a disk nor hide what else happens.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._left: dict[str, tuple[float, float]] = {}
        self._dropped: Counter[str] = Counter()

    def __call__(self, _logger: WrappedLogger, _method: str, event: EventDict) -> EventDict:
        """Return a line, or drop it.

        Raises:
            structlog.DropEvent: it is one too many.
        """
        name = str(event.get("event"))
        now = self._clock()
        with self._lock:
            left, before = self._left.get(name, (float(BURST), now))
            left = min(BURST, left + (now - before) * LINES_PER_SECOND)
            self._left[name] = (left - 1 if left >= 1 else left, now)
            if left < 1:
                self._dropped[name] += 1
                raise structlog.DropEvent
            if suppressed := self._dropped.pop(name, 0):
                event["suppressed"] = suppressed
        return event


QUEUE_BYTES: Final = 4 * 2**20  # lines that wait for the reader of stderr
CLOSE_S: Final = 0.5  # how long the end of a process waits for the last lines to be written


class LineWriter:
    """Bounded queue of lines that a thread writes to a file; implements what structlog uses of a file.

    Args:
        file: where the lines go. Its descriptor is written to directly: a write that blocks holds no lock of the file.
    """

    def __init__(self, file: TextIO) -> None:
        self.file = file
        self._changed = threading.Condition()
        self._lines: deque[bytes] = deque()
        self._bytes = 0
        self._unreported = 0
        self.dropped = 0
        """Lines that were not written."""
        threading.Thread(target=self._run, name="log", daemon=True).start()

    def write(self, text: str) -> None:
        """Queue a line, or drop it; never waits."""
        line = text.encode(errors="backslashreplace")
        with self._changed:
            if self._bytes + len(line) > QUEUE_BYTES:
                self.dropped += 1
                self._unreported += 1
                return
            self._lines.append(line)
            self._bytes += len(line)
            self._changed.notify_all()

    def flush(self) -> None:
        """Have no effect: the thread writes each line as soon as it can."""

    def finish(self, seconds: float = CLOSE_S) -> None:
        """Wait until all lines are written, at most so long."""
        with self._changed:
            self._changed.wait_for(lambda: not self._bytes, seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines)
                line = self._lines.popleft()
            try:
                self._write(line)
            except OSError:  # the reader has gone
                with self._changed:
                    self.dropped += 1
            with self._changed:
                self._bytes -= len(line)
                self._changed.notify_all()
                dropped, self._unreported = (0, self._unreported) if self._lines else (self._unreported, 0)
            if dropped:
                structlog.get_logger("optipmb_service").warning("log_lines_dropped", count=dropped)

    def _write(self, line: bytes) -> None:
        try:
            descriptor = self.file.fileno()
        except OSError:  # of a test, which has put another object in its place
            self.file.write(line.decode())
            return
        while line:
            try:
                line = line[os.write(descriptor, line) :]
            except BlockingIOError:  # somebody has made the pipe non-blocking
                time.sleep(0.01)


_writer: LineWriter | None = None


def say(line: str) -> None:
    """Write a line to stderr as it is, after the lines of the log."""
    if _writer is None or _writer.file is not sys.stderr:
        print(line, file=sys.stderr)  # noqa: T201 - the one line of a failed start
    else:
        _writer.write(f"{line}\n")


def finish() -> None:
    """Wait, for a moment at most, until all lines are written; to be called before the process ends."""
    if _writer is not None:
        _writer.finish()


def lines_dropped() -> int:
    """Return how many lines this process could not write."""
    return 0 if _writer is None else _writer.dropped


def configure(form: Literal["console", "json"], level: str, worker: int | None = None) -> None:
    """Send the log lines to stderr, as coloured text on a terminal, plain text elsewhere, or JSON.

    Args:
        form: text or JSON.
        level: the least that is logged.
        worker: number of the worker process, written into every line; None: it is none.
    """
    global _writer  # noqa: PLW0603 - a process has one stderr
    if _writer is None:
        atexit.register(finish)
    _writer = LineWriter(sys.stderr)
    processors: list[Processor] = [] if worker is None else [lambda _logger, _name, event: {**event, "worker": worker}]
    processors += [
        Limiter(),
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
        logger_factory=structlog.WriteLoggerFactory(file=cast("TextIO", _writer)),
    )
    logging.getLogger("optipmb").handlers = [_Library()]
    logging.getLogger("opentelemetry").handlers = [_Library()]


class _Library(logging.Handler):
    """Logs the warnings of libraries, which use Python's own logging."""

    def emit(self, record: logging.LogRecord) -> None:
        ours = record.name.startswith("optipmb")
        structlog.get_logger("optipmb_service").warning(
            "tracker_message" if ours else "traces_failed", text=record.getMessage()
        )
