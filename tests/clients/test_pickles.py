"""`result.pkl` of OpenPCDet is read without running anything, and other pickles are refused by their content."""

import contextlib
import io
import json
import os
import pickle
import resource
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optipmb_tools.files import DatasetError
from optipmb_tools.pickles import read_pickle
from optipmb_tools.table_files import read_table


def frames() -> list[dict[str, Any]]:
    """Give three frames as OpenPCDet writes them, the second without objects."""
    random = np.random.default_rng(1)
    found = []
    for k in range(3):
        boxes = random.normal(size=(0 if k == 1 else 2, 7)).astype(np.float32)
        name = np.array(["Car", "Pedestrian"]) if len(boxes) else np.zeros(0)
        score = random.uniform(size=len(boxes)).astype(np.float32)
        found.append(
            {"name": name, "score": score, "boxes_lidar": boxes, "frame_id": f"{k + 5:06d}", "time": np.float64(1.5)}
        )
    return found


@pytest.mark.parametrize("protocol", range(6))
def test_results_are_read_in_every_protocol(tmp_path: Path, protocol: int) -> None:
    """The columns equal the same frames as lines of JSON, with the numbers of the frames, also of an empty one."""
    lines = []
    for frame in frames():
        lists = {name: frame[name].tolist() for name in ("name", "score", "boxes_lidar")}
        lines.append(json.dumps({"frame": int(frame["frame_id"]), **lists}))
    (tmp_path / "r.jsonl").write_text("\n".join(lines))
    (tmp_path / "r.pkl").write_bytes(pickle.dumps(frames(), protocol))
    found, expected = (read_table(tmp_path / name) for name in ("r.pkl", "r.jsonl"))
    assert found["frame"].tolist() == [5, 5, 6, 7, 7]
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


def test_frames_without_numbers_count(tmp_path: Path) -> None:
    """Frames with names that are no numbers, and with column order, are counted by their places."""
    given = [
        frame | {"frame_id": f"a{k}", "boxes_lidar": np.asfortranarray(frame["boxes_lidar"])}
        for k, frame in enumerate(frames())
    ]
    (tmp_path / "r.pkl").write_bytes(pickle.dumps(given))
    found = read_pickle(tmp_path / "r.pkl")
    assert [one["frame"] for one in found] == [0, 1, 2]
    assert found[0]["boxes_lidar"] == frames()[0]["boxes_lidar"].tolist()


class Call:
    """An object that a pickle makes by a call."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> Any:
        return self.call


class Torch(pickle.Pickler):
    """Writes every object of this class elsewhere."""

    def persistent_id(self, obj: Any) -> Any:
        return "elsewhere" if isinstance(obj, Call) else None


def elsewhere() -> bytes:
    out = io.BytesIO()
    Torch(out).dump([Call(print, ())])
    return out.getvalue()


def large(code: bytes) -> bytes:
    return b"\x80\x05" + code + struct.pack("<Q", 10_000_000_000) + b"abc."


LARGE = (np.zeros(0).__reduce__()[0], (np.ndarray, (0,), b"b"), (1, (1_250_000_000,), np.dtype("f8"), False, b""))
"""Function, arguments and state of an array of 10 GB."""

HOSTILE = {
    "os.system": (lambda marker: pickle.dumps([Call(os.system, (f"touch {marker}",))]), "posix.system"),
    "eval": (lambda marker: pickle.dumps([Call(eval, (f"open({str(marker)!r}, 'w')",))]), "builtins.eval"),
    "exec of protocol 0": (
        lambda marker: pickle.dumps([Call(exec, (f"open({str(marker)!r}, 'w')",))], 0),
        "__builtin__.exec",
    ),
    "numpy.load": (lambda marker: pickle.dumps([Call(np.load, (str(marker),))]), "numpy.load"),
    "getattr": (lambda _: pickle.dumps([Call(getattr, (np.ndarray, "fromfile"))]), "builtins.getattr"),
    "object array": (lambda marker: pickle.dumps([np.array([Call(os.system, (f"touch {marker}",))])]), "result.pkl"),
    "numpy.ndarray": (lambda _: b"cnumpy\nndarray\n((I1000000000\nI4\nttR.", "not callable"),
    "bytearray of 10 GB": (lambda _: large(b"\x96"), "expected 10000000000 bytes"),
    "array of 10 GB": (lambda _: pickle.dumps([{"name": Call(*LARGE)}]), "cannot reshape"),
    "memo of 30 GB": (lambda _: b"\x80\x02]r\xff\xff\xff\x7f.", "a damaged pickle"),
    "torch": (lambda _: b"ctorch._utils\n_rebuild_tensor_v2\n.", "folder preds"),
    "elsewhere": (lambda _: elsewhere(), "an object elsewhere"),
    "another type": (lambda _: pickle.dumps({"a": 1}), "received dict"),
    "without boxes": (lambda _: pickle.dumps([{"name": np.zeros(1)}]), "frame 0 with score = None"),
    "deep": (lambda _: b"(" * 100_000 + b"l" * 100_000 + b".", "result.pkl"),
    "cut": (lambda _: pickle.dumps(frames())[:-40], "result.pkl"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_pickle_runs_nothing(tmp_path: Path, name: str) -> None:
    """A pickle that calls, allocates or refers to something is refused, no file is made, and no memory is taken."""
    make, text = HOSTILE[name]
    marker, path = tmp_path / "marker", tmp_path / "result.pkl"
    path.write_bytes(make(marker))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DatasetError) as caught:
        read_pickle(path)
    assert text in str(caught.value)
    assert not marker.exists()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 1024


def test_damage_anywhere_is_one_error(tmp_path: Path) -> None:
    """A changed byte anywhere gives frames, or the error of a file, never another one."""
    data, random = pickle.dumps(frames(), 2), np.random.default_rng(5)
    path = tmp_path / "result.pkl"
    for place in random.integers(0, len(data), 300).tolist():
        path.write_bytes(data[:place] + bytes([int(random.integers(0, 256))]) + data[place + 1 :])
        with contextlib.suppress(DatasetError):
            read_pickle(path)
