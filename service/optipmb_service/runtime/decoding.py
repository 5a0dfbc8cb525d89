"""From a packet to the message that it holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import optipmb_schemas as schemas

if TYPE_CHECKING:
    from optipmb_service.runtime.ports import Packet


def message_of(
    packet: Packet, kind: type[schemas.Detections | schemas.Points], stream: str, limits: schemas.Limits
) -> schemas.Detections | schemas.Points:
    """Return the message of a packet.

    Args:
        packet: as it came.
        kind: the message that belongs on its key.
        stream: the stream of its key.
        limits: what is accepted at most.

    Raises:
        MessageError: it is none, or not one of this stream.
    """
    if packet.payload is None:
        raise schemas.MessageError("too_large", "", f"at most {limits.max_bytes} bytes", f"{packet.size} bytes")
    message = schemas.decode(packet.payload, kind, encoding=packet.encoding, limits=limits)
    if message.stream != stream:
        raise schemas.MessageError("invalid_value", "stream", repr(stream), repr(message.stream))
    return message
