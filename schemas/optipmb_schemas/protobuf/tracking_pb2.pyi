# Generated from tracking.proto by `python -m optipmb_schemas.protobuf.export`. Not to be edited.
from google.protobuf import struct_pb2 as _struct_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DataType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DATA_TYPE_UNSPECIFIED: _ClassVar[DataType]
    DATA_TYPE_F4: _ClassVar[DataType]
    DATA_TYPE_F8: _ClassVar[DataType]
    DATA_TYPE_I1: _ClassVar[DataType]
    DATA_TYPE_I2: _ClassVar[DataType]
    DATA_TYPE_I4: _ClassVar[DataType]
    DATA_TYPE_I8: _ClassVar[DataType]
    DATA_TYPE_U1: _ClassVar[DataType]
    DATA_TYPE_U2: _ClassVar[DataType]
    DATA_TYPE_U4: _ClassVar[DataType]
    DATA_TYPE_U8: _ClassVar[DataType]

class Frame(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FRAME_UNSPECIFIED: _ClassVar[Frame]
    FRAME_WORLD: _ClassVar[Frame]
    FRAME_SENSOR: _ClassVar[Frame]
DATA_TYPE_UNSPECIFIED: DataType
DATA_TYPE_F4: DataType
DATA_TYPE_F8: DataType
DATA_TYPE_I1: DataType
DATA_TYPE_I2: DataType
DATA_TYPE_I4: DataType
DATA_TYPE_I8: DataType
DATA_TYPE_U1: DataType
DATA_TYPE_U2: DataType
DATA_TYPE_U4: DataType
DATA_TYPE_U8: DataType
FRAME_UNSPECIFIED: Frame
FRAME_WORLD: Frame
FRAME_SENSOR: Frame

class Array(_message.Message):
    __slots__ = ("dtype", "shape", "data")
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    dtype: DataType
    shape: _containers.RepeatedScalarFieldContainer[int]
    data: bytes
    def __init__(self, dtype: _Optional[_Union[DataType, str]] = ..., shape: _Optional[_Iterable[int]] = ..., data: _Optional[bytes] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("translation", "quaternion")
    TRANSLATION_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    translation: _containers.RepeatedScalarFieldContainer[float]
    quaternion: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, translation: _Optional[_Iterable[float]] = ..., quaternion: _Optional[_Iterable[float]] = ...) -> None: ...

class Relocation(_message.Message):
    __slots__ = ("world", "translation", "quaternion")
    WORLD_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    world: int
    translation: _containers.RepeatedScalarFieldContainer[float]
    quaternion: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, world: _Optional[int] = ..., translation: _Optional[_Iterable[float]] = ..., quaternion: _Optional[_Iterable[float]] = ...) -> None: ...

class FieldOfView(_message.Message):
    __slots__ = ("azimuth", "elevation", "range")
    AZIMUTH_FIELD_NUMBER: _ClassVar[int]
    ELEVATION_FIELD_NUMBER: _ClassVar[int]
    RANGE_FIELD_NUMBER: _ClassVar[int]
    azimuth: _containers.RepeatedScalarFieldContainer[float]
    elevation: _containers.RepeatedScalarFieldContainer[float]
    range: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, azimuth: _Optional[_Iterable[float]] = ..., elevation: _Optional[_Iterable[float]] = ..., range: _Optional[_Iterable[float]] = ...) -> None: ...

class Attribute(_message.Message):
    __slots__ = ("row", "name", "text", "score")
    ROW_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    row: int
    name: str
    text: str
    score: float
    def __init__(self, row: _Optional[int] = ..., name: _Optional[str] = ..., text: _Optional[str] = ..., score: _Optional[float] = ...) -> None: ...

class Detections(_message.Message):
    __slots__ = ("stream", "epoch", "seq", "stamp_ns", "frame", "pose", "relocation", "labels", "label", "center", "size", "yaw", "score", "velocity", "has_points", "field_of_view", "position_covariance", "embedding", "embedding_model", "attributes")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    RELOCATION_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    CENTER_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    HAS_POINTS_FIELD_NUMBER: _ClassVar[int]
    FIELD_OF_VIEW_FIELD_NUMBER: _ClassVar[int]
    POSITION_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    EMBEDDING_FIELD_NUMBER: _ClassVar[int]
    EMBEDDING_MODEL_FIELD_NUMBER: _ClassVar[int]
    ATTRIBUTES_FIELD_NUMBER: _ClassVar[int]
    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    frame: Frame
    pose: Pose
    relocation: Relocation
    labels: _containers.RepeatedScalarFieldContainer[str]
    label: Array
    center: Array
    size: Array
    yaw: Array
    score: Array
    velocity: Array
    has_points: bool
    field_of_view: FieldOfView
    position_covariance: Array
    embedding: Array
    embedding_model: str
    attributes: _containers.RepeatedCompositeFieldContainer[Attribute]
    def __init__(self, stream: _Optional[str] = ..., epoch: _Optional[bytes] = ..., seq: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., frame: _Optional[_Union[Frame, str]] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., relocation: _Optional[_Union[Relocation, _Mapping]] = ..., labels: _Optional[_Iterable[str]] = ..., label: _Optional[_Union[Array, _Mapping]] = ..., center: _Optional[_Union[Array, _Mapping]] = ..., size: _Optional[_Union[Array, _Mapping]] = ..., yaw: _Optional[_Union[Array, _Mapping]] = ..., score: _Optional[_Union[Array, _Mapping]] = ..., velocity: _Optional[_Union[Array, _Mapping]] = ..., has_points: bool = ..., field_of_view: _Optional[_Union[FieldOfView, _Mapping]] = ..., position_covariance: _Optional[_Union[Array, _Mapping]] = ..., embedding: _Optional[_Union[Array, _Mapping]] = ..., embedding_model: _Optional[str] = ..., attributes: _Optional[_Iterable[_Union[Attribute, _Mapping]]] = ...) -> None: ...

class Points(_message.Message):
    __slots__ = ("stream", "epoch", "seq", "stamp_ns", "frame", "pose", "relocation", "xyz")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    RELOCATION_FIELD_NUMBER: _ClassVar[int]
    XYZ_FIELD_NUMBER: _ClassVar[int]
    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    frame: Frame
    pose: Pose
    relocation: Relocation
    xyz: Array
    def __init__(self, stream: _Optional[str] = ..., epoch: _Optional[bytes] = ..., seq: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., frame: _Optional[_Union[Frame, str]] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., relocation: _Optional[_Union[Relocation, _Mapping]] = ..., xyz: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Delivery(_message.Message):
    __slots__ = ("instance", "received_ns", "published_ns", "queue_ms", "decode_ms", "step_ms", "run", "final_session", "final_ns")
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_NS_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_NS_FIELD_NUMBER: _ClassVar[int]
    QUEUE_MS_FIELD_NUMBER: _ClassVar[int]
    DECODE_MS_FIELD_NUMBER: _ClassVar[int]
    STEP_MS_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    FINAL_SESSION_FIELD_NUMBER: _ClassVar[int]
    FINAL_NS_FIELD_NUMBER: _ClassVar[int]
    instance: str
    received_ns: int
    published_ns: int
    queue_ms: float
    decode_ms: float
    step_ms: float
    run: int
    final_session: str
    final_ns: int
    def __init__(self, instance: _Optional[str] = ..., received_ns: _Optional[int] = ..., published_ns: _Optional[int] = ..., queue_ms: _Optional[float] = ..., decode_ms: _Optional[float] = ..., step_ms: _Optional[float] = ..., run: _Optional[int] = ..., final_session: _Optional[str] = ..., final_ns: _Optional[int] = ...) -> None: ...

class Tracks(_message.Message):
    __slots__ = ("stream", "epoch", "seq", "stamp_ns", "sensor", "session", "revision", "profile", "cloud_used", "gap", "ignored", "world", "labels", "predicted_to_ns", "id", "label", "center", "size", "yaw", "heading_confidence", "velocity", "yaw_rate", "acceleration", "existence", "score", "covariance", "age", "time_since_detection", "detection", "confirmed", "measured", "class_probability", "object", "object_probability", "attributes", "horizons", "path_position", "path_yaw", "path_covariance", "relocation", "delivery")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    PROFILE_FIELD_NUMBER: _ClassVar[int]
    CLOUD_USED_FIELD_NUMBER: _ClassVar[int]
    GAP_FIELD_NUMBER: _ClassVar[int]
    IGNORED_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_TO_NS_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    CENTER_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    HEADING_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_FIELD_NUMBER: _ClassVar[int]
    EXISTENCE_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    AGE_FIELD_NUMBER: _ClassVar[int]
    TIME_SINCE_DETECTION_FIELD_NUMBER: _ClassVar[int]
    DETECTION_FIELD_NUMBER: _ClassVar[int]
    CONFIRMED_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    CLASS_PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    OBJECT_PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    ATTRIBUTES_FIELD_NUMBER: _ClassVar[int]
    HORIZONS_FIELD_NUMBER: _ClassVar[int]
    PATH_POSITION_FIELD_NUMBER: _ClassVar[int]
    PATH_YAW_FIELD_NUMBER: _ClassVar[int]
    PATH_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    RELOCATION_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    sensor: str
    session: str
    revision: int
    profile: str
    cloud_used: bool
    gap: int
    ignored: int
    world: int
    labels: _containers.RepeatedScalarFieldContainer[str]
    predicted_to_ns: int
    id: Array
    label: Array
    center: Array
    size: Array
    yaw: Array
    heading_confidence: Array
    velocity: Array
    yaw_rate: Array
    acceleration: Array
    existence: Array
    score: Array
    covariance: Array
    age: Array
    time_since_detection: Array
    detection: Array
    confirmed: Array
    measured: Array
    class_probability: Array
    object: Array
    object_probability: Array
    attributes: _containers.RepeatedCompositeFieldContainer[Attribute]
    horizons: Array
    path_position: Array
    path_yaw: Array
    path_covariance: Array
    relocation: Relocation
    delivery: Delivery
    def __init__(self, stream: _Optional[str] = ..., epoch: _Optional[bytes] = ..., seq: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., sensor: _Optional[str] = ..., session: _Optional[str] = ..., revision: _Optional[int] = ..., profile: _Optional[str] = ..., cloud_used: bool = ..., gap: _Optional[int] = ..., ignored: _Optional[int] = ..., world: _Optional[int] = ..., labels: _Optional[_Iterable[str]] = ..., predicted_to_ns: _Optional[int] = ..., id: _Optional[_Union[Array, _Mapping]] = ..., label: _Optional[_Union[Array, _Mapping]] = ..., center: _Optional[_Union[Array, _Mapping]] = ..., size: _Optional[_Union[Array, _Mapping]] = ..., yaw: _Optional[_Union[Array, _Mapping]] = ..., heading_confidence: _Optional[_Union[Array, _Mapping]] = ..., velocity: _Optional[_Union[Array, _Mapping]] = ..., yaw_rate: _Optional[_Union[Array, _Mapping]] = ..., acceleration: _Optional[_Union[Array, _Mapping]] = ..., existence: _Optional[_Union[Array, _Mapping]] = ..., score: _Optional[_Union[Array, _Mapping]] = ..., covariance: _Optional[_Union[Array, _Mapping]] = ..., age: _Optional[_Union[Array, _Mapping]] = ..., time_since_detection: _Optional[_Union[Array, _Mapping]] = ..., detection: _Optional[_Union[Array, _Mapping]] = ..., confirmed: _Optional[_Union[Array, _Mapping]] = ..., measured: _Optional[_Union[Array, _Mapping]] = ..., class_probability: _Optional[_Union[Array, _Mapping]] = ..., object: _Optional[_Union[Array, _Mapping]] = ..., object_probability: _Optional[_Union[Array, _Mapping]] = ..., attributes: _Optional[_Iterable[_Union[Attribute, _Mapping]]] = ..., horizons: _Optional[_Union[Array, _Mapping]] = ..., path_position: _Optional[_Union[Array, _Mapping]] = ..., path_yaw: _Optional[_Union[Array, _Mapping]] = ..., path_covariance: _Optional[_Union[Array, _Mapping]] = ..., relocation: _Optional[_Union[Relocation, _Mapping]] = ..., delivery: _Optional[_Union[Delivery, _Mapping]] = ...) -> None: ...

class ZoneEvent(_message.Message):
    __slots__ = ("zone", "kind", "n", "id", "label", "at_ns", "position", "speed", "yaw", "how", "dwell_s", "direction", "object")
    ZONE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    N_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    AT_NS_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    HOW_FIELD_NUMBER: _ClassVar[int]
    DWELL_S_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    zone: str
    kind: str
    n: int
    id: int
    label: int
    at_ns: int
    position: _containers.RepeatedScalarFieldContainer[float]
    speed: float
    yaw: float
    how: str
    dwell_s: float
    direction: str
    object: int
    def __init__(self, zone: _Optional[str] = ..., kind: _Optional[str] = ..., n: _Optional[int] = ..., id: _Optional[int] = ..., label: _Optional[int] = ..., at_ns: _Optional[int] = ..., position: _Optional[_Iterable[float]] = ..., speed: _Optional[float] = ..., yaw: _Optional[float] = ..., how: _Optional[str] = ..., dwell_s: _Optional[float] = ..., direction: _Optional[str] = ..., object: _Optional[int] = ...) -> None: ...

class ZoneCount(_message.Message):
    __slots__ = ("zone", "inside", "entered", "left", "appeared", "lost", "to_left", "to_right", "distinct")
    ZONE_FIELD_NUMBER: _ClassVar[int]
    INSIDE_FIELD_NUMBER: _ClassVar[int]
    ENTERED_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    APPEARED_FIELD_NUMBER: _ClassVar[int]
    LOST_FIELD_NUMBER: _ClassVar[int]
    TO_LEFT_FIELD_NUMBER: _ClassVar[int]
    TO_RIGHT_FIELD_NUMBER: _ClassVar[int]
    DISTINCT_FIELD_NUMBER: _ClassVar[int]
    zone: str
    inside: _containers.RepeatedScalarFieldContainer[int]
    entered: _containers.RepeatedScalarFieldContainer[int]
    left: _containers.RepeatedScalarFieldContainer[int]
    appeared: _containers.RepeatedScalarFieldContainer[int]
    lost: _containers.RepeatedScalarFieldContainer[int]
    to_left: _containers.RepeatedScalarFieldContainer[int]
    to_right: _containers.RepeatedScalarFieldContainer[int]
    distinct: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, zone: _Optional[str] = ..., inside: _Optional[_Iterable[int]] = ..., entered: _Optional[_Iterable[int]] = ..., left: _Optional[_Iterable[int]] = ..., appeared: _Optional[_Iterable[int]] = ..., lost: _Optional[_Iterable[int]] = ..., to_left: _Optional[_Iterable[int]] = ..., to_right: _Optional[_Iterable[int]] = ..., distinct: _Optional[_Iterable[int]] = ...) -> None: ...

class Events(_message.Message):
    __slots__ = ("stream", "epoch", "seq", "stamp_ns", "sensor", "session", "revision", "labels", "events", "attributes", "zones", "delivery")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    ATTRIBUTES_FIELD_NUMBER: _ClassVar[int]
    ZONES_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    sensor: str
    session: str
    revision: int
    labels: _containers.RepeatedScalarFieldContainer[str]
    events: _containers.RepeatedCompositeFieldContainer[ZoneEvent]
    attributes: _containers.RepeatedCompositeFieldContainer[Attribute]
    zones: _containers.RepeatedCompositeFieldContainer[ZoneCount]
    delivery: Delivery
    def __init__(self, stream: _Optional[str] = ..., epoch: _Optional[bytes] = ..., seq: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., sensor: _Optional[str] = ..., session: _Optional[str] = ..., revision: _Optional[int] = ..., labels: _Optional[_Iterable[str]] = ..., events: _Optional[_Iterable[_Union[ZoneEvent, _Mapping]]] = ..., attributes: _Optional[_Iterable[_Union[Attribute, _Mapping]]] = ..., zones: _Optional[_Iterable[_Union[ZoneCount, _Mapping]]] = ..., delivery: _Optional[_Union[Delivery, _Mapping]] = ...) -> None: ...

class Problem(_message.Message):
    __slots__ = ("stream", "instance", "code", "path", "expected", "received", "message", "seq", "stamp_ns", "count", "reported_ns")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    REPORTED_NS_FIELD_NUMBER: _ClassVar[int]
    stream: str
    instance: str
    code: str
    path: str
    expected: str
    received: str
    message: str
    seq: int
    stamp_ns: int
    count: int
    reported_ns: int
    def __init__(self, stream: _Optional[str] = ..., instance: _Optional[str] = ..., code: _Optional[str] = ..., path: _Optional[str] = ..., expected: _Optional[str] = ..., received: _Optional[str] = ..., message: _Optional[str] = ..., seq: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., count: _Optional[int] = ..., reported_ns: _Optional[int] = ...) -> None: ...

class SessionState(_message.Message):
    __slots__ = ("stream", "session", "state", "profile", "epoch", "seq", "stamp_ns", "received", "frames", "duplicates", "late", "inserted", "corrected", "refused", "shed", "gaps", "new_epochs", "clouds_used", "clouds_missed", "repaired", "clouds_refused", "rejoined", "lost_dropped", "embedding_ignored", "lost_objects", "tracks", "bernoullis", "poissons", "next_id", "queue", "digest")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PROFILE_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    DUPLICATES_FIELD_NUMBER: _ClassVar[int]
    LATE_FIELD_NUMBER: _ClassVar[int]
    INSERTED_FIELD_NUMBER: _ClassVar[int]
    CORRECTED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    SHED_FIELD_NUMBER: _ClassVar[int]
    GAPS_FIELD_NUMBER: _ClassVar[int]
    NEW_EPOCHS_FIELD_NUMBER: _ClassVar[int]
    CLOUDS_USED_FIELD_NUMBER: _ClassVar[int]
    CLOUDS_MISSED_FIELD_NUMBER: _ClassVar[int]
    REPAIRED_FIELD_NUMBER: _ClassVar[int]
    CLOUDS_REFUSED_FIELD_NUMBER: _ClassVar[int]
    REJOINED_FIELD_NUMBER: _ClassVar[int]
    LOST_DROPPED_FIELD_NUMBER: _ClassVar[int]
    EMBEDDING_IGNORED_FIELD_NUMBER: _ClassVar[int]
    LOST_OBJECTS_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    BERNOULLIS_FIELD_NUMBER: _ClassVar[int]
    POISSONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_ID_FIELD_NUMBER: _ClassVar[int]
    QUEUE_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    stream: str
    session: str
    state: str
    profile: str
    epoch: bytes
    seq: int
    stamp_ns: int
    received: int
    frames: int
    duplicates: int
    late: int
    inserted: int
    corrected: int
    refused: int
    shed: int
    gaps: int
    new_epochs: int
    clouds_used: int
    clouds_missed: int
    repaired: int
    clouds_refused: int
    rejoined: int
    lost_dropped: int
    embedding_ignored: int
    lost_objects: int
    tracks: int
    bernoullis: int
    poissons: int
    next_id: int
    queue: int
    digest: str
    def __init__(self, stream: _Optional[str] = ..., session: _Optional[str] = ..., state: _Optional[str] = ..., profile: _Optional[str] = ..., epoch: _Optional[bytes] = ..., seq: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., received: _Optional[int] = ..., frames: _Optional[int] = ..., duplicates: _Optional[int] = ..., late: _Optional[int] = ..., inserted: _Optional[int] = ..., corrected: _Optional[int] = ..., refused: _Optional[int] = ..., shed: _Optional[int] = ..., gaps: _Optional[int] = ..., new_epochs: _Optional[int] = ..., clouds_used: _Optional[int] = ..., clouds_missed: _Optional[int] = ..., repaired: _Optional[int] = ..., clouds_refused: _Optional[int] = ..., rejoined: _Optional[int] = ..., lost_dropped: _Optional[int] = ..., embedding_ignored: _Optional[int] = ..., lost_objects: _Optional[int] = ..., tracks: _Optional[int] = ..., bernoullis: _Optional[int] = ..., poissons: _Optional[int] = ..., next_id: _Optional[int] = ..., queue: _Optional[int] = ..., digest: _Optional[str] = ...) -> None: ...

class SessionParameters(_message.Message):
    __slots__ = ("profile", "cloud_wait_s", "horizons", "restart", "values", "sensors", "session")
    PROFILE_FIELD_NUMBER: _ClassVar[int]
    CLOUD_WAIT_S_FIELD_NUMBER: _ClassVar[int]
    HORIZONS_FIELD_NUMBER: _ClassVar[int]
    RESTART_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    SENSORS_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    profile: str
    cloud_wait_s: float
    horizons: Array
    restart: bool
    values: _struct_pb2.Struct
    sensors: _struct_pb2.Struct
    session: str
    def __init__(self, profile: _Optional[str] = ..., cloud_wait_s: _Optional[float] = ..., horizons: _Optional[_Union[Array, _Mapping]] = ..., restart: bool = ..., values: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., sensors: _Optional[_Union[_struct_pb2.Struct, _Mapping]] = ..., session: _Optional[str] = ...) -> None: ...

class SessionSummary(_message.Message):
    __slots__ = ("stream", "profile", "state", "rate_hz", "latency_p50_ms", "latency_p99_ms", "frames", "refused", "shed", "gaps", "tracks", "queue", "age_s", "worker", "sensors", "silent", "late", "duplicates", "configured", "learned", "rejoined", "lost_objects", "lost_dropped", "embedding_ignored")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    PROFILE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P50_MS_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P99_MS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    SHED_FIELD_NUMBER: _ClassVar[int]
    GAPS_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    QUEUE_FIELD_NUMBER: _ClassVar[int]
    AGE_S_FIELD_NUMBER: _ClassVar[int]
    WORKER_FIELD_NUMBER: _ClassVar[int]
    SENSORS_FIELD_NUMBER: _ClassVar[int]
    SILENT_FIELD_NUMBER: _ClassVar[int]
    LATE_FIELD_NUMBER: _ClassVar[int]
    DUPLICATES_FIELD_NUMBER: _ClassVar[int]
    CONFIGURED_FIELD_NUMBER: _ClassVar[int]
    LEARNED_FIELD_NUMBER: _ClassVar[int]
    REJOINED_FIELD_NUMBER: _ClassVar[int]
    LOST_OBJECTS_FIELD_NUMBER: _ClassVar[int]
    LOST_DROPPED_FIELD_NUMBER: _ClassVar[int]
    EMBEDDING_IGNORED_FIELD_NUMBER: _ClassVar[int]
    stream: str
    profile: str
    state: str
    rate_hz: float
    latency_p50_ms: float
    latency_p99_ms: float
    frames: int
    refused: int
    shed: int
    gaps: int
    tracks: int
    queue: int
    age_s: float
    worker: int
    sensors: _containers.RepeatedScalarFieldContainer[str]
    silent: _containers.RepeatedScalarFieldContainer[str]
    late: int
    duplicates: int
    configured: str
    learned: _containers.RepeatedScalarFieldContainer[str]
    rejoined: int
    lost_objects: int
    lost_dropped: int
    embedding_ignored: int
    def __init__(self, stream: _Optional[str] = ..., profile: _Optional[str] = ..., state: _Optional[str] = ..., rate_hz: _Optional[float] = ..., latency_p50_ms: _Optional[float] = ..., latency_p99_ms: _Optional[float] = ..., frames: _Optional[int] = ..., refused: _Optional[int] = ..., shed: _Optional[int] = ..., gaps: _Optional[int] = ..., tracks: _Optional[int] = ..., queue: _Optional[int] = ..., age_s: _Optional[float] = ..., worker: _Optional[int] = ..., sensors: _Optional[_Iterable[str]] = ..., silent: _Optional[_Iterable[str]] = ..., late: _Optional[int] = ..., duplicates: _Optional[int] = ..., configured: _Optional[str] = ..., learned: _Optional[_Iterable[str]] = ..., rejoined: _Optional[int] = ..., lost_objects: _Optional[int] = ..., lost_dropped: _Optional[int] = ..., embedding_ignored: _Optional[int] = ...) -> None: ...

class TrackRequest(_message.Message):
    __slots__ = ("detections", "points", "traceparent")
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    TRACEPARENT_FIELD_NUMBER: _ClassVar[int]
    detections: Detections
    points: Points
    traceparent: str
    def __init__(self, detections: _Optional[_Union[Detections, _Mapping]] = ..., points: _Optional[_Union[Points, _Mapping]] = ..., traceparent: _Optional[str] = ...) -> None: ...

class TrackResponse(_message.Message):
    __slots__ = ("tracks", "problem", "skipped")
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    tracks: Tracks
    problem: Problem
    skipped: int
    def __init__(self, tracks: _Optional[_Union[Tracks, _Mapping]] = ..., problem: _Optional[_Union[Problem, _Mapping]] = ..., skipped: _Optional[int] = ...) -> None: ...

class PublishOptions(_message.Message):
    __slots__ = ("stream", "cache", "cache_clouds")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    CACHE_FIELD_NUMBER: _ClassVar[int]
    CACHE_CLOUDS_FIELD_NUMBER: _ClassVar[int]
    stream: str
    cache: int
    cache_clouds: int
    def __init__(self, stream: _Optional[str] = ..., cache: _Optional[int] = ..., cache_clouds: _Optional[int] = ...) -> None: ...

class PublishRequest(_message.Message):
    __slots__ = ("options", "detections", "points", "traceparent")
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    TRACEPARENT_FIELD_NUMBER: _ClassVar[int]
    options: PublishOptions
    detections: Detections
    points: Points
    traceparent: str
    def __init__(self, options: _Optional[_Union[PublishOptions, _Mapping]] = ..., detections: _Optional[_Union[Detections, _Mapping]] = ..., points: _Optional[_Union[Points, _Mapping]] = ..., traceparent: _Optional[str] = ...) -> None: ...

class Acknowledgement(_message.Message):
    __slots__ = ("detections", "points", "points_wanted")
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    POINTS_WANTED_FIELD_NUMBER: _ClassVar[int]
    detections: int
    points: int
    points_wanted: bool
    def __init__(self, detections: _Optional[int] = ..., points: _Optional[int] = ..., points_wanted: bool = ...) -> None: ...

class PublishResponse(_message.Message):
    __slots__ = ("acknowledgement", "problem", "skipped")
    ACKNOWLEDGEMENT_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    acknowledgement: Acknowledgement
    problem: Problem
    skipped: int
    def __init__(self, acknowledgement: _Optional[_Union[Acknowledgement, _Mapping]] = ..., problem: _Optional[_Union[Problem, _Mapping]] = ..., skipped: _Optional[int] = ...) -> None: ...

class Polygon(_message.Message):
    __slots__ = ("x", "y")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ...) -> None: ...

class TrackFilter(_message.Message):
    __slots__ = ("classes", "confirmed_only", "min_existence", "area", "fields")
    CLASSES_FIELD_NUMBER: _ClassVar[int]
    CONFIRMED_ONLY_FIELD_NUMBER: _ClassVar[int]
    MIN_EXISTENCE_FIELD_NUMBER: _ClassVar[int]
    AREA_FIELD_NUMBER: _ClassVar[int]
    FIELDS_FIELD_NUMBER: _ClassVar[int]
    classes: _containers.RepeatedScalarFieldContainer[str]
    confirmed_only: bool
    min_existence: float
    area: Polygon
    fields: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, classes: _Optional[_Iterable[str]] = ..., confirmed_only: bool = ..., min_existence: _Optional[float] = ..., area: _Optional[_Union[Polygon, _Mapping]] = ..., fields: _Optional[_Iterable[str]] = ...) -> None: ...

class SubscribeRequest(_message.Message):
    __slots__ = ("pattern", "filter", "max_rate_hz", "queue", "history", "problems", "predict")
    PATTERN_FIELD_NUMBER: _ClassVar[int]
    FILTER_FIELD_NUMBER: _ClassVar[int]
    MAX_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    QUEUE_FIELD_NUMBER: _ClassVar[int]
    HISTORY_FIELD_NUMBER: _ClassVar[int]
    PROBLEMS_FIELD_NUMBER: _ClassVar[int]
    PREDICT_FIELD_NUMBER: _ClassVar[int]
    pattern: str
    filter: TrackFilter
    max_rate_hz: float
    queue: int
    history: bool
    problems: bool
    predict: bool
    def __init__(self, pattern: _Optional[str] = ..., filter: _Optional[_Union[TrackFilter, _Mapping]] = ..., max_rate_hz: _Optional[float] = ..., queue: _Optional[int] = ..., history: bool = ..., problems: bool = ..., predict: bool = ...) -> None: ...

class SubscribeResponse(_message.Message):
    __slots__ = ("tracks", "problem", "skipped")
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    tracks: Tracks
    problem: Problem
    skipped: int
    def __init__(self, tracks: _Optional[_Union[Tracks, _Mapping]] = ..., problem: _Optional[_Union[Problem, _Mapping]] = ..., skipped: _Optional[int] = ...) -> None: ...

class SubscribeEventsRequest(_message.Message):
    __slots__ = ("pattern", "zones", "kinds", "classes", "final", "history")
    PATTERN_FIELD_NUMBER: _ClassVar[int]
    ZONES_FIELD_NUMBER: _ClassVar[int]
    KINDS_FIELD_NUMBER: _ClassVar[int]
    CLASSES_FIELD_NUMBER: _ClassVar[int]
    FINAL_FIELD_NUMBER: _ClassVar[int]
    HISTORY_FIELD_NUMBER: _ClassVar[int]
    pattern: str
    zones: _containers.RepeatedScalarFieldContainer[str]
    kinds: _containers.RepeatedScalarFieldContainer[str]
    classes: _containers.RepeatedScalarFieldContainer[str]
    final: bool
    history: bool
    def __init__(self, pattern: _Optional[str] = ..., zones: _Optional[_Iterable[str]] = ..., kinds: _Optional[_Iterable[str]] = ..., classes: _Optional[_Iterable[str]] = ..., final: bool = ..., history: bool = ...) -> None: ...

class SubscribeEventsResponse(_message.Message):
    __slots__ = ("events", "skipped")
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    events: Events
    skipped: int
    def __init__(self, events: _Optional[_Union[Events, _Mapping]] = ..., skipped: _Optional[int] = ...) -> None: ...

class GetStateRequest(_message.Message):
    __slots__ = ("stream",)
    STREAM_FIELD_NUMBER: _ClassVar[int]
    stream: str
    def __init__(self, stream: _Optional[str] = ...) -> None: ...

class GetStateResponse(_message.Message):
    __slots__ = ("state",)
    STATE_FIELD_NUMBER: _ClassVar[int]
    state: SessionState
    def __init__(self, state: _Optional[_Union[SessionState, _Mapping]] = ...) -> None: ...

class LinkedObject(_message.Message):
    __slots__ = ("global_id", "stream", "session", "object", "probability", "kind", "ended")
    GLOBAL_ID_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    OBJECT_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    global_id: bytes
    stream: str
    session: str
    object: int
    probability: float
    kind: str
    ended: bool
    def __init__(self, global_id: _Optional[bytes] = ..., stream: _Optional[str] = ..., session: _Optional[str] = ..., object: _Optional[int] = ..., probability: _Optional[float] = ..., kind: _Optional[str] = ..., ended: bool = ...) -> None: ...

class Links(_message.Message):
    __slots__ = ("area", "revision", "stamp_ns", "whole", "objects")
    AREA_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    WHOLE_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    area: str
    revision: int
    stamp_ns: int
    whole: bool
    objects: _containers.RepeatedCompositeFieldContainer[LinkedObject]
    def __init__(self, area: _Optional[str] = ..., revision: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., whole: bool = ..., objects: _Optional[_Iterable[_Union[LinkedObject, _Mapping]]] = ...) -> None: ...

class GetLinksRequest(_message.Message):
    __slots__ = ("area",)
    AREA_FIELD_NUMBER: _ClassVar[int]
    area: str
    def __init__(self, area: _Optional[str] = ...) -> None: ...

class GetLinksResponse(_message.Message):
    __slots__ = ("links",)
    LINKS_FIELD_NUMBER: _ClassVar[int]
    links: Links
    def __init__(self, links: _Optional[_Union[Links, _Mapping]] = ...) -> None: ...

class ResetRequest(_message.Message):
    __slots__ = ("stream", "close")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    CLOSE_FIELD_NUMBER: _ClassVar[int]
    stream: str
    close: bool
    def __init__(self, stream: _Optional[str] = ..., close: bool = ...) -> None: ...

class ResetResponse(_message.Message):
    __slots__ = ("state",)
    STATE_FIELD_NUMBER: _ClassVar[int]
    state: SessionState
    def __init__(self, state: _Optional[_Union[SessionState, _Mapping]] = ...) -> None: ...

class SetParametersRequest(_message.Message):
    __slots__ = ("stream", "parameters")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    stream: str
    parameters: SessionParameters
    def __init__(self, stream: _Optional[str] = ..., parameters: _Optional[_Union[SessionParameters, _Mapping]] = ...) -> None: ...

class SetParametersResponse(_message.Message):
    __slots__ = ("parameters",)
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    parameters: SessionParameters
    def __init__(self, parameters: _Optional[_Union[SessionParameters, _Mapping]] = ...) -> None: ...

class ListStreamsRequest(_message.Message):
    __slots__ = ("pattern",)
    PATTERN_FIELD_NUMBER: _ClassVar[int]
    pattern: str
    def __init__(self, pattern: _Optional[str] = ...) -> None: ...

class ListedStream(_message.Message):
    __slots__ = ("instance", "session")
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    instance: str
    session: SessionSummary
    def __init__(self, instance: _Optional[str] = ..., session: _Optional[_Union[SessionSummary, _Mapping]] = ...) -> None: ...

class ListStreamsResponse(_message.Message):
    __slots__ = ("streams",)
    STREAMS_FIELD_NUMBER: _ClassVar[int]
    streams: _containers.RepeatedCompositeFieldContainer[ListedStream]
    def __init__(self, streams: _Optional[_Iterable[_Union[ListedStream, _Mapping]]] = ...) -> None: ...

class QueryTracksRequest(_message.Message):
    __slots__ = ("pattern", "from_ns", "to_ns", "filter")
    PATTERN_FIELD_NUMBER: _ClassVar[int]
    FROM_NS_FIELD_NUMBER: _ClassVar[int]
    TO_NS_FIELD_NUMBER: _ClassVar[int]
    FILTER_FIELD_NUMBER: _ClassVar[int]
    pattern: str
    from_ns: int
    to_ns: int
    filter: TrackFilter
    def __init__(self, pattern: _Optional[str] = ..., from_ns: _Optional[int] = ..., to_ns: _Optional[int] = ..., filter: _Optional[_Union[TrackFilter, _Mapping]] = ...) -> None: ...

class QueryTracksResponse(_message.Message):
    __slots__ = ("tracks",)
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    tracks: Tracks
    def __init__(self, tracks: _Optional[_Union[Tracks, _Mapping]] = ...) -> None: ...
