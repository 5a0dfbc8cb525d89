"""Texts of readers of the JSON interface, with a limit for each wait: keep-alives and pings do not prolong it."""

import time
from collections.abc import Iterable, Iterator

from websocket import ABNF, WebSocket, WebSocketConnectionClosedException

LIMIT_S = 60.0


def texts(response: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the data of server-sent events."""
    ends = time.monotonic() + LIMIT_S
    for line in response:
        if line.startswith(b"data: "):
            yield line[6:-1]
            ends = time.monotonic() + LIMIT_S
        assert time.monotonic() < ends, "nothing but keep-alives"


def received(connection: WebSocket) -> str | bytes:
    """Return the next message of a WebSocket."""
    ends = time.monotonic() + LIMIT_S
    while True:
        opcode, data = connection.recv_data(control_frame=True)
        if opcode == ABNF.OPCODE_CLOSE:
            raise WebSocketConnectionClosedException("closed")
        if opcode in {ABNF.OPCODE_TEXT, ABNF.OPCODE_BINARY}:
            return data.decode() if opcode == ABNF.OPCODE_TEXT else bytes(data)
        assert time.monotonic() < ends, "nothing but pings"
