"""Message types of ROS 2: definitions, CDR bytes to messages and back, hashes of types.

A message is an object with the fields of its type; arrays of numbers are numpy arrays. The library is rosbags: pure
Python, maintained, Apache-2.0, and it needs no ROS. It has most of ROS 2's types; missing ones are defined here.
"""

import functools
import struct
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from optipmb_schemas.errors import MessageError, cut
from optipmb_schemas.ros2 import cpm

__all__ = ["AUTOWARE", "Types", "own_types"]

AUTOWARE: Final = ("autoware_perception_msgs/msg", "autoware_auto_perception_msgs/msg")
"""The two names of Autoware's package of detections; the fields are the same."""

_DETECTED: Final = """
ObjectClassification
uint8 label
float32 probability

Shape
uint8 BOUNDING_BOX=0
uint8 CYLINDER=1
uint8 POLYGON=2
uint8 type
geometry_msgs/Polygon footprint
geometry_msgs/Vector3 dimensions

DetectedObjectKinematics
uint8 UNAVAILABLE=0
uint8 SIGN_UNKNOWN=1
uint8 AVAILABLE=2
geometry_msgs/PoseWithCovariance pose_with_covariance
bool has_position_covariance
uint8 orientation_availability
geometry_msgs/TwistWithCovariance twist_with_covariance
bool has_twist
bool has_twist_covariance

DetectedObject
float32 existence_probability
ObjectClassification[] classification
DetectedObjectKinematics kinematics
Shape shape

DetectedObjects
std_msgs/Header header
DetectedObject[] objects
"""

_TRACKED: Final = """
TrackedObjectKinematics
uint8 UNAVAILABLE=0
uint8 SIGN_UNKNOWN=1
uint8 AVAILABLE=2
geometry_msgs/PoseWithCovariance pose_with_covariance
geometry_msgs/TwistWithCovariance twist_with_covariance
geometry_msgs/AccelWithCovariance acceleration_with_covariance
uint8 orientation_availability
bool is_stationary

TrackedObject
unique_identifier_msgs/UUID object_id
float32 existence_probability
ObjectClassification[] classification
TrackedObjectKinematics kinematics
Shape shape

TrackedObjects
std_msgs/Header header
TrackedObject[] objects

PredictedPath
geometry_msgs/Pose[] path
builtin_interfaces/Duration time_step
float32 confidence

PredictedObjectKinematics
geometry_msgs/PoseWithCovariance initial_pose_with_covariance
geometry_msgs/TwistWithCovariance initial_twist_with_covariance
geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance
PredictedPath[] predicted_paths

PredictedObject
unique_identifier_msgs/UUID object_id
float32 existence_probability
ObjectClassification[] classification
PredictedObjectKinematics kinematics
Shape shape

PredictedObjects
std_msgs/Header header
PredictedObject[] objects
"""

_VISION: Final = """
ObjectHypothesis
string class_id
float64 score

ObjectHypothesisWithPose
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose

BoundingBox3D
geometry_msgs/Pose center
geometry_msgs/Vector3 size

Detection3D
std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id

Detection3DArray
std_msgs/Header header
vision_msgs/Detection3D[] detections
"""

_DEFINITIONS: Final = ((AUTOWARE[0], f"{_DETECTED}{_TRACKED}"), (AUTOWARE[1], _DETECTED), ("vision_msgs/msg", _VISION))
"""Definitions by package, each a name with fields and constants in lines. Order, names and types must be exact.

CDR has no names, and the hash of a type (RIHS01) is made from them.
"""

_IDL_LINE: Final = "=" * 80 + "\n"
_ZEROS: Final = {"string": "", "bool": False}


class Types:
    """Types that can be read and written: of rosbags, and defined here.

    Args:
        carried: Definitions that came with the data, by type; they take the place of ours, because they are what the
            data were written with.
        perception: Whether the types of collective perception messages are among them.

    Raises:
        MessageError: A definition that came with the data cannot be read.
    """

    def __init__(self, carried: Mapping[str, MessageDefinition] | None = None, *, perception: bool = False) -> None:
        self._store = _own_store(perception=perception)
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
        """Return a message of a type; messages inside may be maps. A field that is not given is 0, empty or False."""
        described = self._store.fielddefs[name][1]
        return self._store.types[name](**{field: self._value(kind, fields.get(field)) for field, kind in described})

    def _value(self, described: Any, given: Any) -> Any:
        node, kind = described
        if node == Nodetype.BASE:
            return _ZEROS.get(kind[0], 0) if given is None else given
        if node == Nodetype.NAME:
            return self.new(kind, **(given or {})) if given is None or type(given) is dict else given
        item, length = kind
        if item[0] == Nodetype.NAME:
            return [self._value(item, one) for one in given or ()]
        return np.zeros(length, item[1][0]) if given is None else given

    def write(self, message: Any) -> bytes:
        """Return the CDR bytes of a message, little endian.

        Raises:
            MessageError: A value is beyond its field, such as a time after January 2038.
        """
        try:
            return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))
        except (SerdeError, ValueError, struct.error) as error:
            raise MessageError("invalid_value", "", f"values of {message.__msgtype__}", cut(str(error))) from error

    def definition(self, name: str) -> str:
        """Return the definition of a type and of the types inside, as bags hold it."""
        text: str = self._store.generate_msgdef(name, ros_version=2)[0]
        return text

    def hash_of(self, name: str) -> str:
        """Return the hash of a type, `RIHS01_` and 64 hexadecimal digits (REP 2011)."""
        text: str = self._store.hash_rihs01(name)
        return text


@functools.cache
def _own_store(*, perception: bool = False) -> Any:
    """Return the store of rosbags with the definitions made here; to make it takes longer than to read a small bag."""
    store = get_typestore(Stores.ROS2_JAZZY)
    ours: dict[str, Any] = {}
    for package, text in _DEFINITIONS:
        for lines in text.strip().split("\n\n"):
            kind, _, fields = lines.partition("\n")
            ours |= get_types_from_msg(fields, f"{package}/{kind}")
    for kind, fields in cpm.definitions() if perception else ():
        ours |= get_types_from_msg(fields, f"{cpm.PACKAGE}/{kind}")
    store.register(ours)
    return store


@functools.cache
def own_types(*, perception: bool = False) -> Types:
    """Return the types without any that came with data; with `perception` also those for collective perception."""
    return Types(perception=perception)


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
