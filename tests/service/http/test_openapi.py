"""The OpenAPI document: what a service serves, takes and answers is in it.

openapi-spec-validator 0.9.0 finds it valid.
"""

import json
import re
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

import jsonschema
import pytest
from json_senders import Edge, document
from optipmb_schemas import openapi
from router import Sensor
from watched import asked

DOCUMENT: dict[str, Any] = json.loads(openapi.document())
SENSOR = Sensor()
STREAM = f"stream={SENSOR.stream}"


@pytest.fixture
def edge(start: Any) -> Iterator[Edge]:
    with Edge(start()[1]) as one:
        yield one


def check(answer: Any, path: str, method: str, status: int) -> None:
    """Raise ValidationError unless an answer is of the form that the document has for it."""
    content = DOCUMENT["paths"][path][method]["responses"][str(status)]["content"]
    schema = content["application/json"].get("schema", {})
    jsonschema.validate(answer, {**schema, "components": DOCUMENT["components"]}, jsonschema.Draft202012Validator)


def test_references_and_schemas_are_valid() -> None:
    """Every reference leads somewhere, every schema is one, and every operation has a name of its own."""
    text = json.dumps(DOCUMENT)
    for name in re.findall(r'"#/components/schemas/(\w+)"', text):
        assert name in DOCUMENT["components"]["schemas"], name
    for schema in DOCUMENT["components"]["schemas"].values():
        jsonschema.Draft202012Validator.check_schema(schema)
    operations = [one for path in DOCUMENT["paths"].values() for one in path.values()]
    assert len({one["operationId"] for one in operations}) == len(operations) == len(openapi.PATHS)


def test_the_paths_are_those_of_the_service(edge: Edge) -> None:
    """With their methods: no path is left out but those of the page. A service serves the document."""
    with asked(edge.address, "/nowhere") as response:
        there = json.loads(response.read())["error"]["paths"]
    page = {"/", "/look.js", "/look.css", "/live", "/api/v1/detections/"}
    assert {path: methods[0].lower() for path, methods in there.items() if path not in page} == {
        path: one.method for path, one in openapi.PATHS.items()
    }
    with asked(edge.address, "/openapi.json") as response:
        assert json.loads(response.read())["paths"] == DOCUMENT["paths"]


@pytest.mark.parametrize("path", [path for path, one in openapi.PATHS.items() if one.parameters])
def test_the_parameters_are_those_of_the_service(edge: Edge, path: str) -> None:
    """A further one is refused, and the refusal names them."""
    method = openapi.PATHS[path].method.upper()
    query = f"?{STREAM}&wait=1&further=1" if method == "POST" else f"?{STREAM}&further=1"
    with asked(edge.address, path + query, method) as response:
        error = json.loads(response.read())
        assert response.status == HTTPStatus.BAD_REQUEST
    check(error, path, method.lower(), response.status)
    named = re.findall(r"expected one of (.*), received", error["error"]["message"])[0].split(", ")
    assert sorted(named) == sorted(openapi.PATHS[path].parameters)


def test_answers_have_the_forms_of_the_document(edge: Edge) -> None:
    """Of frames that are taken and refused, of tracks, streams and the status."""
    frame = document(SENSOR.detections(0))
    jsonschema.validate(
        frame, {**DOCUMENT["components"]["schemas"]["EdgeDetections"], "components": DOCUMENT["components"]}
    )
    bodies = [(frame, f"{STREAM}&wait=5"), ([frame, {}], STREAM), ({"objects": [{}]}, STREAM), (frame, "")]
    for body, query in bodies:
        answer = edge.post(body, query)
        check(answer.body, "/api/v1/detections", "post", answer.status)
    for path in ("/api/v1/tracks", "/api/v1/streams", "/api/v1/zones"):
        with asked(edge.address, f"{path}?{STREAM}") as response:
            found = json.loads(response.read())
            check(found, path, "get", response.status)
            assert found or path.endswith("zones")
