"""What bytes from anywhere must never do: one function per decoder, which raises when it finds that they do.

Each takes what the search or a kept file gives, and returns nothing whether the bytes were read or refused.
"""

import contextlib

import optipmb_schemas as schemas
from optipmb_schemas.protobuf import convert
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import transcode
from optipmb_service.edges.grpc.selection import Filter
from optipmb_service.edges.json_frames import FrameReader
from optipmb_service.edges.queues import Pace
from optipmb_service.session.checkpoint import CheckpointError, decode_checkpoint, encode_checkpoint, seal
from optipmb_service.session.convert import density_of
from optipmb_service.session.identity import Incarnation
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.settings import Settings
from router import Sensor

LIMITS = schemas.Limits(max_bytes=2**16, max_json_bytes=2**16, max_values=2**12)
REQUESTS = (pb.TrackRequest, pb.PublishRequest, pb.SubscribeRequest, pb.SetParametersRequest)
CONFIRMED = Filter(pb.TrackFilter(confirmed_only=True, classes=["car"], area=pb.Polygon(x=[0, 9, 0], y=[0, 0, 9])))
SITES = {"a": {"origin": [48.0, 11.0, 500.0]}}
MAPPING = {"objects": "objects.*[]", "name": "class", "position": ("x", "y"), "time": "time"}
INPUTS = {"a/b/mapped": {"format": "mapped", "mapping": MAPPING}}
FRAMES = FrameReader(Settings(sites=SITES, inputs=INPUTS, limits={"max_json_bytes": 2**16}))
POLICY = Policy(checkpoint_bytes=2000)
"""So little that a restored session must go over its first frames again before it can be written down."""


def messages(data: bytes) -> None:
    """A payload is read or refused; a message is written and read again, and is equal.

    The first byte chooses the type of the message.
    """
    if not data:
        return
    kind = schemas.MESSAGES[data[0] % len(schemas.MESSAGES)]
    try:
        message = schemas.decode(data[1:], kind, limits=LIMITS)
    except schemas.MessageError:
        return
    assert schemas.decode(schemas.encode(message), kind) == message


def checkpoints(data: bytes) -> None:
    """A checkpoint is refused, or becomes a session that answers, tracks the next frame, and can be written down again.

    The bytes are taken as they are, and once more as a body under a good seal, which is how a decoder is reached.
    """
    with contextlib.suppress(CheckpointError):
        decode_checkpoint(data)
    try:
        session = Session.restore(decode_checkpoint(seal(data, Incarnation())), 0, POLICY)
    except CheckpointError:
        return
    _answer(session)
    session.on_detections(Sensor(stream=session.stream).detections(3, objects=1), 0)
    session.flush()
    written = _answer(session)
    assert encode_checkpoint(decode_checkpoint(written)) == written


def protobuf(data: bytes) -> None:
    """A request over gRPC is read or refused; detections and clouds that are read survive both forms unchanged.

    The same bytes as tracks of a service are refused, or carried on and filtered.

    The first byte chooses the type of the request.
    """
    if not data:
        return
    with contextlib.suppress(schemas.MessageError):
        tracks = transcode(data[1:], encoding=schemas.encoding_of(schemas.Tracks), limits=LIMITS)
        CONFIRMED.of(tracks.message())
    kind = REQUESTS[data[0] % len(REQUESTS)]
    try:
        request = convert.parse(data[1:], kind)
        if isinstance(request, pb.SubscribeRequest):
            Filter(request.filter)
            Pace(request.max_rate_hz).passes("a/b/c", 0)
            schemas.Keys().matching(request.pattern, "tracks")
        elif isinstance(request, pb.SetParametersRequest):
            convert.from_proto(request.parameters, schemas.SessionParameters, LIMITS)
        elif (name := request.WhichOneof("request")) in {"detections", "points"}:
            model: type[schemas.Message] = schemas.Detections if name == "detections" else schemas.Points
            message = convert.from_proto(getattr(request, name), model, LIMITS)
            assert schemas.decode(schemas.encode(message), model) == message
            assert convert.from_proto(convert.to_proto(message), model) == message
    except schemas.MessageError:
        return


def frames(data: bytes) -> None:
    """A frame in JSON becomes detections that are read again as they are, or is refused; so is a mapped payload."""
    for stream in ("a/b/c", "a/b/mapped"):
        with contextlib.suppress(schemas.MessageError):
            message = FRAMES.read(data, stream).message
            assert schemas.decode(schemas.encode(message), schemas.Detections) == message


def _answer(session: Session) -> bytes:
    session.state()
    density_of(session.density, stream=session.stream, session=session.session, parameters=session.parameters)
    return encode_checkpoint(session.snapshot())


TARGETS = {"messages": messages, "checkpoints": checkpoints, "protobuf": protobuf, "frames": frames}
HEADS = {"messages": 1, "checkpoints": 0, "protobuf": 1, "frames": 0}
"""How many bytes stand before the map."""
