"""The state of a session as bytes and back: whole or not at all.

The bytes are a head (magic, version, BLAKE2b digest of version and body) and a body, one msgpack map. Equal checkpoints
give equal bytes. Reading is total and bounded: it returns a checkpoint or raises `CheckpointError`; the digest is
compared before anything else is looked at. A service reads the versions that earlier ones wrote, and refuses later
ones by number.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import msgpack
import numpy as np

import optipmb
from optipmb_service.records import Counters
from optipmb_service.timing import Mark, Timeline

if TYPE_CHECKING:
    from numpy.typing import NDArray

VERSION: Final = 1
MAGIC: Final = b"OPTIPMB\0"
DIGEST: Final = 16
HEAD: Final = len(MAGIC) + 2 + DIGEST

_msgpack: Any = msgpack  # its type information is partial


class CheckpointError(ValueError):
    """The bytes are no checkpoint that this service can read; the text says why."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What a session is made of, between two frames. Everything in it is immutable."""

    stream: str
    session: str
    starts: int
    generation: int
    tracks: int
    parameters: optipmb.Parameters
    density: optipmb.Density
    timeline: Timeline
    last: Mark | None
    counters: Counters


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of a checkpoint; equal ones give equal bytes."""
    density = checkpoint.density
    body = {
        "stream": checkpoint.stream,
        "session": checkpoint.session,
        "starts": checkpoint.starts,
        "generation": checkpoint.generation,
        "tracks": checkpoint.tracks,
        "parameters": checkpoint.parameters.model_dump(mode="json"),
        "stamp_ns": density.stamp_ns,
        "next_id": density.next_id,
        "density": {name: _pack(column) for name, column in optipmb.columns_of(density).items()},
        "timeline": asdict(checkpoint.timeline) | {"seen": checkpoint.timeline.seen.to_bytes(128, "big")},
        "last": asdict(checkpoint.last) if checkpoint.last else None,
        "counters": asdict(checkpoint.counters),
    }
    return seal(_msgpack.packb(body))


def decode_checkpoint(data: bytes) -> Checkpoint:
    """Return the checkpoint that bytes hold.

    Raises:
        CheckpointError: torn, changed, of a later version, or not valid.
    """
    body = _msgpack.unpackb(_open(data))
    try:
        parameters = optipmb.parse_parameters(body["parameters"])
        columns = {name: _unpack(block) for name, block in body["density"].items()}
        timeline = body["timeline"]
        timeline |= {name: tuple(timeline[name]) if timeline[name] else None for name in ("floor", "processed")}
        timeline |= {"seen": int.from_bytes(timeline["seen"], "big"), "retired": tuple(timeline["retired"])}
        return Checkpoint(
            body["stream"],
            body["session"],
            body["starts"],
            body["generation"],
            body["tracks"],
            parameters,
            optipmb.density_of(body["stamp_ns"], body["next_id"], columns, len(parameters.classes)),
            Timeline(**timeline),
            Mark(**body["last"]) if body["last"] else None,
            Counters(**body["counters"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{type(error).__name__}: {error}") from error


def seal(body: bytes) -> bytes:
    """Return a body with the head that names its version and guards it."""
    return b"".join((MAGIC, VERSION.to_bytes(2, "big"), _digest(VERSION, body), body))


def _open(data: bytes) -> bytes:
    if len(data) < HEAD or data[: len(MAGIC)] != MAGIC:
        raise CheckpointError("no checkpoint: its first bytes are others")
    version = int.from_bytes(data[len(MAGIC) : len(MAGIC) + 2], "big")
    if version > VERSION:
        raise CheckpointError(f"version {version}: written by a newer service; this one reads versions up to {VERSION}")
    body = data[HEAD:]
    if data[len(MAGIC) + 2 : HEAD] != _digest(version, body):
        raise CheckpointError("torn or changed: the digest is that of other bytes")
    return body


def _digest(version: int, body: bytes) -> bytes:
    digest = hashlib.blake2b(version.to_bytes(2, "big"), digest_size=DIGEST, person=b"optipmb-check")
    digest.update(body)
    return digest.digest()


def _pack(column: NDArray[Any]) -> dict[str, Any]:
    little = np.ascontiguousarray(column, column.dtype.newbyteorder("<"))
    return {"dtype": little.dtype.str, "shape": list(column.shape), "data": little.tobytes()}


def _unpack(block: dict[str, Any]) -> NDArray[Any]:
    return np.frombuffer(block["data"], np.dtype(block["dtype"])).reshape(block["shape"])


def digest_of(checkpoint: Checkpoint) -> str:
    """Return 32 hexadecimal digits over all that later tracks depend on, which the counters are no part of."""
    plain = replace(checkpoint, counters=Counters())
    return hashlib.blake2b(encode_checkpoint(plain), digest_size=DIGEST).hexdigest()
