"""The AsyncAPI document: every key and message is in it, every reference leads somewhere, and messages fit it.

@asyncapi/parser 3.6.6 finds it valid.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from optipmb_schemas import MESSAGES, Message, encode_json, encoding_of
from optipmb_schemas.asyncapi import document
from optipmb_schemas.export import main

ROOT = Path(__file__).parents[2]
DOCUMENT: dict[str, Any] = json.loads(document())


def references(part: Any) -> Iterator[str]:
    if isinstance(part, dict):
        yield from ([part["$ref"]] if "$ref" in part else [])
    for one in part.values() if isinstance(part, dict) else part if isinstance(part, list) else ():
        yield from references(one)


def resolved(reference: str) -> Any:
    found: Any = DOCUMENT
    for name in reference.removeprefix("#/").split("/"):
        found = found[name]
    return resolved(found["$ref"]) if isinstance(found, dict) and "$ref" in found else found


def test_the_document_is_current(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--check` finds the file of the repository equal, and a changed or missing one not."""
    assert main(["--check", "--asyncapi", str(ROOT / "schemas" / "asyncapi.json")]) == 0
    file = tmp_path / "asyncapi.json"
    assert main(["--check", "--asyncapi", str(file)]) == 1
    assert main(["--asyncapi", str(file)]) == 0
    assert json.loads(file.read_text()) == DOCUMENT
    file.write_text("{}")
    assert main(["--check", "--asyncapi", str(file)]) == 1
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_channels_are_the_table_of_keys() -> None:
    """Each row of docs/messages.md is a channel, with its parameters, and no other is one."""
    page = (ROOT / "docs" / "messages.md").read_text()
    keys = re.findall(r"^\| `(optipmb/v1/[^`]*)` \|", page.split("## Keys")[1].split("## Encodings")[0], re.MULTILINE)
    servers = {name: channel["servers"][0]["$ref"] for name, channel in DOCUMENT["channels"].items()}
    addresses = [DOCUMENT["channels"][name]["address"] for name, at in servers.items() if at == "#/servers/router"]
    assert sorted(addresses) == sorted(re.sub(r"<(\w+)>", r"{\1}", key) for key in keys)
    for channel in DOCUMENT["channels"].values():
        assert set(channel["parameters"]) == set(re.findall(r"{(\w+)}", channel["address"]))


def test_every_message_is_sent_in_both_forms() -> None:
    """By an operation, with its content type; every reference resolves; a query is answered on its channel."""
    sent = set()
    for operation in DOCUMENT["operations"].values():
        parts = [operation, *([operation["reply"]] if "reply" in operation else [])]
        sent |= {resolved(one["$ref"]).get("contentType") for part in parts for one in part["messages"]}
        assert all(one["$ref"].startswith(operation["channel"]["$ref"]) for part in parts for one in part["messages"])
    assert {encoding_of(kind, form=form) for kind in MESSAGES for form in ("msgpack", "json")} <= sent
    assert len([resolved(reference) for reference in references(DOCUMENT)]) > 100


@pytest.mark.parametrize("kind", MESSAGES)
def test_messages_fit_the_schemas_of_the_document(examples: dict[str, Message], kind: type[Message]) -> None:
    """By the draft that AsyncAPI has (7); one without a required field does not."""
    schema = {"$ref": f"#/components/schemas/{kind.__name__}", "components": DOCUMENT["components"]}
    validator = jsonschema.Draft7Validator(schema)
    plain = json.loads(encode_json(examples[kind.__name__]))
    validator.validate(plain)
    for name in DOCUMENT["components"]["schemas"][kind.__name__].get("required", []):
        assert not validator.is_valid({key: value for key, value in plain.items() if key != name})


def test_prefix_and_endpoint_are_those_in_force() -> None:
    """As a service with other settings serves it."""
    other = json.loads(document("site/node/sensor", "tls/tracker.example:7447", "tracker.example:80"))
    assert other["channels"]["tracks"]["address"] == "site/node/sensor/{site}/{node}/{sensor}/tracks"
    assert other["servers"]["router"] == {"host": "tracker.example:7447", "protocol": "zenoh"}
    assert other["servers"]["http"] == {"host": "tracker.example:80", "protocol": "ws"}
