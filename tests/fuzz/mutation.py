"""Changes to structured bytes: a value somewhere in a map is replaced, and the map is written again.

Flipping bytes of msgpack or JSON mostly gives neither, and the search would go no further than the first look at the
bytes. Maps inside of byte strings, such as the messages in a checkpoint, are changed in the same way.
"""

import json
import random
import struct
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

import msgpack

Mutate = Callable[[bytes, int], bytes]

_msgpack: Any = msgpack  # its type information is partial

WHOLE = (0, 1, -1, 2, 31, 255, 256, 1023, 1024, 2**31 - 1, 2**31, 2**53, 2**62, 2**63 - 2, 2**63 - 1, 2**63, -(2**63))
REAL = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-9, 1e9, 1e30, 1e154, 1.7e308, -1e300, float("nan"), float("inf"))
TEXTS = (
    "",
    "0" * 32,
    "F" * 32,
    "f" * 32 + "\n",
    "a/b/c",
    "a/b/c/d",
    "owner/b/c",
    "*",
    "\x01",
    "ü",
    "x" * 65,
    "x" * 501,
)
KEPT = (None, True, False, [], {}, b"", b"\0" * 16, *WHOLE, *REAL, *TEXTS)


def mutated(data: bytes, size: int, seed: int, mutate: Mutate, *, head: int) -> bytes:
    """Return other bytes.

    Args:
        data: `head` bytes that say what follows, then a map as msgpack or JSON.
        size: most bytes.
        seed: the same seed gives the same change, but for what `mutate` does.
        mutate: the changes to plain bytes.
        head: how many bytes to leave as they are.
    """
    chance = random.Random(seed)
    read = _read(data[head:])
    if read is None or chance.random() < 0.2:
        return mutate(data, size)
    tree, write = read
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        _change(tree, chance, mutate)
    try:
        made = data[:head] + write(tree)
    except (ValueError, OverflowError, TypeError, RecursionError):  # no such map can be written
        return mutate(data, size)
    return made if len(made) <= size else mutate(data, size)


def _read(data: bytes) -> tuple[Any, Callable[[Any], bytes]] | None:
    """Return the map that bytes hold, and what writes it; None: they hold none."""
    for read, write in ((_msgpack.unpackb, _msgpack.packb), (json.loads, _dumped)):
        try:
            tree = read(data)
        except (ValueError, TypeError, RecursionError):
            continue
        if isinstance(tree, dict) and tree:
            return tree, write
    return None


def _dumped(tree: Any) -> bytes:
    return json.dumps(tree).encode()


def _change(tree: Any, chance: random.Random, mutate: Mutate) -> None:
    places = list(_places(tree))
    if not places:
        return
    inside, key = chance.choice(places)
    way = chance.random()
    if way < 0.06:
        del inside[key]
    elif way < 0.1 and isinstance(inside, list):
        inside.insert(key, deepcopy(inside[key]))
    elif way < 0.16:
        other, name = chance.choice(places)
        inside[key] = deepcopy(other[name])
    else:
        inside[key] = _another(inside[key], chance, mutate)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    keys: Any = list(tree) if isinstance(tree, dict) else range(len(tree))
    for key in keys:
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from _places(tree[key])


def _another(value: Any, chance: random.Random, mutate: Mutate) -> Any:
    """Return a value in place of another, mostly of its kind."""
    others: tuple[Any, ...] = KEPT
    if chance.random() < 0.1:
        pass  # any kind
    elif isinstance(value, bool):
        others = (not value,)
    elif isinstance(value, int):
        others = (value + 1, value - 1, value * 2, *WHOLE)
    elif isinstance(value, float):
        others = (value / 2, value * 2, *REAL)
    elif isinstance(value, str):
        other = mutate(value.encode(errors="replace"), 4 * len(value) + 8).decode("latin-1")
        others = (value[:-1], value + "0", other, *TEXTS)
    elif isinstance(value, bytes):
        others = (_other_bytes(value, chance, mutate),)
    return deepcopy(chance.choice(others))


def _other_bytes(value: bytes, chance: random.Random, mutate: Mutate) -> bytes:
    read = _read(value)
    if read is not None:
        tree, write = read
        _change(tree, chance, mutate)
        return write(tree)
    if value and len(value) % 8 == 0 and chance.random() < 0.7:  # numbers of an array
        at = 8 * chance.randrange(len(value) // 8)
        if chance.random() < 0.5:
            number = struct.pack("<d", chance.choice(REAL))
        else:
            number = (chance.choice(WHOLE) % 2**64).to_bytes(8, "little")
        return value[:at] + number + value[at + 8 :]
    return mutate(value, len(value) + 8)
