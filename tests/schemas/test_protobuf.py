"""Protobuf says the same as msgpack: the same messages, the same bytes on Zenoh afterwards, the same errors."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from optipmb_schemas import MessageError, SessionParameters, decode, encode, encode_json, encoding_of
from optipmb_schemas.messages import Detections, Message, Points, Relocation, Tracks
from optipmb_schemas.protobuf import convert, export
from optipmb_schemas.protobuf import tracking_pb2 as pb
from optipmb_schemas.protobuf.convert import transcode

SCHEMAS = Path(__file__).parents[2] / "schemas"
BUF = Path(sys.executable).parent / "buf"


def proto_of(message: Message) -> Any:
    """The message after a way over the wire."""
    proto = convert.to_proto(message)
    return convert.parse(proto.SerializeToString(), type(proto))


def buf(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([BUF, *arguments], cwd=SCHEMAS / "proto", capture_output=True, text=True, check=False)


def test_what_is_generated_is_current(capsys: pytest.CaptureFixture[str]) -> None:
    """Comments of the schema come from the models, and the Python modules from the schema."""
    assert export.main(["--check", str(SCHEMAS)]) == 0, capsys.readouterr()


def test_a_stale_schema_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A field that the model lacks is named, and nothing is written."""
    shutil.copytree(SCHEMAS / "proto", tmp_path / "proto")
    source = tmp_path / "proto" / export.SOURCE
    text = source.read_text().replace("  int64 gap = 9;", "  int64 gaps = 9;")
    source.write_text(text)
    assert export.main(["--check", str(tmp_path)]) == 2
    assert "Tracks differ from its model: ['gaps']" in capsys.readouterr().err
    assert source.read_text() == text


def test_a_new_field_of_a_model_is_added_to_its_message() -> None:
    """A column and a counter that the schema lacks get the next free numbers, at their places."""
    source = (SCHEMAS / "proto" / export.SOURCE).read_text()
    fields = {"Tracks": "  Array confirmed = 28;\n", "SessionState": "  optional int64 rejoined = 28;\n"}
    bare = source
    for field in fields.values():
        bare = bare.replace(field, "")
    assert len(bare) < len(source) - 50
    added = export.commented(bare)
    for name, field in fields.items():
        body = bare.split(f"message {name} {{")[1].split("\n}")[0]
        following = max(map(int, re.findall(r" = (\d+);", body))) + 1
        added = added.replace(field.replace("28", str(following)), field)
    assert added == source


def test_the_schema_is_well_formed() -> None:
    """`buf lint` and `buf format` find nothing."""
    assert buf("lint").stdout == ""
    assert buf("format", "--diff").stdout == ""


def test_clients_of_an_earlier_version_go_on() -> None:
    """The schema breaks nothing that the released one promised (`released.json`, made by `buf build -o`)."""
    checked = buf("breaking", "--against", "released.json")
    assert (checked.returncode, checked.stdout) == (0, "")


def test_a_breaking_change_is_found(tmp_path: Path) -> None:
    """A field that changes its number is refused by the check above."""
    shutil.copytree(SCHEMAS / "proto", tmp_path / "proto")
    source = tmp_path / "proto" / export.SOURCE
    source.write_text(source.read_text().replace("int64 gap = 9;", "int64 gap = 90;"))
    checked = buf("breaking", str(tmp_path / "proto"), "--against", "released.json")
    assert checked.returncode != 0
    assert "gap" in checked.stdout


@pytest.mark.parametrize("kind", export.MODELS, ids=lambda kind: kind.__name__)
def test_messages_survive(kind: type[Message], example_of: Any) -> None:
    """Every message comes back from protobuf equal, and its msgpack is byte-equal (but `Struct` has no integers)."""
    message = example_of(kind)
    back = convert.from_proto(proto_of(message), kind)
    assert back == message
    assert encode(back) == encode(message) or kind is SessionParameters


def test_covariances_survive(example_of: Any) -> None:
    """Detections with covariances of their positions, unknown ones among them, come back byte-equal; others do not."""
    spread = np.array([np.eye(3), np.full((3, 3), np.nan), np.diag([0.5, 2.0, 1.0])])
    message = Detections(**(dict(example_of(Detections).present()) | {"position_covariance": spread}))
    assert encode(convert.from_proto(proto_of(message), Detections)) == encode(message)
    proto = proto_of(message)
    proto.position_covariance.data = np.array([np.eye(3), np.eye(3), -np.eye(3)]).tobytes()
    with pytest.raises(MessageError, match=r"position_covariance\[2\]"):
        convert.from_proto(proto, Detections)


@pytest.mark.parametrize(
    "unknown",
    [{"yaw": None, "size": None}, {"yaw": [0.5, np.nan, 1.0], "size": [[4.0, np.nan, 1.5], [np.nan] * 3, [1.0] * 3]}],
)
def test_detections_without_headings_and_sizes_survive(unknown: dict[str, Any], example_of: Any) -> None:
    """Absent columns stay absent, and unknown numbers unknown."""
    center = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 0.5], [5.0, 6.0, np.nan]])
    message = Detections(**(dict(example_of(Detections).present()) | unknown | {"center": center}))
    assert encode(convert.from_proto(proto_of(message), Detections)) == encode(message)


@pytest.mark.parametrize("rows", [0, 1, 5000])
def test_columns_of_any_length_survive(rows: int) -> None:
    """A frame without objects and the largest one are no exceptions."""
    points = Points(
        stream="a/b/c", epoch=bytes(16), seq=0, stamp_ns=0, frame="world", xyz=np.ones((rows, 3), dtype="f4")
    )
    assert encode(convert.from_proto(proto_of(points), Points)) == encode(points)


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"center": pb.Array(dtype=pb.DATA_TYPE_F8, shape=[3, 2], data=bytes(48))}, "center"),
        ({"center": pb.Array(dtype=pb.DATA_TYPE_F8, shape=[3, 3], data=bytes(71))}, "center.data"),
        ({"center": pb.Array(shape=[3, 3], data=bytes(72))}, "center.dtype"),
        ({"center": pb.Array(dtype=99, shape=[3, 3], data=bytes(72))}, "center.dtype"),  # type: ignore[arg-type]
        ({"center": pb.Array(dtype=pb.DATA_TYPE_F8, shape=[2**32 - 1] * 9)}, "center.shape"),
        ({"score": pb.Array(dtype=pb.DATA_TYPE_F8, shape=[3], data=np.array([0.5, 2.0, 0.5]).tobytes())}, "score[1]"),
        ({"yaw": pb.Array(dtype=pb.DATA_TYPE_F8, shape=[2], data=bytes(16))}, "yaw"),
        ({"label": pb.Array(dtype=pb.DATA_TYPE_F4, shape=[3], data=bytes(12))}, "label"),
        ({"pose": pb.Pose(translation=[0, 0], quaternion=[1, 0, 0, 0])}, "pose.translation"),
        ({"pose": pb.Pose(translation=[0.0] * 100_000, quaternion=[1, 0, 0, 0])}, "pose.translation"),
        ({"epoch": b"short"}, "epoch"),
        ({"stream": "a/b"}, "stream"),
        ({"frame": pb.FRAME_UNSPECIFIED}, "frame"),
        ({"seq": -1}, "seq"),
        ({"labels": ["car"] * 300}, "labels"),
    ],
)
def test_errors_name_the_field(change: dict[str, Any], path: str, example_of: Any) -> None:
    """An invalid value is refused with the path of the field, as in msgpack."""
    proto = proto_of(example_of(Detections))
    for name in change:
        proto.ClearField(name)
    proto.MergeFrom(pb.Detections(**change))
    with pytest.raises(MessageError) as raised:
        convert.from_proto(proto, Detections)
    assert raised.value.path == path


@pytest.mark.parametrize("name", ["seq", "stamp_ns", "center", "pose"])
def test_missing_fields_are_named(name: str, example_of: Any) -> None:
    """A required field that is absent is no zero: it is missing, as in msgpack."""
    proto = proto_of(example_of(Detections))
    proto.ClearField(name)
    with pytest.raises(MessageError) as raised:
        convert.from_proto(proto, Detections)
    assert (raised.value.code, raised.value.path) == ("missing_field", name)


def test_bytes_that_are_no_message() -> None:
    """They are malformed, and the error says of which type they should be."""
    with pytest.raises(MessageError, match=r"optipmb\.v1\.TrackRequest.*malformed"):
        convert.parse(b"\xff\xff\xff", pb.TrackRequest)


def test_unknown_fields_are_ignored(example_of: Any) -> None:
    """A field of a later version changes nothing."""
    message = example_of(Detections)
    payload = convert.to_proto(message).SerializeToString() + b"\xa2\x06\x03new"
    assert convert.from_proto(convert.parse(payload, pb.Detections), Detections) == message
    assert decode(encode(message), Detections) == message


def test_tracks_are_transcoded_as_they_are(example_of: Any) -> None:
    """Without a model between them the result is the same, in any form."""
    tracks = example_of(Tracks)
    expected = convert.to_proto(tracks)
    assert transcode(encode(tracks), encoding=encoding_of(Tracks)).message() == expected
    assert transcode(encode(tracks)).message() == expected
    assert transcode(encode_json(tracks), encoding=encoding_of(Tracks, form="json")).message() == expected
    newer = msgpack.packb(msgpack.unpackb(encode(tracks)) | {"colour": "red"})
    assert transcode(newer, encoding=encoding_of(Tracks)).message() == expected


@pytest.mark.parametrize("rows", [0, 1, 300, 5000])
def test_tracks_of_any_number_are_transcoded(rows: int, example_of: Any) -> None:
    """An empty frame and a very large one are no exceptions; the identity of the frame is at hand."""
    tracks = example_of(Tracks)
    columns = {
        name: np.resize(getattr(tracks, name), (rows, *getattr(tracks, name).shape[1:]))
        for name, array in tracks.arrays.items()
        if array.rows == "N"
    }
    many = tracks.model_copy(update=columns)
    transcoded = transcode(encode(many), encoding=encoding_of(Tracks))
    assert transcoded.message() == convert.to_proto(many)
    known = (many.stream, many.epoch, many.seq, many.stamp_ns, many.revision, many.delivery.run)
    assert (transcoded.stream, transcoded.epoch, transcoded.seq, transcoded.stamp_ns) == known[:4]
    assert (transcoded.revision, transcoded.run) == known[4:]


def test_tracks_after_a_motion_of_the_world_are_transcoded(example_of: Any) -> None:
    """They say which motion, in both forms."""
    tracks = example_of(Tracks).model_copy(update={"relocation": example_of(Relocation)})
    transcoded = transcode(encode(tracks), encoding=encoding_of(Tracks)).message()
    assert transcoded == convert.to_proto(tracks)
    assert transcoded.relocation.world == transcoded.world == 3


def without_rows(fields: dict[str, Any]) -> None:
    fields["yaw"] = {"dtype": "f8", "shape": [0], "data": b""}


@pytest.mark.parametrize(
    ("change", "path"),
    [
        (lambda fields: fields.pop("center"), "center"),
        (lambda fields: fields["center"].update(data=b"12345678"), "center.data"),
        (lambda fields: fields["center"].update(dtype="f16"), "center.dtype"),
        (lambda fields: fields["size"].update(shape=[[]]), "size.shape"),
        (lambda fields: fields.update(seq="first"), "seq"),
        (lambda fields: fields["horizons"].update(shape=[2], data=bytes(16)), "horizons"),
        (lambda fields: fields["path_yaw"].update(shape=[3, 2]), "path_yaw"),
        (lambda fields: fields.update(covariance=7), "covariance"),
        (lambda fields: fields.update(labels=["a"] * 1000), "labels"),
        (without_rows, "yaw"),
    ],
)
def test_what_are_no_tracks_is_not_transcoded(example_of: Any, change: Any, path: str) -> None:
    """Columns that do not fit, wrong types and missing fields are named, as when they are decoded."""
    fields = msgpack.unpackb(encode(example_of(Tracks)))
    change(fields)
    with pytest.raises(MessageError) as raised:
        transcode(msgpack.packb(fields), encoding=encoding_of(Tracks))
    assert raised.value.path.startswith(path)
