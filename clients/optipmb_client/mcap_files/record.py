"""Recording streams from the network.

A thread per kind of message, small ones and clouds, moves what comes into the file; once a second everything is
flushed. Of each stream the parameters in force are asked for and recorded too, when it appears and whenever its session
starts anew: they belong to what made the tracks. Those of a session that ended before it could be asked are not known.
"""

import concurrent.futures
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from optipmb_schemas import PREFIX, Keys, MessageError, SessionParameters, Topic, Tracks, encode, encoding_of

from optipmb_client.errors import ClientError
from optipmb_client.incoming import Inbox
from optipmb_client.mcap_files.writing import RecordingWriter
from optipmb_client.sessions import set_parameters
from optipmb_client.zenoh import Connection

SMALL: tuple[Topic, ...] = ("detections", "tracks", "problems")
SMALL_QUEUE = 16_384
CLOUD_QUEUE = 64  # a cloud has a few megabytes
FLUSH_S = 1.0
PARAMETERS_S = 2.0


@dataclass
class Recording:
    """What recording gave.

    Attributes:
        path: The file.
        messages: Messages in it.
        dropped: Messages lost because the disk was too slow.
        size: Bytes of the file.
        seconds: How long it took.
        streams: Messages of each topic, by stream.
    """

    path: Path
    messages: int = 0
    dropped: int = 0
    size: int = 0
    seconds: float = 0.0
    streams: dict[str, dict[str, int]] = field(default_factory=dict)


def record(  # noqa: PLR0913  one argument per decision of the caller
    connection: Connection,
    patterns: Sequence[str],
    path: Path,
    *,
    stop: threading.Event,
    points: bool = True,
    duration: float | None = None,
    prefix: str = PREFIX,
    about: dict[str, str] | None = None,
    on_flush: Callable[[Recording], None] = lambda _: None,
) -> Recording:
    """Record the streams that match one of the patterns until `stop` is set, or for `duration` seconds.

    What the publishers and the service still keep of the seconds before comes first.

    Args:
        connection: To the service or its router.
        patterns: Names of streams, or patterns with `*` in the place of names.
        path: The file to write; it must not be there yet.
        stop: Ends the recording.
        points: Whether point clouds are recorded.
        duration: Seconds after which it ends.
        prefix: First part of all keys.
        about: What is said of the recording in the file.
        on_flush: Called about once a second.

    Raises:
        FileExistsError: There is such a file.
        OSError: It cannot be written, as on a full disk.
        MessageError: A pattern is none.
    """
    keys = Keys(prefix)
    topics = (*SMALL, "points") if points else SMALL
    wanted = {topic: [keys.matching(pattern, topic) for pattern in patterns] for topic in topics}
    with RecordingWriter(path, about) as writer:
        begun = time.monotonic()
        task = _Task(connection, keys, writer)
        inboxes = {topic: Inbox(CLOUD_QUEUE if topic == "points" else SMALL_QUEUE) for topic in topics}
        subscriptions = [connection.subscribe(key, inboxes[topic]) for topic in topics for key in wanted[topic]]
        threads = [threading.Thread(target=task.drain, args=(inbox, stop), daemon=True) for inbox in inboxes.values()]
        for thread in threads:
            thread.start()
        result = Recording(path)

        def count() -> None:
            result.size, result.seconds = writer.flush(), time.monotonic() - begun
            result.messages, result.dropped = writer.messages, sum(inbox.dropped for inbox in inboxes.values())
            on_flush(result)

        try:
            while not stop.is_set() and (duration is None or time.monotonic() - begun < duration):
                left = FLUSH_S if duration is None else duration - (time.monotonic() - begun)
                stop.wait(max(0.0, min(FLUSH_S, left)))
                count()
        finally:
            for subscription in subscriptions:
                subscription.close()
            for inbox in inboxes.values():
                inbox.close()
            for thread in threads:
                thread.join()
            task.finish()
        if task.failure is not None:
            raise task.failure
        count()
    result.size = path.stat().st_size
    result.streams = task.streams
    return result


class _Task:
    """What the threads of one recording share."""

    def __init__(self, connection: Connection, keys: Keys, writer: RecordingWriter) -> None:
        self._connection = connection
        self._keys = keys
        self._writer = writer
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._sessions: dict[str, str] = {}
        self._questions = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="parameters")
        self._lock = threading.Lock()
        self.streams: dict[str, dict[str, int]] = {}
        self.failure: OSError | None = None

    def drain(self, inbox: Inbox, stop: threading.Event) -> None:
        """Move messages into the file until the inbox is closed and empty, or the file cannot be written."""
        try:
            self._drain(inbox)
        except OSError as error:
            self.failure = error
            stop.set()

    def _drain(self, inbox: Inbox) -> None:
        while (arrival := inbox.get()) is not None:
            try:
                self._keys.stream_of(arrival.key)
            except MessageError:
                continue  # a key with a name that no stream has
            received_ns = arrival.monotonic_ns + self._offset_ns
            message = self._writer.add(arrival.key, arrival.payload, arrival.encoding, received_ns)
            self._count(arrival.key)
            if isinstance(message, Tracks) and self._sessions.get(message.stream) != message.session:
                self._sessions[message.stream] = message.session
                self._questions.submit(self._ask, message.stream, message.session)

    def finish(self) -> None:
        """Wait for the answers that are still under way."""
        self._questions.shutdown()

    def _ask(self, stream: str, session: str) -> None:
        try:
            answer = set_parameters(
                self._connection, stream, SessionParameters(), prefix=self._keys.prefix, patience_s=PARAMETERS_S
            )
        except ClientError:
            return  # the service has gone; its messages are recorded all the same
        if answer.session != session:
            return  # of no session, or of a later one: these tracks were made with others
        key = self._keys.query(stream, "parameters")
        self._writer.add(key, encode(answer), encoding_of(answer), time.monotonic_ns() + self._offset_ns)
        self._count(key)

    def _count(self, key: str) -> None:
        stream, topic = self._keys.stream_of(key), key.rpartition("/")[2]
        with self._lock:
            counts = self.streams.setdefault(stream, {})
            counts[topic] = counts.get(topic, 0) + 1
