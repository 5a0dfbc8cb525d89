"""Brokers of MQTT: one that a test speaks for, and Mosquitto, where it is installed."""

import asyncio
import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import pytest
from routers import free_endpoint

CONNECT, CONNACK, PUBLISH, PUBACK, SUBSCRIBE, DISCONNECT = 0x10, 0x20, 0x30, 0x40, 0x80, 0xE0
NOT_ALLOWED, TAKEN_OVER = 135, 142


@dataclass(frozen=True)
class Message:
    topic: str
    payload: bytes
    qos: int
    retain: bool


@dataclass
class Broker:
    """Receives published messages, in the protocol versions that it knows; reads no subscriptions.

    Attributes:
        versions: the versions of the protocol that it knows: 4 is 3.1.1.
        silent: whether it confirms nothing.
        most: size of the largest packet that it takes, 0: any; a larger one ends the connection.
        says_most: whether it says so.
        denied: ends of topics that it refuses.
        kinds: of the packets that came.
    """

    versions: tuple[int, ...] = (4, 5)
    silent: bool = False
    most: int = 0
    says_most: bool = True
    denied: tuple[str, ...] = ()
    kinds: list[int] = field(default_factory=list)
    connections: int = 0
    messages: list[Message] = field(default_factory=list)
    wills: list[str] = field(default_factory=list)
    refused: list[int] = field(default_factory=list)
    port: int = 0

    async def __aenter__(self) -> Self:
        self._writers: set[asyncio.StreamWriter] = set()
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for writer in self._writers:
            writer.close()
        await asyncio.sleep(0)

    def take_over(self) -> None:
        """End the connections, as for another client of the same name."""
        for writer in self._writers:
            writer.write(bytes([DISCONNECT, 1, TAKEN_OVER]))
            writer.close()

    def of(self, end: str) -> list[bytes]:
        return [one.payload for one in self.messages if one.topic.endswith(end)]

    async def wait(self, count: int, end: str) -> list[bytes]:
        async with asyncio.timeout(60):
            while len(self.of(end)) < count:  # noqa: ASYNC110 - it runs on the loop of the test
                await asyncio.sleep(0.01)
        return self.of(end)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                kind = (await reader.readexactly(1))[0]
                body = await reader.readexactly(await _length(reader))
                self.kinds.append(kind & 0xF0)
                if self.most and len(body) > self.most:
                    break
                if kind == CONNECT:
                    self.connections += 1
                    version = body[6]
                    if version not in self.versions:
                        self.refused.append(version)
                        writer.write(bytes([CONNACK, 3, 0, 0x84, 0]))
                        break
                    says = b"\x27" + self.most.to_bytes(4) if self.most and self.says_most else b""
                    about = bytes([0, 0, len(says)]) + says if version == 5 else bytes(2)
                    writer.write(bytes([CONNACK, len(about)]) + about)
                elif kind & 0xF0 == PUBLISH:
                    self._take(kind, body, version, writer)
                elif kind == DISCONNECT:
                    break
        writer.close()

    def _take(self, kind: int, body: bytes, version: int, writer: asyncio.StreamWriter) -> None:
        qos = kind >> 1 & 3
        end = 2 + int.from_bytes(body[:2], "big")
        topic, rest = body[2:end].decode(), body[end:]
        is_denied = topic.endswith(self.denied)
        if qos and not self.silent:
            number = rest[:2]
            writer.write(
                bytes([PUBACK, 3]) + number + bytes([NOT_ALLOWED]) if is_denied else bytes([PUBACK, 2]) + number
            )
        if is_denied:
            return
        rest = rest[2:] if qos else rest
        payload = rest[1 + rest[0] :] if version == 5 else rest
        self.messages.append(Message(topic, payload, qos, bool(kind & 1)))


async def _length(reader: asyncio.StreamReader) -> int:
    length = shift = 0
    while (byte := (await reader.readexactly(1))[0]) & 0x80:
        length |= (byte & 0x7F) << shift
        shift += 7
    return length | byte << shift


@contextlib.contextmanager
def mosquitto(folder: Path) -> Iterator[str]:
    program = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin") or shutil.which("mosquitto")
    if program is None:
        pytest.skip("Debian's package mosquitto is not installed")
    port = free_endpoint().rpartition(":")[2]
    (folder / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    process = subprocess.Popen([program, "-c", str(folder / "mosquitto.conf")], stderr=subprocess.DEVNULL)
    try:
        yield f"mqtt://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(60)
