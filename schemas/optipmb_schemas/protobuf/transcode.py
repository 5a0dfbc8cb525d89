"""Tracks from msgpack to protobuf without a model between them: a service has checked what it has published.

What is checked is what can be told without looking at the values: the structure, the types, and that each column has
the rows of the others and the bytes of its shape. A receiver that wants more has `from_proto`. Tracks in any form but
the service's own (JSON, other number types) are decoded as everywhere.
"""

from math import prod
from typing import Any, Final

import msgpack

from optipmb_schemas.blocks import DTYPES
from optipmb_schemas.codec import decode, encoding_of
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import Tracks
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import DTYPE_CODES, to_proto
from optipmb_schemas.structure import check_msgpack

__all__ = ["transcode"]

_ENCODING: Final = encoding_of(Tracks)
_NAMES: Final = frozenset(Tracks.names)
_REQUIRED: Final = frozenset(name for name, info in Tracks.model_fields.items() if info.is_required())
_COLUMNS: Final = [
    (name, one.dtype, DTYPE_CODES[dtype], list(one.shape[1:]), prod(map(int, one.shape[1:])) * dtype.itemsize)
    for name, one in Tracks.arrays.items()
    for dtype in (DTYPES[one.dtype],)
]
"""Of each array field: name, number type and its code in protobuf, shape of a row, and bytes of a row."""

_msgpack: Any = msgpack  # its type information is partial


def transcode(payload: bytes, *, encoding: str = "", limits: Limits = DEFAULT) -> pb.Tracks:
    """Return encoded tracks in protobuf, their columns as they are.

    Args:
        payload: msgpack or JSON.
        encoding: the Zenoh encoding of the sample.
        limits: what is accepted at most.

    Raises:
        MessageError: they are no tracks within the limits.
    """
    if encoding == _ENCODING and len(payload) <= limits.max_bytes:
        check_msgpack(payload, limits)
        try:
            tracks = _tracks(_msgpack.unpackb(payload), limits)
        except (AttributeError, KeyError, IndexError, TypeError, ValueError):
            tracks = None  # decoding says what is wrong, if anything is
        if tracks is not None:
            return tracks
    proto: pb.Tracks = to_proto(decode(payload, Tracks, encoding=encoding, limits=limits))
    return proto


def _tracks(fields: Any, limits: Limits) -> pb.Tracks | None:
    """Return the tracks of fields that are as a service writes them, else None."""
    # Fields that nobody here knows are of a newer version.
    made = {name: value for name, value in fields.items() if name in _NAMES and value is not None}
    if not made.keys() >= _REQUIRED or len(made["labels"]) > limits.max_labels:
        return None
    (rows,) = fields["id"]["shape"]
    if rows > limits.max_tracks:
        return None
    for name, dtype, code, tail, size in _COLUMNS:
        block = made.get(name)
        if block is not None:
            shape, data = block["shape"], block["data"]
            if block["dtype"] != dtype or shape != [rows, *tail] or len(data) != rows * size:
                return None
            made[name] = {"dtype": code, "shape": shape, "data": data}
    return pb.Tracks(**made)
