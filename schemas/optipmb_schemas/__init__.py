"""Messages of the tracking service: typed models, a bounded codec, Zenoh keys.

    from optipmb_schemas import Detections, Keys, decode, encode, encoding_of

`docs/messages.md` describes the same for publishers in other languages.
"""

from optipmb_schemas.arrays import Array
from optipmb_schemas.codec import MESSAGES, decode, encode, encode_columns, encode_json, encoded, encoding_of
from optipmb_schemas.control import (
    DrainRequest,
    MemberSummary,
    MoveRequest,
    Problem,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    SessionSummary,
    TracksRequest,
)
from optipmb_schemas.dump import STORED, Dump, DumpedFrame, decode_dump, encode_dump
from optipmb_schemas.errors import CODES, Code, MessageError
from optipmb_schemas.keys import PREFIX, Keys, Query, Topic
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import (
    PATHS,
    Attribute,
    Delivery,
    Density,
    Detections,
    Events,
    FieldOfView,
    LinkedObject,
    Links,
    Points,
    Pose,
    Relocation,
    Tracks,
    ZoneCount,
    ZoneEvent,
    attributes_by_name,
    attributes_of_rows,
    path_fields,
    track_fields,
)
from optipmb_schemas.model import Message

__all__ = [
    "CODES",
    "DEFAULT",
    "MESSAGES",
    "PATHS",
    "PREFIX",
    "STORED",
    "Array",
    "Attribute",
    "Code",
    "Delivery",
    "Density",
    "Detections",
    "DrainRequest",
    "Dump",
    "DumpedFrame",
    "Events",
    "FieldOfView",
    "Keys",
    "Limits",
    "LinkedObject",
    "Links",
    "MemberSummary",
    "Message",
    "MessageError",
    "MoveRequest",
    "Points",
    "Pose",
    "Problem",
    "Query",
    "Relocation",
    "ResetRequest",
    "ServiceStatus",
    "SessionParameters",
    "SessionState",
    "SessionSummary",
    "Topic",
    "Tracks",
    "TracksRequest",
    "ZoneCount",
    "ZoneEvent",
    "attributes_by_name",
    "attributes_of_rows",
    "decode",
    "decode_dump",
    "encode",
    "encode_columns",
    "encode_dump",
    "encode_json",
    "encoded",
    "encoding_of",
    "path_fields",
    "track_fields",
]
