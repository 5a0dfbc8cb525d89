"""Tracks from msgpack to protobuf without a model between them: a service has checked what it has published.

What is checked is what can be known without looking at the values: the structure, the types, and that each column has
the rows of the others and the bytes of its shape. A receiver that wants more has `from_proto`. Tracks in any form but
the service's own (JSON, other number types) are decoded as everywhere.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import prod
from typing import Any, Final, Self

from msgspec import UNSET
from msgspec.structs import asdict

from optipmb_schemas.blocks import DTYPES
from optipmb_schemas.codec import decode, encoding_of
from optipmb_schemas.decoder import DECODERS, REFUSED
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import Tracks
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import DTYPE_CODES, to_proto

__all__ = ["EncodedTracks", "transcode"]

_ENCODING: Final = encoding_of(Tracks)
_SCALARS: Final = tuple(name for name in Tracks.names if name not in Tracks.arrays)


@dataclass(frozen=True, slots=True)
class EncodedTracks:
    """The tracks of one frame in protobuf, and what tells this publication of them from others."""

    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    revision: int
    run: int
    payload: bytes
    """The message `Tracks`, serialized."""
    sensor: str = ""
    """Stream of the detections, where several share a session."""

    @classmethod
    def of(cls, proto: pb.Tracks, columns: bytes = b"") -> Self:
        """Return the tracks of a message, and of columns that are serialized already."""
        payload = proto.SerializeToString() + columns
        place = (proto.stream, proto.epoch, proto.seq, proto.stamp_ns)
        return cls(*place, proto.revision, proto.delivery.run, payload, proto.sensor)

    def message(self) -> pb.Tracks:
        """Return the message."""
        return pb.Tracks.FromString(self.payload)


def transcode(payload: bytes, *, encoding: str = "", limits: Limits = DEFAULT) -> EncodedTracks:
    """Return encoded tracks in protobuf, their columns as they are.

    Args:
        payload: msgpack or JSON.
        encoding: the Zenoh encoding of the sample.
        limits: what is accepted at most.

    Raises:
        MessageError: they are no tracks within the limits.
    """
    if encoding == _ENCODING and len(payload) <= limits.max_bytes:
        try:
            tracks = _tracks(DECODERS[Tracks](payload), limits)
        except REFUSED:
            tracks = None  # decoding says what is wrong, if anything is
        if tracks is not None:
            return tracks
    return EncodedTracks.of(to_proto(decode(payload, Tracks, encoding=encoding, limits=limits)))


def _tracks(fields: Any, limits: Limits) -> EncodedTracks | None:
    """Return the tracks of fields that are as a service writes them, else None.

    Fields that are not known here are of a newer version, and are left out.
    """
    scalars = {name: value for name in _SCALARS if (value := getattr(fields, name)) is not UNSET}
    if len(fields.labels) > limits.max_labels or None in scalars.values():
        return None
    (rows,), (horizons,) = fields.id.shape, fields.horizons.shape or (0,)
    if not (0 <= rows <= limits.max_tracks and 0 <= horizons <= limits.max_horizons):
        return None
    parts: list[bytes] = []
    for name, shape, size, prefix in _columns(rows, horizons, len(fields.labels)):
        block = getattr(fields, name)
        if block.shape is not None:  # else it is absent
            if block.shape != shape or len(block.data) != size:
                return None
            parts += (prefix, block.data)
    if "delivery" in scalars:
        scalars["delivery"] = {name: one for name, one in asdict(fields.delivery).items() if one is not UNSET}
    return EncodedTracks.of(pb.Tracks(**scalars), b"".join(parts))


@lru_cache(512)
def _columns(rows: int, horizons: int, classes: int) -> list[tuple[str, tuple[int, ...], int, bytes]]:
    """Return of each column name, shape, bytes, and what stands before them in the serialized message."""
    sizes, columns = {"N": rows, "H": horizons, "C": classes}, []
    for name, one in Tracks.arrays.items():
        shape = tuple(length if isinstance(length, int) else sizes[length] for length in one.shape)
        size = prod(shape) * DTYPES[one.dtype]
        proto: Any = pb.Tracks()
        getattr(proto, name).CopyFrom(pb.Array(dtype=DTYPE_CODES[one.dtype], shape=shape, data=bytes(size)))
        field: bytes = proto.SerializeToString()
        columns.append((name, shape, size, field[: len(field) - size]))
    return columns
