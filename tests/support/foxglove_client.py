"""A client of Foxglove's WebSocket protocol: what the server advertises, and the messages of chosen topics, decoded."""

import base64
import json
import struct
import time
from typing import Any

import websocket
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from readers import received

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE = 1
PATIENCE_S = 10.0


class FoxgloveClient:
    """A connection to a server.

    Args:
        address: as `ws://127.0.0.1:8765`.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._connect()

    def collect(self, topics: set[str]) -> dict[str, tuple[int, Any]]:
        """Subscribe to topics as they are advertised; give log time and content of the first message of each."""
        found: dict[str, tuple[int, Any]] = {}
        patient_until_s = time.monotonic() + PATIENCE_S
        ends = time.monotonic() + 6 * PATIENCE_S
        while set(found) != topics:
            assert time.monotonic() < ends, f"no message of {topics - set(found)}"
            if time.monotonic() > patient_until_s:
                # Once in hundreds of runs the server's library sent nothing of a channel that it had just announced.
                self.close()
                self._connect()
                patient_until_s = time.monotonic() + PATIENCE_S
            data = received(self._socket)
            if isinstance(data, str):
                about = json.loads(data)
                if about["op"] == "advertise":
                    new = [one for one in about["channels"] if one["topic"] in topics]
                    self.channels |= {one["id"]: one for one in new}
                    wanted = [{"id": one["id"], "channelId": one["id"]} for one in new]
                    self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            elif data[0] == MESSAGE:
                number, log_time = struct.unpack_from("<IQ", data, 1)
                channel = self.channels[number]
                found.setdefault(channel["topic"], (log_time, _decoded(channel, data[13:])))
        return found

    def _connect(self) -> None:
        self._socket = websocket.create_connection(self._address, timeout=30, subprotocols=[SUBPROTOCOL])
        self.channels: dict[int, dict[str, Any]] = {}

    def close(self) -> None:
        self._socket.close()


def _decoded(channel: dict[str, Any], payload: bytes) -> Any:
    if channel["encoding"] == "json":
        return json.loads(payload)
    schema = Schema(1, base64.b64decode(channel["schema"]), channel["schemaEncoding"], channel["schemaName"])
    decoder = DecoderFactory().decoder_for(channel["encoding"], schema)
    assert decoder is not None
    return decoder(payload)
