"""The settings of the service; `app.configuration` reads their values.

Times are in seconds. Every setting is described by its docstring, which `docs/reference.md` prints.
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
import secrets
import socket
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal
from urllib.parse import urlsplit

from optipmb_schemas import DEFAULT, Keys, Limits, MessageError
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

if TYPE_CHECKING:
    from optipmb import Rejoin
    from optipmb.world.zones import Zone

PREFIX: Final = "OPTIPMB_"  # of environment variables
RUN: Final = secrets.token_hex(3)  # tells this process from one with its number in a container of the same host name
HOST_CHARACTERS: Final = 40

DEFAULT_LISTEN: Final = "tcp/127.0.0.1:7447"
DEFAULT_GRPC: Final = "127.0.0.1:50051"
DEFAULT_NATS: Final = "127.0.0.1:4222"
DEFAULT_MQTT: Final = "mqtt://127.0.0.1:1883"
MOST_ZONES: Final = 256  # as `optipmb.world.zones.MOST`; a test compares what settings repeat of the tracker


def _form(pattern: str, expected: str) -> AfterValidator:
    """Return the check of a text: it matches a regular expression in full, or the error names the expected form."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise ValueError(f"{expected}, received {value!r}")
        return value

    return AfterValidator(check)


def address(value: str) -> str:
    """Return an address as it is, `host:port` or nothing.

    Raises:
        ValueError: it is none.
    """
    if value and not re.fullmatch(r"([A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.%]+\]):\d{1,5}", value):
        raise ValueError(f"an address looks like 127.0.0.1:8080, received {value!r}")
    _with_port(f"//{value}")
    return value


def _with_port(url: str) -> str:
    """Return an address of a server as it is, if its port is one.

    Raises:
        ValueError: it is none.
    """
    try:
        _ = urlsplit(url).port  # is checked when it is read
    except ValueError as error:
        raise ValueError(f"a port is a number up to 65535: {error}") from error
    return url


def without_password(server: str) -> str:
    """Return the address of a server as it may be shown."""
    return re.sub(r"(?<=//)[^/@]*@", "***@", server)


def _listed(value: Any) -> Any:
    """Return the list that a text holds: JSON, or names separated by commas."""
    if not isinstance(value, str):
        return value
    if not value.startswith("["):
        return [part.strip() for part in value.split(",") if part.strip()]
    try:
        return json.loads(value)
    except ValueError as error:
        raise ValueError(f"names separated by commas, or a JSON list, received {value!r}") from error


Prefix = Annotated[str, _form(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", "chunks of [A-Za-z0-9_.-] separated by '/'")]
Address = Annotated[str, AfterValidator(address)]
Pattern = Annotated[
    str, _form(r"[A-Za-z0-9_.*-]+(/[A-Za-z0-9_.*-]+){2}", "a pattern of streams looks like site/*/lidar*")
]
Server = Annotated[
    str, _form(r"(nats|tls)://\S+", "a NATS server looks like nats://127.0.0.1:4222"), AfterValidator(_with_port)
]
Endpoint = Annotated[
    str,
    _form(r"[a-z0-9]+/[^\s/#?]+:\d+([?#]\S*)?|[a-z0-9-]+/\S+", f"an endpoint looks like {DEFAULT_LISTEN}"),
]
Names = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_listed)]
Patterns = Annotated[tuple[Pattern, ...], NoDecode, BeforeValidator(_listed)]
Servers = Annotated[tuple[Server, ...], NoDecode, BeforeValidator(_listed)]
Endpoints = Annotated[tuple[Endpoint, ...], NoDecode, BeforeValidator(_listed)]


class LimitSettings(BaseModel):
    """Bounds on what one message may hold; larger ones are refused before memory is allocated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_bytes: int = Field(default=DEFAULT.max_bytes, ge=1024, le=2**30)
    """bytes of a msgpack payload"""
    max_json_bytes: int = Field(default=2**21, ge=1024, le=2**30)
    """bytes of a JSON payload"""
    max_values: int = Field(default=2**17, ge=64)
    """values of one message, each number of a list among them"""
    max_points: int = Field(default=DEFAULT.max_points, ge=0)
    """points of one cloud"""
    max_detections: int = Field(default=DEFAULT.max_detections, ge=1)
    """detections of one frame"""

    def limits(self) -> Limits:
        return Limits(**self.model_dump())


Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Height = Annotated[float, Field(ge=-1e5, le=1e5)]
RosTopic = Annotated[str, _form(r"((/[A-Za-z_][A-Za-z0-9_]*)+)?", "a topic looks like /lidar/points")]


class Ros2Stream(BaseModel):
    """The topics of one stream."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    detections: RosTopic = Field(min_length=1)
    """topic of the detections"""
    type: Literal[
        "vision_msgs/msg/Detection3DArray",
        "autoware_perception_msgs/msg/DetectedObjects",
        "autoware_auto_perception_msgs/msg/DetectedObjects",
    ] = "vision_msgs/msg/Detection3DArray"
    """type of the detections"""
    points: RosTopic = ""
    """topic of the point clouds"""
    tracks: RosTopic = ""
    """topic of the tracks; default: `/tracks` below that of the detections"""
    classes: dict[str, str] = Field(default_factory=dict)
    """class names by those in the messages"""
    covariance: bool = False
    """use the covariances of the detections' positions"""
    fixed: bool = False
    """the sensor does not move and its frame is the world"""
    cpm: bool = False
    """publish collective perception messages on `/cpm` below the topic of the tracks, by the station of `cpm`"""

    @property
    def tracks_topic(self) -> str:
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

    domain: int = Field(default=0, ge=0, le=232)
    """`ROS_DOMAIN_ID` of the system"""
    node: str = Field(default="optipmb", pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")
    """name of the ROS 2 node"""
    fixed_frame: str = ""
    """frame of the tracks; default: the root of tf"""
    odometry: RosTopic = ""
    """topic of `nav_msgs/Odometry`, for poses that tf has not"""
    tf_wait_s: float = Field(default=0.5, ge=0, le=60)
    """longest wait of a message for its transform"""
    diagnostics: RosTopic = "/diagnostics"
    """topic of `diagnostic_msgs/DiagnosticArray`"""
    streams: Annotated[dict[str, Ros2Stream], AfterValidator(_streams)] = Field(default_factory=dict)
    """topics by stream (`site/node/sensor`)"""


PathText = Annotated[
    str,
    _form(
        r"|= .+|@key|([^.\[\]*\s]+|\[\d+\])(\.[^.\[\]*\s]+|\[\d+\])*",
        "a path looks like data.conf or box[0], a constant like '= car'",
    ),
]
PathTexts = PathText | Annotated[tuple[PathText, ...], Field(min_length=2, max_length=4)]


class MappingSettings(BaseModel):
    """Where the objects of a payload are, and the paths of their fields below each object; empty: unknown."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)

    objects: Annotated[
        str,
        _form(
            r"(\[\d*\]|[^.\[\]\s]+)(\.[^.\[\]\s]+|\[\d*\])*",
            "a path of objects looks like data.targets[] or objects.*[]",
        ),
    ]
    """path of the objects: names with dots, `[]` for each element, `*` for each value of a map"""
    name: PathText = Field(alias="class", min_length=1)
    """class; `= car`: a constant; `@key`: the key that `*` stood for"""
    score: PathText = ""
    """confidence"""
    score_scale: float = Field(default=1.0, gt=0)
    """factor of the confidence, as 0.01 for percent"""
    position: PathTexts = ""
    """centre, m: a path of a list, or a list with a path for x, y and z"""
    size: PathTexts = ""
    """length, width, height in m, likewise"""
    yaw: PathText = ""
    """heading counter-clockwise from x"""
    velocity: PathTexts = ""
    """velocity over ground, m/s, likewise"""
    lat: PathText = ""
    """latitude in degrees, in place of the position"""
    lon: PathText = ""
    """longitude in degrees"""
    alt: PathText = ""
    """height above the ellipsoid in m"""
    heading: PathText = ""
    """degrees clockwise from true north, in place of yaw"""
    box: PathTexts = ""
    """box in pixels, in place of the position, with a `camera` in `inputs`: a path of a list, or four paths"""
    box_form: Literal["xyxy", "xywh", "cxcywh"] = "xyxy"
    """numbers of a box: its corners; left, top, width, height; or the same with its centre"""
    box_unit: Literal["px", "image"] = "px"
    """unit of boxes and feet: pixels, or width and height of the image"""
    foot: PathTexts = ""
    """column and row where the object stands, in place of a box"""
    angle_unit: Literal["rad", "deg"] = "rad"
    """unit of yaw"""
    time: PathText = ""
    """path of the time of the frame in the payload; default: arrival"""
    time_unit: Literal["iso", "s", "ms", "us", "ns"] = "iso"
    """form of the time: ISO 8601 text, or a number since 1970"""
    time_zone: str = Field(default="", pattern=r"^(|Z|[+-]\d\d:\d\d)$")
    """zone of ISO texts without one, as `+01:00`"""
    leave_out: dict[PathText, bool | str] = Field(default_factory=dict)
    """values by their paths in the payload; a payload with one of them has no objects"""
    frame: Literal["world", "sensor"] = "world"
    """frame of all coordinates"""
    pose: dict[Literal["translation", "quaternion"], tuple[float, ...]] | None = None
    """pose of a fixed sensor whose frame is `sensor`: `{ translation = [x, y, z], quaternion = [w, x, y, z] }`"""


class MqttInput(BaseModel):
    """A topic of sensors whose payloads are detections of a stream; `inputs` says how they are read."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    topic: str = Field(pattern=r"^[^#]+$", max_length=1024)
    """topic; `+` stands for any part, which `{1}`, `{2}` … name in the stream; `$share/GROUP/TOPIC` is shared"""
    qos: Literal[0, 1, 2] = 1
    """quality of service that the broker is asked for"""

    @property
    def pattern(self) -> str:
        """Topics of its messages."""
        return re.sub(r"^\$share/[^/+]+/(?=.)", "", self.topic)


class MqttSettings(BaseModel):
    """An MQTT broker and its messages; used by `optipmb-service mqtt`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    broker: Annotated[
        str, _form(r"mqtts?://[^\s/@]+", "a broker looks like mqtt://127.0.0.1:1883"), AfterValidator(_with_port)
    ] = DEFAULT_MQTT
    """address of the broker; `mqtts://` with TLS"""
    credentials: Path | None = None
    """file with `user:password`"""
    tls: Path | None = None
    """folder with `ca.pem`, and `cert.pem` and `key.pem` where the broker asks for a certificate; default: the
    system's authorities"""
    streams: Patterns = ("*/*/*",)
    """patterns of streams, each part a name or `*`, that do not overlap"""
    topics: tuple[Literal["tracks", "events", "zones", "problems", "cpm"], ...] = (
        "tracks",
        "events",
        "zones",
        "problems",
    )
    """what is published; `cpm`: collective perception messages of the streams that `cpm` names"""
    tracks_hz: float = Field(default=2.0, ge=0, le=1000)
    """highest rate of the tracks of a stream, in sensor time; 0: all frames"""
    inputs: dict[str, MqttInput] = Field(default_factory=dict)
    """topics that are read, by the stream that they feed, as `garage/gate/radar` or `garage/{1}/radar`"""

    @field_validator("streams")
    @classmethod
    def _check_streams(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for pattern in value:
            try:
                Keys().matching(pattern, "tracks")
            except MessageError as error:
                raise ValueError(f"{error.expected}, or * for any of its parts, received {pattern!r}") from None
        return value


class SiteSettings(BaseModel):
    """Place of a site's world frame on the globe."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    origin: tuple[Latitude, Longitude, Height]
    """latitude and longitude in degrees (WGS84) of the world's origin, and its height above the ellipsoid in m"""
    x_heading: float = Field(default=90.0, ge=-360, le=360)
    """direction of the world's x axis, degrees clockwise from true north; 90: x is east, y is north"""


Node = Annotated[str, _form(r"[A-Za-z0-9_.-]+/[A-Za-z0-9_.-]+", "a node looks like site/node")]


class FusedSettings(BaseModel):
    """A session of sensors of several nodes of a site, `site/fused/NAME`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    streams: Patterns = Field(min_length=1, max_length=64)
    """patterns of streams of one site (as `garage/*/radar`) that feed it; a stream feeds one session"""
    read: tuple[Node, ...] = ()
    """nodes (as `garage/kiosk`) that may read it over gRPC and HTTP, besides viewers and services; in a protected
    network see `make.py --reads`"""

    @field_validator("streams")
    @classmethod
    def _check_site(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        sites = {pattern.partition("/")[0] for pattern in value}
        if len(sites) > 1 or "*" in "".join(sites):
            raise ValueError(f"patterns of one site, named without *, received {', '.join(sorted(sites))}")
        return value

    @property
    def site(self) -> str:
        return self.streams[0].partition("/")[0]


class SensorSettings(BaseModel):
    """How the frames of a sensor of a fused session are used, where it differs from the others."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    profile: str = ""
    """profile name or TOML file, of which the measurement side holds for its frames: thresholds, detection, noise,
    clutter, births, `score_calibration`; default: the session's"""
    starts_tracks: bool = True
    """its detections start tracks; `false`: they only continue those of other sensors"""
    trust_size: bool = True
    """use the sizes and heights of its boxes; `false`: as if it did not measure them"""
    trust_heading: bool = True
    """use the headings of its boxes; `false`: as if it did not measure them"""


Shape = tuple[tuple[float, float], ...]
FARTHEST: Final = 100_000.0
"""Distance of a zone from the origin of its site, m, beyond which latitude and longitude are likely exchanged."""


class ZoneSettings(BaseModel):
    """A polygon or a line in the world frame, whose events are published for the streams that it names."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    streams: Patterns
    """patterns of streams (as `garage/*/fused`); each session that matches counts for itself"""
    geo: bool = False
    """points are latitude and longitude in degrees, by the place of the stream's site in `sites`"""
    polygon: Shape = ()
    """3 to 1000 corners, m; closed by itself, without crossing itself"""
    line: Shape = Field(default=(), validate_default=True)
    """2 to 100 points, m, in place of a polygon"""
    z: tuple[float, float] | None = None
    """heights of centres inside, m; default: all"""
    classes: tuple[str, ...] = ()
    """classes that count; default: all"""
    margin: float = Field(default=0.3, ge=0, le=100)
    """m; an object leaves when it is farther outside, and crosses a line from farther on one side to farther on the
    other"""
    min_s: float = Field(default=0.5, ge=0, le=86_400)
    """shorter visits give no events"""
    lost_s: float | None = Field(default=None, ge=0, le=86_400)
    """an object that was not detected for longer has left; default: 2, and where tracks are joined as long as that may
    be"""
    dwell_s: tuple[Annotated[float, Field(gt=0, le=1e8)], ...] = ()
    """times inside after which there is an event"""

    @field_validator("polygon", "line")
    @classmethod
    def _check_shape(cls, value: Shape, info: ValidationInfo) -> Shape:
        if info.field_name == "line" and bool(value) is bool(info.data.get("polygon", not value)):
            raise ValueError(f"a polygon or a line, received {'both' if value else 'neither'}")
        if value:
            from optipmb.world.zones import Zone  # noqa: PLC0415 - compiles kernels

            points = value
            if info.data.get("geo"):  # also around 180° of longitude neighbours are near each other
                points = tuple((lat, (lon - value[0][1] + 180) % 360) for lat, lon in value)
            shape: dict[str, Any] = {str(info.field_name): points}
            try:
                Zone("zone", **shape)
            except ValueError as error:
                raise ValueError(str(error).partition(": ")[2]) from None
        return value

    def zone(self, name: str, site: SiteSettings | None = None) -> Zone:
        """Return the zone that these settings describe, of a site if its points are geographic.

        Raises:
            ParameterError: these are too far from the site.
        """
        from optipmb import Georeference, ParameterError  # noqa: PLC0415 - compiles kernels
        from optipmb.world.zones import Zone  # noqa: PLC0415 - compiles kernels

        values: dict[str, Any] = self.model_dump(exclude={"streams", "geo"}, exclude_none=True)
        if self.geo and site is not None:
            lat, lon = zip(*(self.polygon or self.line), strict=True)
            world = Georeference(site.origin, site.x_heading).to_world(lat, lon)
            if max(abs(world[:, :2]).ravel()) > FARTHEST:
                raise ParameterError(name, f"points within {FARTHEST / 1e3:g} km of the origin of the site", "others")
            values["polygon" if self.polygon else "line"] = tuple(map(tuple, world[:, :2].tolist()))
        return Zone(name, **values | {"dwell_s": tuple(sorted(self.dwell_s))})


class OutputSettings(BaseModel):
    """Output of the tracks of a stream at a fixed rate, predicted to now."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rate_hz: float = Field(default=20.0, gt=0, le=50)
    """messages a second"""
    delay_s: float = Field(default=0.0, ge=0, le=10)
    """tracks are those of the present minus this; existence and `confirmed` also use the frames since then"""
    show: float | None = Field(default=None, ge=0, le=1)
    """existence from which tracks are confirmed; None: as the session confirms them, with `delay_s` from 0.5 at most"""
    longest_s: float = Field(default=0.5, gt=0, le=30)
    """no output while the newest frame is older"""
    clock: Literal["system", "arrival"] = "system"
    """what the present is: the system's time (UTC), or the newest stamp plus the time since it arrived"""


class InputSettings(BaseModel):
    """How frames are read that come as JSON over HTTP or MQTT."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["optipmb", "axis", "frigate", "scenescape", "mapped"] = "optipmb"
    """form of payloads: our JSON, a known maker's, or that which `mapping` describes"""
    mapping: MappingSettings | None = None
    """paths of a payload, for the format `mapped`"""
    only: dict[PathText, bool | int | str] = Field(default_factory=dict)
    """values by their paths in the payload, as `{ "after.camera" = "gate" }`; other payloads are refused, over
    MQTT left out or of another input of the topic"""
    clock: Literal["sender", "arrival", "offset"] = "sender"
    """stamps of frames: the sender's; the time of their arrival; or the sender's moved to the clock of this machine"""
    classes: dict[str, str] = Field(default_factory=dict)
    """names of classes by those of the sender, as `{ Human = "pedestrian" }`; others stay"""
    camera: Path | None = None
    """file of the calibration by which boxes and feet in pixels become places on the ground"""
    complete: bool | None = None
    """`false`: a frame has some of the objects and says nothing of the others; default: `true`, and `false` for the
    format `frigate`"""
    missing_s: float = Field(default=10.0, gt=0, le=3600)
    """time after the last report of an object from which it counts as missed, with `complete = false`"""

    @property
    def is_complete(self) -> bool:
        """Whether a frame has all objects."""
        return self.format != "frigate" if self.complete is None else self.complete


_USUAL: Final = InputSettings()


SENSOR_TYPES: Final = (
    *("undefined", "radar", "lidar", "monovideo", "stereovision", "nightvision", "ultrasonic", "pmd"),
    *("inductionloop", "sphericalcamera", "uwb", "acoustic", "localaggregation", "itsaggregation"),
)
"""Types of sensors in their order in ETSI TS 102 894-2."""


class CpmSensor(BaseModel):
    """A sensor of a station."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: int = Field(ge=0, le=255)
    """number of the sensor in its messages"""
    type: Annotated[str, _form("|".join(SENSOR_TYPES), f"one of {', '.join(SENSOR_TYPES)}")]
    """kind of sensor, as `lidar`"""
    stream: Annotated[
        str, _form(r"([A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+){2})?", "a stream looks like site/node/sensor")
    ] = ""
    """stream of its detections, whose newest field of view is its perception region over MQTT; default: no region"""

    @property
    def number(self) -> int:
        return SENSOR_TYPES.index(self.type)


class CpmSettings(BaseModel):
    """Collective perception messages (ETSI TS 103 324) of a stream."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    station_id: int = Field(ge=0, le=2**32 - 1)
    """number of the station"""
    source_uuid: str = Field(default="", max_length=256)
    """name of the sender in JSON; default: `com_optipmb_` and the station's number"""
    rate_hz: float = Field(default=10.0, ge=1, le=10)
    """highest rate of the messages, in sensor time"""
    sensors: tuple[CpmSensor, ...] = Field(default=(), max_length=128)
    """sensors that the messages name once a second"""


class PassageSettings(BaseModel):
    """Way on which objects are not detected."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    start: Shape = Field(alias="from")
    """polygon in which objects are lost, 3 to 100 corners in the world frame, m"""
    to: Shape
    """polygon in which they are seen again"""
    s: tuple[float, float]
    """shortest and longest time between, s"""


class RejoinSettings(BaseModel):
    """Joining of tracks of the same object over gaps."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    gap_s: float = Field(default=60.0, gt=0, le=600)
    """longest gap"""
    min_probability: float = Field(default=0.95, ge=0.5, lt=1)
    """least probability of a join; below it a track is a new object"""
    decide_s: float = Field(default=0.3, ge=0, le=5)
    """time from the first detection of a track to its decision"""
    most: int = Field(default=1000, ge=1, le=10_000)
    """lost objects that are kept; then the oldest are dropped"""
    embedding_model: str | None = Field(default=None, min_length=1, max_length=64)
    """model whose vectors (`embedding` of Detections) are compared; vectors of other models are ignored"""
    exits: tuple[Shape, ...] = ()
    """polygons of 3 to 100 corners in the world frame, m, as doors: objects lost inside are gone, and objects that
    begin inside are new; with passages at most 64"""
    passages: tuple[PassageSettings, ...] = ()
    """ways on which objects are not detected"""

    @field_validator("exits", "passages")
    @classmethod
    def _check_shapes(cls, value: tuple[Any, ...], info: ValidationInfo) -> tuple[Any, ...]:
        if value:
            try:
                cls.model_construct(**info.data | {str(info.field_name): value}).joining()
            except ValueError as error:
                raise ValueError(str(error).removeprefix("rejoin.")) from None
        return value

    def joining(self) -> Rejoin:
        """Return these settings as the tracker takes them."""
        from optipmb import Passage, Rejoin  # noqa: PLC0415 - compiles kernels

        values = dict(self)
        return Rejoin(**values | {"passages": tuple(Passage(one.start, one.to, one.s) for one in self.passages)})


class LinkRegion(BaseModel):
    """Part of what streams see."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    streams: Pattern = "*/*/*"
    """pattern of the streams"""
    polygon: Shape = ()
    """3 to 1000 corners, m, in the world frame of the stream; default: all that it sees"""

    @field_validator("polygon")
    @classmethod
    def _check_polygon(cls, value: Shape) -> Shape:
        if value:
            ZoneSettings(streams=("*/*/*",), polygon=value)
        return value


def _region(value: Any) -> Any:
    """Return the region that a pattern of streams or a polygon stands for."""
    if isinstance(value, str):
        return {"streams": value}
    return {"polygon": value} if isinstance(value, list | tuple) else value


Region = Annotated[LinkRegion, BeforeValidator(_region)]


class LinkPassage(BaseModel):
    """Way between two views that do not overlap."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    from_: Region = Field(alias="from")
    """where objects leave: a pattern of streams, a polygon, or a table with `streams` and `polygon`"""
    to: Region
    """where they come in: as `from`"""
    s: tuple[float, float]
    """shortest and longest time between the two"""

    @field_validator("s")
    @classmethod
    def _check_times(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0 <= value[0] < value[1]:
            raise ValueError(f"a shortest time from 0 on and a longer one, received {list(value)}")
        return value


class LinkFrame(BaseModel):
    """Place of the world frame of a site in the plane of an area."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    translation: tuple[float, float]
    """x and y of its origin, m"""
    yaw: float = 0.0
    """direction of its x axis, rad"""


class LinkSettings(BaseModel):
    """An area whose streams `optipmb-service link` links: which of their objects are one."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    streams: Patterns
    """patterns of the streams (as `garage/*/fused`), at most 64 streams"""
    frames: dict[str, LinkFrame] = Field(default_factory=dict)
    """places of the world frames of sites, by site; default: by `sites`, and where that says nothing, not known"""
    passages: tuple[LinkPassage, ...] = Field(default=(), max_length=256)
    """known ways between views; others are learned"""
    exits: tuple[Region, ...] = Field(default=(), max_length=256)
    """regions whose ends are final, and whose beginnings are new objects, as doors"""
    min_probability: float = Field(default=0.97, ge=0.5, lt=1)
    """least probability of a link"""
    gap_s: float = Field(default=120.0, gt=0, le=600)
    """longest time between two views"""
    most: int = Field(default=10_000, ge=1, le=100_000)
    """objects that are remembered; then the oldest that ended are forgotten"""
    embedding_model: str = Field(default="", max_length=64)
    """model whose vectors (`embedding` of Detections) are compared; default: none are, and no detections are read"""


def overlap(one: str, other: str) -> bool:
    """Return whether something matches two patterns of streams or topics."""
    parts, others = one.split("/"), other.split("/")
    return len(parts) == len(others) and all(map(_share, map(tuple, parts), map(tuple, others)))


@cache
def _share(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Return whether some text matches two patterns, given as their characters."""
    if not (one and other):
        return set(one + other) <= {"*"}
    if one[0] == "*" or other[0] == "*":
        (rest, text) = (one[1:], other) if one[0] == "*" else (other[1:], one)
        return any(_share(rest, text[begin:]) for begin in range(len(text) + 1))
    return one[0] == other[0] and _share(one[1:], other[1:])


def _default_instance() -> str:
    """Return a name that two services do not share."""
    host = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()[:HOST_CHARACTERS]) or "host"
    return f"{host}-{os.getpid()}-{RUN}"


def is_loopback(address: str) -> bool:
    """Return whether `host:port` is reached from this machine alone."""
    host = address.rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def state_home() -> Path:
    """Return the folder below which state is kept that no setting gives a place."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state or Path(home) / "optipmb")


class Settings(BaseSettings):
    """What the service runs with."""

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", env_prefix=PREFIX, env_nested_delimiter="__", allow_inf_nan=False
    )

    instance: str = Field(default_factory=_default_instance, pattern=r"^[A-Za-z0-9_.-]{1,64}$")
    """name of this instance; default: the host's name, the process number and six random digits"""
    prefix: Prefix = "optipmb/v1"
    """first chunks of every key"""
    router: bool | None = None
    """run a Zenoh router in this process; default: yes unless `connect` is given"""
    listen: Endpoints | None = None
    """endpoints to listen on; default: `tcp/127.0.0.1:7447` as a router, none as a client"""
    connect: Endpoints = ()
    """endpoints of routers to connect to; retried without end"""
    zenoh_config: Path | None = None
    """Zenoh configuration file (JSON5): TLS, access control, limits of a router; settings override it"""
    shared_memory: bool = False
    """Zenoh's shared memory: faster for clouds on one host, but may lose messages, and leaves files in /dev/shm after a
    kill"""
    profile: str = Field(default="generic", min_length=1)
    """profile name or TOML file, where no pattern matches"""
    profiles: dict[str, str] = Field(default_factory=dict)
    """profiles by stream pattern (as `site/*/lidar*`); the first match applies"""
    fuse: Patterns = ()
    """patterns of streams (as `site/*/lidar*`) that feed one session per node, `site/node/fused`"""
    fused: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")], FusedSettings] = Field(default_factory=dict)
    """sessions of sensors of several nodes, `site/fused/NAME`, by name; no node may be named `fused` then; equal on all
    members of a cluster"""
    sensors: dict[Pattern, SensorSettings] = Field(default_factory=dict)
    """sensors of fused sessions that differ, by stream pattern; the first match applies; equal on all members of a
    cluster"""
    cloud_wait_s: float = Field(default=0.1, ge=0, le=60)
    """longest wait of a frame for its cloud"""
    cloud_memory_s: float = Field(default=2.0, ge=0, le=3600)
    """frames without `has_points` wait for a cloud if one came within this time, in stamps"""
    gap_limit_s: float = Field(default=5.0, gt=0, le=86400)
    """a larger step of the stamps, forward or back, on which three frames agree, restarts the session"""
    rewind_s: float = Field(default=1.0, ge=0, le=60)
    """sensor time within which a late frame is inserted and tracks are corrected; 0: never"""
    late_clouds: bool = False
    """a cloud that comes after its frame was tracked corrects the tracks"""
    recovery_wait_s: float = Field(default=2.0, ge=0, le=60)
    """longest wait for the publisher's cache after a restart"""
    max_speed: float = Field(default=100.0, ge=0, le=1e6)
    """highest speed of a sensor, m/s; poses beyond it are refused; 0: no check"""
    jumps: Literal["off", "report"] = "report"
    """report poses that jump within reach of `max_speed`, unless a relocation announces it"""
    queue_frames: int = Field(default=1024, ge=1, le=65536)
    """frames waiting per stream; then the oldest is dropped"""
    queue_clouds: int = Field(default=16, ge=1, le=1024)
    """clouds waiting per stream, and as many in its session; then the oldest is dropped"""
    workers: int = Field(default=1, ge=1, le=64)
    """processes that share the streams; 1: this process alone"""
    max_pairs: int = Field(default=20_000, ge=100, le=10_000_000)
    """pairs of nearby objects in a frame, a microsecond each; a frame with more is refused"""
    step_limit_s: float = Field(default=0.5, gt=0, le=60)
    """processor time of a message; a stream that takes more is refused for nine times as long"""
    stream_mb: int = Field(default=128, ge=4, le=65536)
    """megabytes of messages per stream; then the oldest are dropped"""
    memory_mb: int = Field(default=1024, ge=16, le=1_048_576)
    """megabytes of messages per process, half of them waiting; then messages are dropped, and the least recently used
    sessions closed"""
    max_sessions: int = Field(default=1000, ge=1, le=10_000)
    """streams tracked at once; further ones are refused"""
    node_sessions: int = Field(default=64, ge=0, le=100_000)
    """the same of one node (`site/node`); 0: no limit"""
    node_rate: int = Field(default=2000, ge=0, le=1_000_000)
    """messages a second of one node; 0: no limit"""
    node_mb_s: int = Field(default=500, ge=0, le=100_000)
    """megabytes a second of one node; 0: no limit"""
    site_sessions: int = Field(default=0, ge=0, le=100_000)
    """the same of one site; 0: no limit"""
    site_rate: int = Field(default=0, ge=0, le=1_000_000)
    """messages a second of one site; 0: no limit"""
    site_mb_s: int = Field(default=0, ge=0, le=100_000)
    """megabytes a second of one site; 0: no limit"""
    keep_days: float = Field(default=30.0, ge=0, le=36_500)
    """checkpoints of a stream silent for this long are deleted, but not its last ids; 0: never"""
    idle_s: float = Field(default=600.0, gt=0)
    """a session without messages for this long is freed"""
    cluster: Servers = ()
    """NATS servers, as `nats://10.0.0.1:4222`, by which instances on many machines share streams"""
    cluster_tls: Path | None = None
    """folder with `ca.pem`, the authority of `tls://` servers, and `cert.pem` and `key.pem` where they ask for a
    certificate; default: the system's authorities"""
    cluster_credentials: Path | None = None
    """file with the credentials of a NATS user (`.creds`), `user:password`, or a token"""
    store: str = ""
    """folder of checkpoints and quarantined sessions; `none`: nothing is kept; default: in `$STATE_DIRECTORY`,
    else in `optipmb` under `$XDG_STATE_HOME` or `~/.local/state`"""
    checkpoint_s: float = Field(default=1.0, ge=0.05, le=3600)
    """time between checkpoints of a changed session"""
    lease_s: float = Field(default=3.0, ge=0.5, le=60)
    """a process that is frozen or cut off for this long loses its streams to the others"""
    standby_s: float = Field(default=10.0, ge=0, le=600)
    """how long messages of streams that others track are kept for a takeover; longer than `lease_s` and
    `checkpoint_s` together; with `cluster` also how far back the message log is read without a checkpoint"""
    standby_mb: int = Field(default=256, ge=1, le=65536)
    """megabytes kept so; clouds are dropped first"""
    log_s: float = Field(default=600.0, ge=10, le=864_000)
    """age up to which the message log (`optipmb-service log`) keeps detections, for a successor"""
    log_mb: int = Field(default=1024, ge=16, le=1_048_576)
    """megabytes of these; the oldest go first"""
    log_tracks_s: float = Field(default=3600.0, ge=0, le=8_640_000)
    """age up to which it keeps tracks, for `q/tracks`; 0: none"""
    log_tracks_mb: int = Field(default=1024, ge=16, le=1_048_576)
    """megabytes of these; the oldest go first"""
    stale_s: float = Field(default=2.0, gt=0)
    """a stream without frames for this long is logged as stale"""
    stuck_s: float = Field(default=5.0, ge=1, le=600)
    """a thread busy with one task, or a worker silent, for this long is stuck: not healthy, or replaced"""
    restart_keys: int = Field(default=50_000, ge=100, le=60_000)
    """keys declared on the network after which a process restarts and its sessions continue: Zenoh has 65,535 for
    the life of a process, a new stream needs 5 to 8"""
    grace_s: float = Field(default=1.0, ge=0, le=60)
    """at shutdown, time for frames already received"""
    http: Address = ""
    """address of health, metrics and live page, as `127.0.0.1:8080`"""
    http_tls: Path | None = None
    """folder with `key.pem` and `cert.pem` for HTTPS, read again when they change; default: no TLS"""
    http_hosts: Names = ()
    """host names with a dot by which the page may be asked for, besides addresses and names without; `*`: any"""
    http_origins: Names = ()
    """origins of other pages that may read over HTTP, as `https://map.example`; `*`: any"""
    http_tokens: str = ""
    """JSON file of names by the SHA-256 of their tokens, or `module:function`; default: all may read, and on a
    loopback address send"""
    http_clients: int = Field(default=32, ge=1, le=128)
    """readers of streams over HTTP at once, viewers of the page among them; further ones are refused"""
    http_senders: int = Field(default=64, ge=1, le=256)
    """requests and WebSockets that send detections over HTTP at once; further ones are refused"""
    sender_idle_s: float = Field(default=30.0, ge=0, le=86_400)
    """time without a frame after which a WebSocket of `http_senders` gives its place to another one"""
    http_streams: int = Field(default=100, ge=0, le=10_000)
    """streams with series of their own in the metrics, by name"""
    grpc: Address = ""
    """address of the gRPC server, as `127.0.0.1:50051`"""
    grpc_tls: Path | None = None
    """folder with `key.pem`, `cert.pem` and `ca.pem` for gRPC: callers need a certificate of that authority;
    default: no TLS, all may do everything"""
    grpc_names: Path | None = None
    """JSON list of the names that may call; default: all with a certificate or token"""
    grpc_tokens: str = Field(default="", pattern=r"^([A-Za-z_][\w.]*:[A-Za-z_]\w*)?$")
    """`module:function` that finds the caller's name in the metadata of a call"""
    grpc_calls: int = Field(default=1000, ge=1, le=100_000)
    """gRPC calls open at once; further ones are refused"""
    grpc_connections: int = Field(default=10_000, ge=1, le=1_000_000)
    """gRPC connections open at once, fewer by the limit of open files; further ones are closed"""
    log_format: Literal["console", "json"] = "console"
    """form of the log lines on stderr"""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """lowest level that is logged"""
    traces: bool = False
    """record spans of every frame with OpenTelemetry, configured by the variables `OTEL_…`; needs the extra `traces`"""
    sites: dict[str, SiteSettings] = Field(default_factory=dict)
    """place of each site's world frame, by which the live page shows latitude, longitude and true heading"""
    zones: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")], ZoneSettings] = Field(default_factory=dict)
    """polygons and lines whose events are published, by name, at most 256 for a session; equal on all members of a
    cluster"""
    outputs: dict[Pattern, OutputSettings] = Field(default_factory=dict)
    """tracks predicted to now, at a fixed rate, by stream pattern (as `garage/*/fused`); the first match applies"""
    inputs: dict[Pattern, InputSettings] = Field(default_factory=dict)
    """frames that come as JSON, by stream pattern (as `garage/*/cam*`); the first match applies"""
    rejoin: dict[Pattern, RejoinSettings] = Field(default_factory=dict)
    """joining of tracks of the same object over gaps, by session pattern; the first match applies; equal on all members
    of a cluster"""
    links: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")], LinkSettings] = Field(default_factory=dict)
    """areas whose streams `optipmb-service link` links, by name"""
    cpm: dict[Pattern, CpmSettings] = Field(default_factory=dict)
    """stations that send collective perception messages over MQTT and to ROS 2, by stream pattern, whose site is in
    `sites`; the first match applies"""
    ros2: Ros2Settings = Ros2Settings()
    """topics of ROS 2, for `optipmb-service ros2`"""
    mqtt: MqttSettings = MqttSettings()
    """a broker of MQTT, for `optipmb-service mqtt`"""
    limits: LimitSettings = LimitSettings()
    """bounds on what one message may hold"""

    @field_validator("cpm")
    @classmethod
    def _check_places(cls, value: dict[str, CpmSettings], info: ValidationInfo) -> dict[str, CpmSettings]:
        for pattern in value:
            if (site := pattern.partition("/")[0]) not in info.data.get("sites", {}):
                raise ValueError(f"{pattern}: a site that is in sites, received {site}")
        return value

    @field_validator("ros2", "mqtt")
    @classmethod
    def _check_stations(cls, value: Ros2Settings | MqttSettings, info: ValidationInfo) -> Ros2Settings | MqttSettings:
        patterns = info.data.get("cpm", {})
        if isinstance(value, MqttSettings):
            if "cpm" in value.topics and not patterns:
                raise ValueError('topics: "cpm" needs a station, [cpm."site/*/*"]')
            return value
        for name, one in value.streams.items():
            if one.cpm and not any(fnmatchcase(name, pattern) for pattern in patterns):
                raise ValueError(f"streams.{name}.cpm: needs a station, [cpm.PATTERN] that matches")
        return value

    def zones_of(self, session: str) -> list[str]:
        """Return the names of the zones of a session, or of all that a pattern matches."""
        site = session.partition("/")[0]
        return [
            name
            for name, one in sorted(self.zones.items())
            if any(fnmatchcase(session, pattern) for pattern in one.streams) and (not one.geo or site in self.sites)
        ]

    def input_of(self, stream: str) -> InputSettings:
        """Return how frames of a stream are read that come as JSON."""
        return next((one for pattern, one in self.inputs.items() if fnmatchcase(stream, pattern)), _USUAL)

    def missing_s(self, session: str) -> float | None:
        """Return the time without a report after which objects count as missed; None: `unseen_time` of the profile.

        For a fused session it is the longest one of the inputs that may feed it.
        """
        node, _, sensor = session.rpartition("/")
        feeding = list(self.fused_sessions[session].streams) if session in self.fused_sessions else []
        if sensor == "fused":
            feeding += [f"{node}/{one.split('/')[2]}" for one in self.fuse if fnmatchcase(node, one.rpartition("/")[0])]
        names = [one for one in self.inputs if any(overlap(one, each) for each in feeding)]
        rules = map(self.input_of, names if feeding else [session])
        return max((one.missing_s for one in rules if not one.is_complete), default=None)

    @property
    def fused_sessions(self) -> dict[str, FusedSettings]:
        """The sessions of `fused` by their names, `site/fused/NAME`."""
        return {f"{one.site}/fused/{name}": one for name, one in self.fused.items()}

    def readable_by(self, node: str) -> frozenset[str]:
        """Return the sessions of `fused` that a node may read."""
        return frozenset(session for session, one in self.fused_sessions.items() if node in one.read)

    def output_of(self, session: str) -> OutputSettings | None:
        """Return the output at a fixed rate of a session; None: it has none."""
        return next((one for pattern, one in self.outputs.items() if fnmatchcase(session, pattern)), None)

    def rejoin_of(self, session: str) -> RejoinSettings | None:
        """Return how tracks of a session are joined over gaps; None: they are not."""
        return next((one for pattern, one in self.rejoin.items() if fnmatchcase(session, pattern)), None)

    def zone(self, name: str, site: str) -> Zone:
        return self.zones[name].zone(name, self.sites.get(site))

    @property
    def is_router(self) -> bool:
        """Whether this process routes for others."""
        return not self.connect if self.router is None else self.router

    @property
    def endpoints(self) -> tuple[str, ...]:
        if self.listen is not None:
            return self.listen
        return (DEFAULT_LISTEN,) if self.is_router else ()

    @property
    def unprotected(self) -> tuple[str, ...]:
        """Addresses beyond this machine where everybody on the way may publish and command, or learn tokens."""
        endpoints = () if self.zenoh_config else self.endpoints
        addresses = [(one, one.partition("/")[2].partition("?")[0].partition("#")[0]) for one in endpoints]
        if self.grpc_tls is None and not self.grpc_tokens and self.grpc:
            addresses.append((f"grpc {self.grpc}", self.grpc))
        if self.http and (self.http_tls is None or not self.http_tokens):
            addresses.append((f"http {self.http}", self.http))
        return tuple(said for said, address in addresses if address.rpartition(":")[0] and not is_loopback(address))

    @property
    def folder(self) -> Path | None:
        """Where state is kept; None: nowhere."""
        if self.store == "none":
            return None
        if self.store:
            return Path(self.store).expanduser()
        # Instances on one network share the state, other networks of the same host have their own.
        where = re.sub(r"[^A-Za-z0-9_.]+", "-", f"{self.prefix} {(*self.connect, *self.endpoints)[0]}")
        return state_home() / where

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Take values given to the constructor alone: `load` reads the file and the environment in its order."""
        del settings_cls, env_settings, dotenv_settings, file_secret_settings
        return (init_settings,)
