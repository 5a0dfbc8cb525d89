"""A network between processes that takes its time, and can be cut: bytes on their way wait until it is whole again."""

import contextlib
import queue
import socket
import threading
import time
from typing import Self

from routers import free_endpoint

CHUNK = 1 << 16

LIMIT_S = 120.0
"""No test cuts it for so long."""


class Proxy:
    """Takes connections and passes their bytes on.

    Args:
        target: where to, as host and port, after the last slash of an endpoint.
        delay_s: how long each byte is on its way, in either direction.
    """

    def __init__(self, target: str, delay_s: float = 0.0) -> None:
        host, _, port = target.rpartition("/")[2].rpartition(":")
        self._target = host, int(port)
        self._delay_s = delay_s
        self._whole = threading.Event()
        self._whole.set()
        self._ways: list[threading.Event] = []
        """Of each connection, whether its bytes are passed on."""
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self.delivered = 0
        """Bytes passed on to those that connected here."""
        self.accepted = 0
        """Connections so far."""
        self.endpoint = free_endpoint()
        self.address = self.endpoint.removeprefix("tcp/")

    def __enter__(self) -> Self:
        host, _, port = self.address.partition(":")
        listener = socket.create_server((host, int(port)))
        self._sockets.append(listener)
        self._start(self._accept, listener)
        return self

    def __exit__(self, *_: object) -> None:
        self._whole.set()
        for way in self._ways:
            way.set()
        self._sockets[0].shutdown(socket.SHUT_RDWR)
        self._threads[0].join(60)  # nothing is accepted from here on
        for one in self._sockets[1:]:
            with contextlib.suppress(OSError):  # the other side has gone
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads[1:]:
            thread.join(60)
        for one in self._sockets:
            one.close()

    def cut(self) -> None:
        """Pass nothing on from now on; no connection is closed, as when a cable is pulled."""
        self._whole.clear()

    def mend(self) -> None:
        """Forward waiting and new bytes."""
        self._whole.set()

    def strand(self) -> None:
        """Pass nothing of the connections that there are on, for ever, as a gateway that has forgotten them."""
        for way in self._ways:
            way.clear()

    def _start(self, run: object, *arguments: object) -> None:
        thread = threading.Thread(target=run, args=arguments)  # type: ignore[arg-type]  # of the methods below
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                near, _ = listener.accept()
                self.accepted += 1
                self._whole.wait(LIMIT_S)
                self._sockets.append(near)
                try:
                    far = socket.create_connection(self._target)
                except OSError:  # no listener
                    near.shutdown(socket.SHUT_RDWR)
                    continue
                self._sockets.append(far)
                passes = threading.Event()
                passes.set()
                self._ways.append(passes)
                for source, sink in ((near, far), (far, near)):
                    source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    way: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
                    self._start(self._take, source, way)
                    self._start(self._give, sink, way, passes, sink is near)

    def _take(self, source: socket.socket, way: queue.SimpleQueue[tuple[float, bytes]]) -> None:
        data = b"-"
        while data:
            try:
                data = source.recv(CHUNK)
            except OSError:
                data = b""
            way.put((time.monotonic() + self._delay_s, data))

    def _give(
        self,
        sink: socket.socket,
        way: queue.SimpleQueue[tuple[float, bytes]],
        passes: threading.Event,
        counts: bool,  # noqa: FBT001 - of a thread
    ) -> None:
        with contextlib.suppress(OSError):  # the other side has gone
            while True:
                due, data = way.get()
                time.sleep(max(0.0, due - time.monotonic()))  # the length of the way, not a wait for anything
                self._whole.wait(LIMIT_S)
                passes.wait(LIMIT_S)
                if not data:
                    sink.shutdown(socket.SHUT_WR)
                    return
                sink.sendall(data)
                self.delivered += len(data) if counts else 0
