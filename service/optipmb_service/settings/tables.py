"""The tables among the settings: limits of messages, and topics of ROS 2."""

from __future__ import annotations

from typing import Annotated, Literal

from optipmb_schemas import DEFAULT, Keys, Limits, MessageError
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from optipmb_service.settings.forms import form_of


class LimitSettings(BaseModel):
    """Bounds on what one message may hold; what is larger is refused before memory is taken for it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_bytes: int = Field(default=DEFAULT.max_bytes, ge=1024, le=2**30, description="bytes of a msgpack payload")
    max_json_bytes: int = Field(default=2**21, ge=1024, le=2**30, description="bytes of a JSON payload")
    max_values: int = Field(default=2**17, ge=64, description="values of one message, each number of a list among them")
    max_points: int = Field(default=DEFAULT.max_points, ge=0, description="points of one cloud")
    max_detections: int = Field(default=DEFAULT.max_detections, ge=1, description="detections of one frame")

    def limits(self) -> Limits:
        """Return the limits for the decoder."""
        return Limits(**self.model_dump())


Topic = Annotated[str, form_of(r"((/[A-Za-z_][A-Za-z0-9_]*)+)?", "a topic looks like /lidar/points")]


class Ros2Stream(BaseModel):
    """The topics of one stream."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    detections: Topic = Field(min_length=1, description="topic of the detections")
    type: Literal[
        "vision_msgs/msg/Detection3DArray",
        "autoware_perception_msgs/msg/DetectedObjects",
        "autoware_auto_perception_msgs/msg/DetectedObjects",
    ] = Field(default="vision_msgs/msg/Detection3DArray", description="type of the detections")
    points: Topic = Field(default="", description="topic of the point clouds")
    tracks: Topic = Field(
        default="", description="topic of the tracks; default: `/tracks` below that of the detections"
    )
    classes: dict[str, str] = Field(default_factory=dict, description="class names by those in the messages")
    covariance: bool = Field(default=False, description="use the covariances of the detections' positions")
    fixed: bool = Field(default=False, description="the sensor does not move and its frame is the world")

    @property
    def tracks_topic(self) -> str:
        """Topic of the tracks."""
        return self.tracks or f"{self.detections}/tracks"


def _streams(value: dict[str, Ros2Stream]) -> dict[str, Ros2Stream]:
    for name in value:
        try:
            Keys().detections(name)
        except MessageError as error:
            raise ValueError(f"a stream is named {error.expected}, received {error.received}") from None
    return value


class Ros2Settings(BaseModel):
    """Topics of a ROS 2 system whose middleware is rmw_zenoh; used by `optipmb-service ros2`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    domain: int = Field(default=0, ge=0, le=232, description="`ROS_DOMAIN_ID` of the system")
    node: str = Field(default="optipmb", pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", description="name of the ROS 2 node")
    fixed_frame: str = Field(default="", description="frame of the tracks; default: the root of tf")
    odometry: Topic = Field(default="", description="topic of `nav_msgs/Odometry`, for poses that tf has not")
    tf_wait_s: float = Field(default=0.5, ge=0, le=60, description="longest wait of a message for its transform")
    diagnostics: Topic = Field(default="/diagnostics", description="topic of `diagnostic_msgs/DiagnosticArray`")
    streams: Annotated[dict[str, Ros2Stream], AfterValidator(_streams)] = Field(
        default_factory=dict, description="topics by stream (`site/node/sensor`)"
    )
