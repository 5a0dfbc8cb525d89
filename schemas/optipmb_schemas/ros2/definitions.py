"""Definitions of the message types that the library of ROS 2's own types lacks: fields and constants, no comments.

A definition must be exact in the order, names and types of its fields: CDR has no names, and the hash of a type
(RIHS01) is made from them. Types of builtin_interfaces, geometry_msgs, std_msgs, sensor_msgs, nav_msgs, tf2_msgs,
visualization_msgs, diagnostic_msgs and unique_identifier_msgs come with rosbags.
"""

from typing import Final

__all__ = ["CLASS_NAMES", "DEFINITIONS", "OBJECTS", "UNKNOWN_CLASS"]

OBJECTS: Final = ("autoware_perception_msgs/msg/DetectedObjects", "autoware_auto_perception_msgs/msg/DetectedObjects")
"""The two names of Autoware's detections; the fields are the same."""

CLASS_NAMES: Final = {
    1: "car",
    2: "truck",
    3: "bus",
    4: "trailer",
    5: "motorcycle",
    6: "bicycle",
    7: "pedestrian",
    8: "animal",
    9: "hazard",
    10: "over_drivable",
    11: "under_drivable",
}
"""Autoware's numbers of classes (`ObjectClassification.label`) by name; older versions lack those from 8 on."""

UNKNOWN_CLASS: Final = 0

_CLASSIFICATION: Final = """\
uint8 label
float32 probability
"""

_SHAPE: Final = """\
uint8 BOUNDING_BOX=0
uint8 CYLINDER=1
uint8 POLYGON=2
uint8 type
geometry_msgs/Polygon footprint
geometry_msgs/Vector3 dimensions
"""

_AVAILABILITY: Final = """\
uint8 UNAVAILABLE=0
uint8 SIGN_UNKNOWN=1
uint8 AVAILABLE=2
"""

_DETECTED_KINEMATICS: Final = f"""\
{_AVAILABILITY}geometry_msgs/PoseWithCovariance pose_with_covariance
bool has_position_covariance
uint8 orientation_availability
geometry_msgs/TwistWithCovariance twist_with_covariance
bool has_twist
bool has_twist_covariance
"""

_DETECTED: Final = """\
float32 existence_probability
ObjectClassification[] classification
DetectedObjectKinematics kinematics
Shape shape
"""

_TRACKED_KINEMATICS: Final = f"""\
{_AVAILABILITY}geometry_msgs/PoseWithCovariance pose_with_covariance
geometry_msgs/TwistWithCovariance twist_with_covariance
geometry_msgs/AccelWithCovariance acceleration_with_covariance
uint8 orientation_availability
bool is_stationary
"""

_TRACKED: Final = """\
unique_identifier_msgs/UUID object_id
float32 existence_probability
ObjectClassification[] classification
TrackedObjectKinematics kinematics
Shape shape
"""

_PREDICTED_KINEMATICS: Final = """\
geometry_msgs/PoseWithCovariance initial_pose_with_covariance
geometry_msgs/TwistWithCovariance initial_twist_with_covariance
geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance
PredictedPath[] predicted_paths
"""

_PREDICTED: Final = """\
unique_identifier_msgs/UUID object_id
float32 existence_probability
ObjectClassification[] classification
PredictedObjectKinematics kinematics
Shape shape
"""

DEFINITIONS: Final = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    "autoware_perception_msgs/msg/TrackedObjectKinematics": _TRACKED_KINEMATICS,
    "autoware_perception_msgs/msg/TrackedObject": _TRACKED,
    "autoware_perception_msgs/msg/TrackedObjects": "std_msgs/Header header\nTrackedObject[] objects\n",
    "autoware_perception_msgs/msg/PredictedPath": (
        "geometry_msgs/Pose[] path\nbuiltin_interfaces/Duration time_step\nfloat32 confidence\n"
    ),
    "autoware_perception_msgs/msg/PredictedObjectKinematics": _PREDICTED_KINEMATICS,
    "autoware_perception_msgs/msg/PredictedObject": _PREDICTED,
    "autoware_perception_msgs/msg/PredictedObjects": "std_msgs/Header header\nPredictedObject[] objects\n",
} | {
    f"{package}/msg/{name}": text
    for package in ("autoware_perception_msgs", "autoware_auto_perception_msgs")
    for name, text in (
        ("ObjectClassification", _CLASSIFICATION),
        ("Shape", _SHAPE),
        ("DetectedObjectKinematics", _DETECTED_KINEMATICS),
        ("DetectedObject", _DETECTED),
        ("DetectedObjects", "std_msgs/Header header\nDetectedObject[] objects\n"),
    )
}
"""Definitions by type."""
