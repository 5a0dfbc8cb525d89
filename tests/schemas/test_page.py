"""What docs/messages.md says is what the code does."""

import json
import re
from pathlib import Path
from typing import get_args

import pytest
from optipmb_schemas import (
    CODES,
    MESSAGES,
    Detections,
    Keys,
    MessageError,
    Pose,
    Query,
    Topic,
    decode,
    encode,
    encoding_of,
)
from optipmb_schemas.export import fill, main, table

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docs" / "messages.md"
PAGE = FILE.read_text(encoding="utf-8")
DUMP = (ROOT / "schemas" / "examples" / "detections.hex").read_text(encoding="ascii")


def fenced(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def dumped(text: str) -> bytes:
    """Return the bytes of a hex dump, whose offsets must be right."""
    payload = b""
    for line in text.splitlines():
        offset, codes = line[:4], line[6:53]
        assert int(offset, 16) == len(payload)
        payload += bytes.fromhex(codes)
    return payload


def test_the_tables_are_current(capsys: pytest.CaptureFixture[str]) -> None:
    """The tables of fields and limits are current, and the command reports when they are not."""
    assert fill(PAGE) == PAGE
    assert main(["--check", "--page", str(FILE), str(ROOT / "schemas" / "json")]) == 0, capsys.readouterr().out
    assert fill("<!-- table: limits -->\nold\n<!-- end -->") == f"<!-- table: limits -->\n{table('limits')}<!-- end -->"


def test_a_stale_page_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--page` with `--check` finds a stale table, and without it brings the page up to date."""
    page, folder = tmp_path / "page.md", tmp_path / "json"
    page.write_text("<!-- table: limits -->\n<!-- end -->\n")
    assert main([str(folder)]) == 0
    assert main(["--check", "--page", str(page), str(folder)]) == 1
    assert "page.md: not up to date" in capsys.readouterr().out
    assert main(["--page", str(page), str(folder)]) == 0
    assert main(["--check", "--page", str(page), str(folder)]) == 0
    assert "max_points" in page.read_text()


def test_every_message_has_its_table() -> None:
    """No message type and no limits are missing on the page."""
    named = set(re.findall(r"<!-- table: (\w+) -->", PAGE))
    assert named >= {kind.__name__ for kind in MESSAGES} | {
        "Pose",
        "FieldOfView",
        "Delivery",
        "SessionSummary",
        "limits",
    }


def test_the_example_is_what_encode_produces() -> None:
    """The JSON example and the hex dump of `schemas/examples` are the same message, to the byte."""
    message = decode(fenced("json")[0].encode(), Detections)
    payload = dumped(DUMP)
    assert encode(message) == payload
    assert decode(payload, Detections, encoding=encoding_of(Detections)) == message
    assert f"{len(payload)} bytes, as the Python package writes it" in PAGE


def test_the_example_pose_is_valid() -> None:
    """The pose on the page can be used as it is."""
    pose = Pose(**json.loads(fenced("json")[1])["pose"])
    assert pose.translation.shape == (3,)


def test_all_keys_are_on_the_page() -> None:
    """Every key that the code makes is in the table of keys."""
    keys, stream = Keys(), "site/node/sensor"
    made = [getattr(keys, topic)(stream) for topic in get_args(Topic)]
    made += [keys.query(stream, query) for query in get_args(Query)]
    made += [keys.owner(stream, "instance"), keys.alive("instance")]
    made += [keys.status("instance"), keys.metrics("instance"), keys.move("instance"), keys.drain("instance")]
    made += [keys.links("area"), keys.links_query("area")]
    said = [re.sub(r"[<>]", "", key) for key in re.findall(r"^\| `(optipmb/v1/[^`]*)`", PAGE, re.MULTILINE)]
    assert sorted(said) == sorted(made)
    assert f"`{keys.all_queries('state')}`" in PAGE
    assert f"`{keys.all_status()}`" in PAGE


def test_encodings_on_the_page() -> None:
    """The encoding strings on the page are current."""
    said = set(re.findall(r"`(application/[^`]*)`", PAGE))
    assert said == {encoding_of(Detections), encoding_of(Detections, form="json")}


def test_codes_on_the_page_are_meant() -> None:
    """Each code of an invalid message can be met: a payload for each is refused with it."""
    example = dumped(DUMP)
    cases = [
        (example[:-1], "", "malformed"),
        (example, "application/msgpack;optipmb.Tracks.v1", "wrong_type"),
        (example, "application/msgpack;optipmb.Detections.v2", "unsupported_version"),
        (bytes(2**26), "", "too_large"),
        (b"\x80", "", "missing_field"),
        (example.replace(b"world", b"earth"), "", "invalid_value"),
    ]
    assert {code for _, _, code in cases} == set(CODES)
    for payload, encoding, code in cases:
        with pytest.raises(MessageError) as caught:
            decode(payload, Detections, encoding=encoding)
        assert caught.value.code == code
