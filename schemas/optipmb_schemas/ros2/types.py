"""Message types of ROS 2: CDR bytes to messages and back, definitions and hashes of types.

A message is an object with the fields of its type; arrays of numbers are numpy arrays. The library is rosbags: pure
Python, maintained, Apache-2.0, and it needs no ROS.
"""

import functools
from collections.abc import Mapping
from typing import Any, Final

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from optipmb_schemas.errors import MessageError, cut
from optipmb_schemas.ros2.definitions import DEFINITIONS

__all__ = ["Types", "own_types"]

_IDL_LINE: Final = "=" * 80 + "\n"


class Types:
    """Types that can be read and written: those of ROS 2 and of `definitions`.

    Args:
        carried: Definitions that came with the data, by type; they take the place of ours, because they are what the
            data were written with.

    Raises:
        MessageError: A definition that came with the data cannot be read.
    """

    def __init__(self, carried: Mapping[str, MessageDefinition] | None = None) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)
        ours: dict[str, Any] = {}
        for name, text in DEFINITIONS.items():
            ours |= get_types_from_msg(text, name)
        self._store.register(ours)
        self._carried: dict[str, Any] = {}
        for name, definition in (carried or {}).items():
            if definition.format != MessageDefinitionFormat.NONE:
                self._carried[name] = _carried_store(name, definition)

    def read(self, name: str, data: bytes | memoryview) -> Any:
        """Return the message of CDR bytes.

        Raises:
            MessageError: The bytes are no such message, or the type is not known.
        """
        store = self._carried.get(name, self._store)
        if name not in store.fielddefs:
            raise MessageError("wrong_type", "", "a type that is known here or defined in the data", name)
        try:
            return store.deserialize_cdr(data, name)
        except (SerdeError, IndexError, KeyError, MemoryError) as error:
            raise MessageError("malformed", "", f"CDR of {name}", cut(str(error))) from error

    def new(self, name: str, /, **fields: Any) -> Any:
        """Return a message of a type with all of its fields."""
        return self._store.types[name](**fields)

    def write(self, message: Any) -> bytes:
        """Return the CDR bytes of a message, little endian."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def definition(self, name: str) -> str:
        """Return the definition of a type and of those that it is made of, as bags hold it."""
        text: str = self._store.generate_msgdef(name, ros_version=2)[0]
        return text

    def hash_of(self, name: str) -> str:
        """Return the hash of a type, `RIHS01_` and 64 hexadecimal digits (REP 2011)."""
        text: str = self._store.hash_rihs01(name)
        return text


@functools.cache
def own_types() -> Types:
    """Return the types without any that came with data."""
    return Types()


def _carried_store(name: str, definition: MessageDefinition) -> Any:
    """Return a store of one type as its data define it."""
    try:
        if definition.format == MessageDefinitionFormat.MSG:
            found = get_types_from_msg(definition.data, name)
        else:
            parts = definition.data.split(_IDL_LINE)
            texts = [part.split("\n", 1)[1] for part in parts if part.startswith("IDL: ")] or [definition.data]
            found = {}
            for text in texts:
                found |= get_types_from_idl(text)
        store = get_typestore(Stores.EMPTY)
        store.register(found)
    except TypesysError as error:
        raise MessageError("malformed", "", f"a definition of {name}", cut(str(error))) from error
    return store
