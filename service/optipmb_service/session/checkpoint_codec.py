"""The state of a session as bytes and back: whole or not at all.

The bytes are a head (magic, version, next ids, the first 16 bytes of the SHA-256 digest of these and the body) and a
body, one msgpack map. Equal checkpoints give equal bytes. Reading is total and bounded: it returns a checkpoint or
raises `CheckpointError`, and the digest is compared before anything else is looked at. There is one version; others are
refused by number, with the next ids. `checkpoint_reading` reads the body.

What depends on how messages were delivered (duplicates, the revisions of corrected tracks, crashes) is kept, but is no
state: `state_bytes` leaves it out, so that two sessions that took the same frames can be compared.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import msgspec
import optipmb_schemas as schemas

import optipmb
from optipmb_service.session.checkpoint import CheckpointError
from optipmb_service.session.checkpoint_reading import read_body
from optipmb_service.session.values import MAX_COUNT, Deliveries, Lineage

if TYPE_CHECKING:
    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.state import FilterState, ProcessedFrame

VERSION: Final = 1
MAGIC: Final = b"OPTIPMB\0"
DIGEST: Final = 16
_START: Final = MAGIC + VERSION.to_bytes(2, "big")
_IDS: Final = struct.Struct(">QQ")
"""Lives of the stream and next track id. All versions have them here: a release that cannot read a checkpoint must not
give out the ids of its session again."""
HEAD: Final = len(_START) + _IDS.size + DIGEST
MAX_BYTES: Final = 2**28
MAX_PROFILES: Final = 64
"""Profiles whose form in checkpoints is remembered."""

_encode: Final = msgspec.msgpack.Encoder(order="deterministic").encode
"""Writes records by their fields, maps and sets in the order of their keys."""
_profiles: dict[int, tuple[optipmb.Parameters, bytes]] = {}
"""The profiles that were written last, by their ids."""


def encode_checkpoint(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of a checkpoint; equal ones give equal bytes."""
    head = checkpoint.head
    return seal(_encode(_body(checkpoint)), Lineage(head.starts, head.density.next_id))


def state_bytes(checkpoint: Checkpoint) -> bytes:
    """Return the bytes of what does not depend on how messages were delivered."""
    window = tuple(replace(one, revision=0) for one in checkpoint.window)
    bare = replace(checkpoint, window=window, deliveries=Deliveries(), newest_cloud_ns={}, run=0, software="")
    return encode_checkpoint(bare)


def digest_of(checkpoint: Checkpoint) -> str:
    """Return 32 hexadecimal digits over all that later tracks depend on, which counts of messages are no part of."""
    return hashlib.blake2b(state_bytes(checkpoint), digest_size=DIGEST).hexdigest()


def decode_checkpoint(data: bytes) -> Checkpoint:
    """Return the checkpoint that bytes hold.

    Raises:
        CheckpointError: torn, changed, of another version, or not valid.
    """
    try:
        return read_body(_open(data))
    except (schemas.MessageError, optipmb.OptipmbError) as error:
        raise CheckpointError(str(error)) from error


def seal(body: bytes, lineage: Lineage) -> bytes:
    """Return a body with the head that names its version, holds the next ids and guards it."""
    start = _START + _IDS.pack(lineage.starts, lineage.next_id)
    return b"".join((start, _digest(start, body), body))


def _open(data: bytes) -> bytes:
    if len(data) < HEAD or data[: len(MAGIC)] != MAGIC:
        raise CheckpointError("no checkpoint: its first bytes are others")
    if len(data) > MAX_BYTES:
        raise CheckpointError(f"{len(data)} bytes: more than a checkpoint has")
    start, body = data[: HEAD - DIGEST], data[HEAD:]
    if data[HEAD - DIGEST : HEAD] != _digest(start, body):
        raise CheckpointError("torn or changed: the digest is that of other bytes")
    version = int.from_bytes(start[len(MAGIC) : len(_START)], "big")
    if version != VERSION:
        raise CheckpointError(
            f"version {version}: expected {VERSION}, the only one of this release; start the release that wrote it",
            Lineage(*(min(one, MAX_COUNT) for one in _IDS.unpack_from(start, len(_START)))),
        )
    return body


def _digest(start: bytes, body: bytes) -> bytes:
    # Processors have instructions for SHA-256: it takes a third of the time that BLAKE2b takes.
    digest = hashlib.sha256(start)
    digest.update(body)
    return digest.digest()[:DIGEST]


# Writing


def _body(checkpoint: Checkpoint) -> dict[str, Any]:
    return {
        "software": checkpoint.software,
        "stream": checkpoint.stream,
        "parameters": _packed_profile(checkpoint.parameters),
        "fused": checkpoint.fused,
        "cloud_wait_ns": checkpoint.cloud_wait_ns,
        "quarantine": checkpoint.quarantine,
        "epochs": {
            name: [(seen.epoch, seen.highest, _mask(seen.mask)) for seen in epochs]
            for name, epochs in checkpoint.seen.items()
        },
        "base": _state(checkpoint.base),
        "window": [
            {
                "detections": one.detections,
                "points": _packed_cloud(one),
                "missed": one.missed,
                "revision": one.revision,
            }
            for one in checkpoint.window
        ],
        # Without a window the present is its beginning.
        "head": _state(checkpoint.head) if checkpoint.window else None,
        "deliveries": checkpoint.deliveries,
        "newest_cloud_ns": checkpoint.newest_cloud_ns,
        "run": checkpoint.run,
    }


def _packed_profile(parameters: optipmb.Parameters) -> bytes:
    """Return a profile as bytes, classes in the order of their indices; sessions write the same few every second."""
    known = _profiles.get(id(parameters))
    if known is None or known[0] is not parameters:
        if len(_profiles) >= MAX_PROFILES:
            _profiles.clear()
        known = _profiles[id(parameters)] = parameters, msgspec.msgpack.encode(parameters.model_dump(mode="json"))
    return known[1]


def _packed_cloud(one: ProcessedFrame) -> bytes | None:
    if one.points is not None and not one.packed:
        one.packed.append(schemas.encode(one.points))
    return one.packed[0] if one.packed else None


def _mask(mask: int) -> bytes:
    return mask.to_bytes((mask.bit_length() + 7) // 8, "big")


def _state(state: FilterState) -> dict[str, Any]:
    density = state.density
    return {
        "stamp_ns": density.stamp_ns,
        "next_id": density.next_id,
        "density": optipmb.bytes_of(density),
        "session": state.session,
        "starts": state.starts,
        "generation": state.generation,
        "last": state.last,
        "tracks": state.tracks,
        "counts": state.counts,
        "sensors": state.sensors,
    }
