"""Writes `tests/schemas/ros2_reference.json` by ROS 2's own code: run it with a Python that has rclpy.

For each type that is read or published live: the hash that ROS 2 has given the type, one message with another value in
every field, and its bytes by ROS 2's serialiser. Padding of ROS 2 holds arbitrary memory. Packages that an
installation lacks (vision_msgs, autoware_perception_msgs) are built with colcon from their sources.

    source /opt/ros/kilted/setup.bash && python3 tests/support/ros2_reference.py
"""

import base64
import importlib
import json
import re
from pathlib import Path
from typing import Any

TYPES = (
    "autoware_perception_msgs/msg/DetectedObjects",
    "autoware_perception_msgs/msg/PredictedObjects",
    "autoware_perception_msgs/msg/TrackedObjects",
    "diagnostic_msgs/msg/DiagnosticArray",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/PointCloud2",
    "tf2_msgs/msg/TFMessage",
    "vision_msgs/msg/Detection3DArray",
    "visualization_msgs/msg/MarkerArray",
)
ELEMENTS = 2
"""Of each list without a fixed length."""

Fields = dict[str, Any]


class Values:
    """Gives values, each another one, for fields by their types' names."""

    def __init__(self) -> None:
        self._count = 0

    def message(self, fields: dict[str, str], nested: Any) -> Fields:
        return {name: self._value(kind, nested) for name, kind in fields.items()}

    def _value(self, kind: str, nested: Any) -> Any:
        if found := re.fullmatch(r"sequence<(.+?)(?:, \d+)?>", kind):
            return [self._value(found[1], nested) for _ in range(ELEMENTS)]
        if found := re.fullmatch(r"(.+)\[(\d+)\]", kind):
            return [self._value(found[1], nested) for _ in range(int(found[2]))]
        if "/" in kind:
            return self.message(nested(kind), nested)
        self._count += 1
        if kind == "boolean":
            return bool(self._count % 2)
        if kind == "string":
            return f"text {self._count}"
        return self._count / 4 if kind in {"float", "double"} else self._count % 100


def _class(name: str) -> Any:
    package, _, message = name.rpartition("/")
    return getattr(importlib.import_module(f"{package.removesuffix('/msg')}.msg"), message)


def _built(name: str, fields: Fields) -> Any:
    message = _class(name)()
    for field, kind in message.get_fields_and_field_types().items():
        inner = re.sub(r"^sequence<(.+?)(?:, \d+)?>$|\[\d+\]$", r"\1", kind)
        value = fields[field]
        if "/" in inner:
            value = [_built(inner, one) for one in value] if isinstance(value, list) else _built(inner, value)
        elif inner == "octet":
            value = bytes([value])
        setattr(message, field, value)
    return message


def main() -> None:
    from ament_index_python import get_package_share_directory  # type: ignore[import-not-found]  # noqa: PLC0415 - of ROS 2
    from rclpy.serialization import serialize_message  # type: ignore[import-not-found]  # noqa: PLC0415

    reference = {}
    for name in TYPES:
        package, kind, message = name.split("/")
        described = Path(get_package_share_directory(package), kind, f"{message}.json").read_text()
        hashes = {one["type_name"]: one["hash_string"] for one in json.loads(described)["type_hashes"]}

        def nested(inner: str) -> dict[str, str]:
            found: dict[str, str] = _class(inner).get_fields_and_field_types()
            return found

        fields = Values().message(nested(name), nested)
        cdr = base64.b64encode(serialize_message(_built(name, fields))).decode()
        reference[name] = {"hash": hashes[name], "fields": fields, "cdr": cdr}
    file = Path(__file__).parents[1] / "schemas" / "ros2_reference.json"
    file.write_text(json.dumps(reference, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
