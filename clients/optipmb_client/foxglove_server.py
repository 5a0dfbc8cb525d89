"""What comes in, served live to Foxglove over a WebSocket: `optipmb watch --foxglove`."""

from typing import Self

import foxglove
from foxglove import Channel, Context
from optipmb_schemas import Detections, Message, Points, Problem, Tracks

from optipmb_client.errors import UsageError
from optipmb_client.foxglove_messages import FoxgloveMessages

_TOPICS: dict[type[Message], str] = {Tracks: "tracks", Detections: "detections", Points: "points", Problem: "problems"}


class FoxgloveServer:
    """A server that shows messages of any streams; a viewer that is too slow loses the oldest.

    Args:
        host: address to listen on.
        port: 0: any that is free.

    Raises:
        UsageError: the address cannot be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        self._context = Context()
        self._made = FoxgloveMessages()
        self._channels: dict[str, Channel] = {}
        try:
            self._server = foxglove.start_server(name="optipmb", host=host, port=port, context=self._context)
        except RuntimeError as error:
            raise UsageError(f"--foxglove-port {port}: cannot listen on {host}: {error}") from error
        self.address = f"ws://{host}:{self._server.port}"

    def show(self, message: Message) -> None:
        """Show a message at its stamp; of another type than streams have, nothing."""
        stream, stamp_ns = getattr(message, "stream", ""), getattr(message, "stamp_ns", None)
        for one in self._made.of(message):
            topic = f"/{stream}/{_TOPICS[type(message)]}{one.end}"
            if topic not in self._channels:
                self._channels[topic] = Channel(
                    topic, schema=one.schema, message_encoding=one.encoding, context=self._context
                )
            self._channels[topic].log(one.payload, log_time=stamp_ns)

    def close(self) -> None:
        """Stop serving."""
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
