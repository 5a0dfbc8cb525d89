"""Recording streams from the network.

A thread per kind of message, small ones and clouds, moves messages into the file; once a second everything is
flushed. Of each stream the parameters in force are asked for and recorded too, when it appears and whenever its session
restarts: they explain the tracks. Parameters of a session that ended before the question are not known.
"""

import concurrent.futures
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from optipmb_client.errors import ClientError
from optipmb_client.incoming import Inbox
from optipmb_client.sessions import set_parameters
from optipmb_client.zenoh import Connection
from optipmb_schemas import PREFIX, Keys, MessageError, SessionParameters, Topic, Tracks, encode, encoding_of

from optipmb_tools.recordings.recording_file import RecordingWriter

SMALL: tuple[Topic, ...] = ("detections", "tracks", "problems")
SMALL_QUEUE = 16_384
CLOUD_QUEUE = 64  # a cloud has a few megabytes
FLUSH_S = 1.0
PARAMETERS_S = 2.0
ANSWERS_S = 4.0  # how long the end waits for answers: each of a thousand sessions may have a question open


@dataclass(frozen=True)
class Wanted:
    """Streams to record: their names, or patterns with `*` in the place of names."""

    patterns: Sequence[str]
    points: bool = True  # whether point clouds are recorded
    duration: float | None = None  # seconds; None: until it is stopped
    prefix: str = PREFIX  # of all keys


@dataclass
class Recording:
    """Result of recording."""

    path: Path
    messages: int = 0
    dropped: int = 0  # messages lost because the disk was too slow
    size: int = 0  # bytes of the file
    seconds: float = 0.0
    streams: dict[str, dict[str, int]] = field(default_factory=dict)  # messages of each topic, by stream


def record(
    connection: Connection,
    path: Path,
    wanted: Wanted,
    *,
    stop: threading.Event,
    on_flush: Callable[[Recording], None] = lambda _: None,
) -> Recording:
    """Record streams into a new file until `stop` is set, or for a duration.

    Messages that publishers and service still keep of the seconds before come first. `on_flush` is called about once a
    second.

    Raises:
        FileExistsError: There is such a file.
        OSError: It cannot be written, as on a full disk.
        MessageError: A pattern is none.
    """
    keys = Keys(wanted.prefix)
    topics = (*SMALL, "points") if wanted.points else SMALL
    chosen = [(topic, keys.matching(pattern, topic)) for topic in topics for pattern in wanted.patterns]
    about = {"made_by": f"optipmb {version('optipmb')}", "prefix": wanted.prefix, "streams": " ".join(wanted.patterns)}
    with RecordingWriter(path, about) as writer:
        begun = time.monotonic()
        task = _Task(connection, keys, writer)
        inboxes = {topic: Inbox(CLOUD_QUEUE if topic == "points" else SMALL_QUEUE) for topic in topics}
        subscriptions = [connection.subscribe(key, inboxes[topic]) for topic, key in chosen]
        threads = [threading.Thread(target=task.drain, args=(inbox, stop), daemon=True) for inbox in inboxes.values()]
        for thread in threads:
            thread.start()
        result = Recording(path)

        def count() -> None:
            result.size, result.seconds = writer.flush(), time.monotonic() - begun
            result.messages, result.dropped = writer.messages, sum(inbox.dropped for inbox in inboxes.values())
            on_flush(result)

        try:
            ends = float("inf") if wanted.duration is None else begun + wanted.duration
            while not stop.is_set() and (left := ends - time.monotonic()) > 0.0:
                stop.wait(min(FLUSH_S, left))
                count()
        finally:
            for subscription in subscriptions:
                subscription.close()
            for inbox in inboxes.values():
                inbox.close()
            for thread in threads:
                thread.join()  # it ends when the messages that wait are in the file
            task.answers_end = time.monotonic() + ANSWERS_S
            task.questions.shutdown()
        if task.failure is not None:
            raise task.failure
        count()
    result.size = path.stat().st_size
    result.streams = task.streams
    return result


class _Task:
    """State shared by the threads of one recording."""

    def __init__(self, connection: Connection, keys: Keys, writer: RecordingWriter) -> None:
        self._connection = connection
        self._keys = keys
        self._writer = writer
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._sessions: dict[str, str] = {}
        self._lock = threading.Lock()
        self.answers_end = math.inf  # monotonic
        self.questions = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="parameters")
        self.streams: dict[str, dict[str, int]] = {}
        self.failure: OSError | None = None

    def drain(self, inbox: Inbox, stop: threading.Event) -> None:
        """Move messages into the file until the inbox is closed and empty, or the file cannot be written."""
        try:
            while (arrival := inbox.get()) is not None:
                try:
                    self._keys.stream_of(arrival.key)
                except MessageError:
                    continue  # a key with a name that no stream has
                message = self._add(arrival.key, arrival.payload, arrival.encoding, arrival.monotonic_ns)
                if isinstance(message, Tracks) and self._sessions.get(message.stream) != message.session:
                    self._sessions[message.stream] = message.session
                    self.questions.submit(self._ask, message.stream, message.session)
        except OSError as error:
            self.failure = error
            stop.set()

    def _ask(self, stream: str, session: str) -> None:
        prefix = self._keys.prefix
        patience_s = min(PARAMETERS_S, self.answers_end - time.monotonic())
        if patience_s <= 0.0:
            return
        try:
            answer = set_parameters(self._connection, stream, SessionParameters(), prefix=prefix, patience_s=patience_s)
        except ClientError:
            return  # the service has gone; its messages are recorded all the same
        if answer.session == session:  # others are of no session, or of a later one
            key = self._keys.query(stream, "parameters")
            self._add(key, encode(answer), encoding_of(answer), time.monotonic_ns())

    def _add(self, key: str, payload: bytes, encoding: str, monotonic_ns: int) -> object:
        message = self._writer.add(key, payload, encoding, monotonic_ns + self._offset_ns)
        stream, topic = self._keys.stream_of(key), key.rpartition("/")[2]
        with self._lock:
            counts = self.streams.setdefault(stream, {})
            counts[topic] = counts.get(topic, 0) + 1
        return message
