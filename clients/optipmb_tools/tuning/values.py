"""Single values of a class in a profile, by their path, such as `process_noise.speed`; and profiles as text.

Numbers that tuning chooses have few digits, so that a profile can be read, and so that writing it and reading it again
gives the same parameters.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from optipmb_client.errors import UsageError
from pydantic import BaseModel

from optipmb import Calibration, HeadingSign, OptipmbError, Parameters, ScoreCalibration, parse_parameters
from optipmb_tools.files import write_whole

DIGITS = 3
Value = float | int | bool


def rounded(value: float) -> float:
    """Return a number with the few digits that profiles have."""
    return float(f"{value:.{DIGITS}g}")


def value_of(parameters: Parameters, name: str, path: str) -> Value:
    found: Any = parameters.classes[name]
    for part in path.split("."):
        found = getattr(found, part)
    value: Value = found
    return value


def with_values(parameters: Parameters, name: str, values: Mapping[str, Value | str]) -> Parameters:
    """Return the parameters with other values of one class; text is read as the parameter has it.

    Raises:
        UsageError: there is no such parameter, or a value is not allowed.
    """
    document = parameters.model_dump()
    for path, value in values.items():
        *parents, last = path.split(".")
        table = document["classes"][name]
        for part in parents:
            table = table.get(part) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            raise UsageError(f"{path}: class {name} of profile {parameters.name} has no table {'.'.join(parents)}")
        if isinstance(table.get(last), dict):
            raise UsageError(f"{path}: expected one value of this table, such as {path}.{next(iter(table[last]))}")
        table[last] = value
    return _parsed(document)


def _with_tables(parameters: Parameters, columns: Mapping[str, Mapping[str, BaseModel | None]]) -> Parameters:
    """Return the parameters with other tables of some classes, such as a `calibration`; None removes one."""
    document = parameters.model_dump()
    for name, tables in columns.items():
        document["classes"][name] |= {key: table.model_dump() if table else None for key, table in tables.items()}
    return _parsed(document)


def with_calibration(parameters: Parameters, name: str, calibration: Calibration | None) -> Parameters:
    """Return the parameters with another calibration of one class."""
    return _with_tables(parameters, {name: {"calibration": calibration}})


def with_score_calibration(parameters: Parameters, curves: Mapping[str, ScoreCalibration | None]) -> Parameters:
    """Return the parameters with other score calibrations of some classes."""
    return _with_tables(parameters, {name: {"score_calibration": curve} for name, curve in curves.items()})


def with_heading_sign(parameters: Parameters, name: str) -> Parameters:
    """Return the parameters with the usual `heading_sign` of a class that has none."""
    return _with_tables(parameters, {name: {"heading_sign": parameters.classes[name].heading_sign or HeadingSign()}})


def only(parameters: Parameters, name: str) -> Parameters:
    document = parameters.model_dump()
    return _parsed({**document, "classes": {name: document["classes"][name]}})


def with_classes(parameters: Parameters, tables: Mapping[str, Parameters], name: str, provenance: str) -> Parameters:
    """Return the parameters with the tables of some classes taken from others, under a new name."""
    document = parameters.model_dump()
    for label, other in tables.items():
        document["classes"][label] = other.model_dump()["classes"][label]
    return _parsed({**document, "name": name, "provenance": provenance})


def _parsed(document: dict[str, Any]) -> Parameters:
    try:
        return parse_parameters(document)
    except OptipmbError as error:
        raise UsageError(str(error)) from error


def profile_text(parameters: Parameters) -> str:
    """Return a profile as TOML; reading it gives the same parameters."""
    document = parameters.model_dump()
    classes = document.pop("classes")
    lines = [f"{key} = {_toml(value)}" for key, value in document.items()]
    for name, table in classes.items():
        lines += ["", f"[classes.{name if name.isidentifier() else _toml(name)}]"]
        lines += [f"{key} = {_toml(value)}" for key, value in table.items() if value is not None]
    return "\n".join(lines) + "\n"


def write_profile(path: Path, parameters: Parameters) -> None:
    """Write a profile; the file appears complete or not at all."""
    write_whole(path, [profile_text(parameters)])


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        if "\n" in value:
            return '"""\n' + "\n".join(_escaped(line) for line in value.split("\n")) + '"""'
        return f'"{_escaped(value)}"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items() if item is not None) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return repr(value)


def _escaped(text: str) -> str:
    # TOML has the escapes of JSON, and needs one for DEL.
    return json.dumps(text, ensure_ascii=False)[1:-1].replace("\x7f", "\\u007F")
