"""Profiles: shipped ones, own files, and the refusal of values that are not allowed."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel
from scenes import random_parameters

import optipmb
from optipmb.model.parameters import BirthSpread, ClassParameters, MeasurementNoise, ProcessNoise

if TYPE_CHECKING:
    from pathlib import Path

TABLES: list[type[BaseModel]] = [optipmb.Parameters, ClassParameters, ProcessNoise, MeasurementNoise, BirthSpread]
PAPER: dict[str, dict[str, list[float]]] = {  # the paper's table of parameters, per column
    "nuscenes-paper": {
        "score_filter": [0.15, 0, 0.1, 0.16, 0.2, 0.1, 0], "nms_iou": [0.1] * 7, "survival": [0.99] * 7,
        "gate": [3, 10, 10, 4, 3, 10, 10], "detection": [0.8, 0.9, 0.9, 0.8, 0.8, 0.9, 0.9],
        "expected_points": [10] * 7, "detection_floor": [0.5] * 7,
        "birth_score": [0.17, 0.3, 0.25, 0.18, 0.2, 0.15, 0.15], "adaptive_birth_rate": [2] * 7,
        "undetected_birth_rate": [1, 5, 2, 1, 1, 2, 2], "clutter_rate": [0.5, 0.2, 1, 0.5, 0.5, 0.5, 1],
        "poisson_steps": [3, 3, 3, 2, 2, 2, 2], "extract_new": [0.7, 0.7, 0.7, 0.7, 0.7, 0.7, 0.5],
        "extract_known": [0.95, 0.7, 0.8, 0.95, 0.8, 0.8, 0.9], "extract_misses": [3, 2, 2, 2, 2, 2, 2],
    },
    "kitti-paper": {
        "score_filter": [0.3], "nms_iou": [0.1], "survival": [1], "gate": [4], "detection": [0.9],
        "expected_points": [10], "detection_floor": [0.7], "birth_score": [0.65], "adaptive_birth_rate": [0.2],
        "undetected_birth_rate": [0.5], "clutter_rate": [10], "poisson_steps": [1], "extract_new": [0.85],
        "extract_known": [0.9], "extract_misses": [5],
    },
}  # fmt: skip
CLASSES = {
    "nuscenes-paper": ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck"),
    "kitti-paper": ("Car", "Pedestrian", "Cyclist"),
}


def refused(document: dict[str, Any]) -> optipmb.ParameterError:
    """The error that a document is refused with."""
    with pytest.raises(optipmb.ParameterError) as caught:
        optipmb.parse_parameters(document)
    return caught.value


def document_with(path: str, value: Any) -> dict[str, Any]:
    """A valid document with one value replaced, or a field added."""
    document = copy.deepcopy(random_parameters(0))
    *parents, last = path.split(".")
    table: Any = document
    for part in parents:
        table = table[part]
    table[last] = value
    return document


def toml(document: dict[str, Any]) -> str:
    """The document as TOML, one inline table per class."""

    def inline(value: Any) -> str:
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{key} = {inline(item)}" for key, item in value.items() if item is not None) + " }"
        if isinstance(value, str):
            return f'"{value}"'
        if isinstance(value, bool):
            return str(value).lower()
        return repr(int(value) if isinstance(value, int) else float(value))

    return "\n".join(f"{key} = {inline(value)}" for key, value in document.items())


def test_the_profiles_that_ship_are_listed_and_load() -> None:
    """Every listed profile loads under its name, with its origin."""
    assert set(optipmb.profiles()) == {
        "generic",
        "kitti",
        "kitti-paper",
        "kitti-second-iou",
        "kitti-virconv",
        "nuscenes",
        "nuscenes-megvii",
        "nuscenes-paper",
        "scene",
    }
    for name in optipmb.profiles():
        parameters = optipmb.load_profile(name)
        assert parameters.name == name
        assert parameters.provenance


def test_the_default_of_the_service_is_the_one_for_any_detector() -> None:
    """`generic` is what `auto` makes of its classes at 10 Hz."""
    generic = optipmb.load_profile("generic")
    assert generic == optipmb.generic_parameters(generic.labels, 0.1, name="generic")


@pytest.mark.parametrize("period", [0.02, 0.1, 0.25, 1.0])
def test_misses_of_a_generic_profile_last_as_long_at_any_rate(period: float) -> None:
    """A track that is not detected is shown for 0.3 s, within a tenth of a frame, and for one frame at least."""
    misses = optipmb.generic_parameters(("car",), period).classes["car"].extract_misses - 1
    assert 0.3 - 0.1 * period <= misses * period < 0.3 + period


@pytest.mark.parametrize("profile", PAPER)
def test_the_profiles_hold_the_papers_table(profile: str) -> None:
    """Every value that the paper's table of parameters gives stands in the profile."""
    parameters = optipmb.load_profile(profile)
    assert parameters.labels == CLASSES[profile]
    for field, values in PAPER[profile].items():
        for label, value in zip(parameters.labels, values, strict=False):
            assert getattr(parameters.classes[label], field) == value, f"{profile} {label} {field}"
    assert parameters.nominal_period == {"kitti-paper": 0.1, "nuscenes-paper": 0.5}[profile]


@pytest.mark.parametrize("profile", PAPER)
def test_the_tuned_profiles_track_the_same_classes(profile: str) -> None:
    """A tuned profile stands in for the paper's: the same classes in the same order, the same period."""
    paper, tuned = optipmb.load_profile(profile), optipmb.load_profile(profile.removesuffix("-paper"))
    assert tuned.labels == paper.labels
    assert tuned.nominal_period == paper.nominal_period


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_every_parameter_is_documented(table: type[BaseModel]) -> None:
    """Each field has a description, each class a docstring."""
    assert table.__doc__
    for name, field in table.model_fields.items():
        assert field.description, name
        described = isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        assert described or len(field.description) >= 5, name


def test_a_file_of_ones_own_loads(tmp_path: Path) -> None:
    """A TOML file anywhere is a profile, by its path as text or as Path."""
    document = random_parameters(4, ("tram", "horse"))
    file = tmp_path / "own.toml"
    file.write_text(toml(document), encoding="utf-8")
    loaded = optipmb.load_profile(file)
    assert loaded == optipmb.parse_parameters(document)
    assert loaded == optipmb.load_profile(str(file))
    assert loaded.labels == ("tram", "horse")
    result = optipmb.Tracker(loaded).initial()
    assert result.next_id == 1


def test_parameters_survive_their_dump() -> None:
    """`model_dump` gives a document that parses to the same parameters."""
    parameters = optipmb.load_profile("nuscenes")
    assert optipmb.parse_parameters(parameters.model_dump()) == parameters


def test_parameters_cannot_be_changed() -> None:
    """A profile in use is frozen."""
    parameters = optipmb.load_profile("kitti")
    with pytest.raises(ValueError, match="frozen"):
        parameters.nominal_period = 1.0


@pytest.mark.parametrize("content", [None, "name = ", b"\xff\xfe", "[classes]"])
def test_what_is_no_profile_is_refused(tmp_path: Path, content: str | bytes | None) -> None:
    """A missing file, broken TOML, no text, and a file without a required value."""
    file = tmp_path / "bad.toml"
    if content is not None:
        file.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(optipmb.ParameterError) as caught:
        optipmb.load_profile(file)
    assert "\n" not in str(caught.value)


def test_a_profile_that_does_not_exist_names_those_that_do() -> None:
    """A typing mistake is answered with the choices."""
    with pytest.raises(optipmb.ParameterError, match=r"kitti.*nuscenes") as caught:
        optipmb.load_profile("kity")
    assert caught.value.path == "profile"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, "fast", None, [1.0]])
@pytest.mark.parametrize(
    "path", ["nominal_period", "classes.Car.gate", "classes.Car.process_noise.turn_rate", "classes.Cyclist.detection"]
)
def test_a_bad_value_is_refused_by_its_path(path: str, value: Any) -> None:
    """ParameterError names the field from the top of the document."""
    assert refused(document_with(path, value)).path == path


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("classes.Car.survival", 1.01),
        ("classes.Car.survival", 0.0),
        ("classes.Car.detection", 1.0),
        ("classes.Car.detection", 0.0),
        ("classes.Car.detection_floor", 0.0),
        ("classes.Car.min_existence", 0.0),
        ("classes.Car.expected_points", 0.0),
        ("classes.Car.clutter_rate", 0.0),
        ("classes.Car.area", 0.0),
        ("classes.Car.poisson_steps", -1),
        ("classes.Car.poisson_steps", 1.5),
        ("classes.Car.max_misses", -1),
        ("classes.Car.max_misses", 2**63),
        ("classes.Car.poisson_steps", 2**63),
        ("classes.Car.extract_misses", 2**63),
        ("classes.Car.nms_iou", 1.1),
        ("classes.Car.measurement_noise.position", 0.0),
        ("classes", {}),
        ("name", ""),
        ("nominal_period", 0.0),
    ],
)
def test_values_with_which_the_filter_cannot_compute_are_refused(path: str, value: Any) -> None:
    """Bounds are checked where the profile is read, not in the filter."""
    assert refused(document_with(path, value)).path == path


@pytest.mark.parametrize("name", ["", "x" * 65, "Car\n"])
def test_a_class_is_named_so_that_messages_can_say_it(name: str) -> None:
    """One to 64 printable characters, as labels have; the error says which name it was."""
    document = random_parameters(0)
    document["classes"][name] = document["classes"].pop("Car")
    error = refused(document)
    assert error.path.startswith("classes")
    assert repr(name)[:60] in error.received


@pytest.mark.parametrize("path", ["gates", "classes.Car.gates", "classes.Car.birth.gates"])
def test_an_unknown_field_is_refused(path: str) -> None:
    """A misspelt parameter is not silently ignored."""
    assert refused(document_with(path, 1.0)).path == path


@pytest.mark.parametrize("path", ["nominal_period", "classes.Car.gate", "classes.Car.birth.heading"])
def test_a_missing_field_is_refused(path: str) -> None:
    """Every value without a documented default has to be given."""
    document = copy.deepcopy(random_parameters(0))
    *parents, last = path.split(".")
    table: Any = document
    for part in parents:
        table = table[part]
    del table[last]
    assert refused(document).path == path


def test_the_thresholds_of_extraction_are_ordered() -> None:
    """eta_ext1 <= eta_ext2, as the paper demands."""
    document = random_parameters(0)
    document["classes"]["Car"] |= {"extract_new": 0.9, "extract_known": 0.8}
    error = refused(document)
    assert error.path == "classes.Car"
    assert "extract_new" in str(error)


@given(
    st.recursive(st.none() | st.booleans() | st.floats() | st.text(), lambda inner: st.dictionaries(st.text(), inner))
)
@settings(deadline=None, max_examples=30)  # documents of random texts are slow to make
def test_any_document_is_refused_by_name(document: Any) -> None:
    """Any document is accepted or raises ParameterError."""
    error = refused(document)
    assert str(error).startswith(error.path)
