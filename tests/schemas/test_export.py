"""The JSON Schemas of the messages, and the command that writes them."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from optipmb_schemas import MESSAGES, Message, encode_json, json_form
from optipmb_schemas.export import main, schema_of


def test_stale_schemas_are_reported_by_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A changed, a missing and a surplus file give one line each, nothing is written, and the status is 1."""
    assert main([str(tmp_path)]) == 0
    assert main(["--check", str(tmp_path)]) == 0
    assert capsys.readouterr().out == ""
    (tmp_path / "Detections.v1.schema.json").write_text("{}")
    (tmp_path / "Points.v1.schema.json").unlink()
    (tmp_path / "Old.v1.schema.json").write_text("{}")
    assert main(["--check", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    for name, state in (("Detections", "not up to date"), ("Points", "missing"), ("Old", "no such message")):
        assert sum(f"{name}.v1.schema.json: {state}" in line for line in lines) == 1
    assert (tmp_path / "Detections.v1.schema.json").read_text() == "{}"


def test_the_module_is_a_command(tmp_path: Path) -> None:
    """`python -m optipmb_schemas.export` works; a folder that cannot be is one line and status 2."""
    command = [sys.executable, "-m", "optipmb_schemas.export"]
    assert subprocess.run([*command, tmp_path / "new"], check=False, timeout=60).returncode == 0
    assert len(list((tmp_path / "new").iterdir())) == len(MESSAGES) + len(json_form.schemas())
    (tmp_path / "file").touch()
    failed = subprocess.run([*command, tmp_path / "file"], check=False, timeout=60, capture_output=True, text=True)
    assert failed.returncode == 2
    assert failed.stderr.startswith("error: ")
    assert failed.stderr.count("\n") == 1


def properties(schema: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    holders = [schema, *schema.get("$defs", {}).values()]
    return [item for holder in holders for item in holder["properties"].items()]


@pytest.mark.parametrize("kind", MESSAGES)
def test_every_field_is_described(kind: type[Message]) -> None:
    """Every field of every message, nested ones included, has a description."""
    schema = schema_of(kind)
    assert schema["description"]
    assert [name for name, field in properties(schema) if not field.get("description")] == []


TYPES: dict[str, Any] = {
    "integer": int,
    "number": (int, float),
    "null": type(None),
    "boolean": bool,
    "string": str,
    "array": list,
    "object": dict,
}


def fits(value: Any, schema: dict[str, Any], root: dict[str, Any]) -> bool:
    """Check a value by the keywords that our schemas use: a small JSON Schema validator."""
    schema = root["$defs"][schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema
    if "anyOf" in schema:
        return any(fits(value, part, root) for part in schema["anyOf"])
    names = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    good = any(isinstance(value, TYPES[name]) for name in names) and value in schema.get("enum", [value])
    if isinstance(value, list):
        good &= schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))
        good = good and all(fits(item, schema["items"], root) for item in value)
    elif isinstance(value, dict):
        known = schema.get("properties", {})
        good &= all(name in value for name in schema.get("required", []))
        good = good and all(fits(item, known[name], root) for name, item in value.items() if name in known)
    elif isinstance(value, int | float):
        good &= schema.get("minimum", value) <= value <= schema.get("maximum", value)
        good &= value > schema.get("exclusiveMinimum", -math.inf)
    return good


@pytest.mark.parametrize("kind", MESSAGES)
def test_messages_fit_their_schema(examples: dict[str, Message], kind: type[Message]) -> None:
    """What `encode_json` writes is what the schema describes, and a message with a field too few is not."""
    schema = schema_of(kind)
    plain = json.loads(encode_json(examples[kind.__name__]))
    assert fits(plain, schema, schema)
    for name in schema.get("required", []):
        assert not fits({key: value for key, value in plain.items() if key != name}, schema, schema)


def test_schemas_describe_the_blocks() -> None:
    """Arrays carry their number type and shape, for those who write the binary form."""
    center = schema_of(MESSAGES[0])["properties"]["center"]
    assert (center["x-dtype"], center["x-shape"]) == ("f8", ["M", 3])
    assert schema_of(MESSAGES[0])["x-encoding"] == "application/json;optipmb.Detections.v1"
