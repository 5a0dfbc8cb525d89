"""Parameter profiles: by name, from a file, or made for the data."""

import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

from optipmb_client.errors import UsageError

from optipmb import (
    OptipmbError,
    Parameters,
    Sensors,
    class_indices,
    generic_parameters,
    load_profile,
    profile_source,
    profiles,
    warm_up,
)
from optipmb.model.parameters import ALIKE
from optipmb_tools.datasets import DataSequence
from optipmb_tools.datasets.motion import LEAST_ALONG, SURE_MOVES, headings_along

__all__ = [
    "AUTO",
    "doubts",
    "profile_compared",
    "profile_for",
    "profile_source",
    "profiles",
    "read_profile",
    "warm_up",
]

SIDE_BY_SIDE: Final = 0.5  # overlap up to which boxes of people that keep apart are of two
AUTO: Final = "auto"  # name of the profile that is made for the data: rate and classes as they come
USUAL_PERIOD: Final = 0.1
SLOWEST: Final = 4.0  # s, the longest period that such a profile is for
REPORTED_CLUTTER: Final = 0.1  # false boxes per frame where objects report themselves
FAR: Final = 1.6  # ratio of rates from which a profile does not fit
LOOKED_AT: Final = 20  # sequences that tell rate and scores
LOOKED_INTO: Final = 300  # frames of each of them
GLANCE: Final = 20  # frames that tell whether the rate fits a profile: clouds, if any, take long to read


def read_profile(profile: str) -> Parameters:
    """Return a parameter profile by name or file.

    Raises:
        UsageError: There is none, or its content is not valid.
    """
    try:
        return load_profile(profile)
    except OptipmbError as error:
        raise UsageError(f"--profile {profile}: {error}") from error


def read_sensors(settings: Path | None) -> Sensors:
    """Return what the table `sensors` of a settings file says; without a file all sensors are alike.

    Raises:
        UsageError: The file cannot be read, or a value is not allowed.
    """
    if settings is None:
        return ALIKE
    try:
        return Sensors.read(tomllib.loads(settings.read_text(encoding="utf-8")).get("sensors", {}))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, OptipmbError) as error:
        raise UsageError(f"--sensors {settings}: {error}") from error


def fields_of(tables: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, str, dict[str, float]]]:
    """Yield path, description and values by class of every field with numbers, of a profile's classes."""
    for name, field in type(next(iter(tables.values()))).model_fields.items():
        values = {label: getattr(table, name) for label, table in tables.items()}
        numbers = {label: value for label, value in values.items() if isinstance(value, (int, float))}
        inner = {label: value for label, value in values.items() if hasattr(value, "model_fields_set")}
        if numbers:
            yield path + name, field.description or "", numbers
        if inner:
            yield from fields_of(inner, f"{path}{name}.")


def profile_for(profile: str, sequences: Sequence[DataSequence]) -> Parameters:
    """Return a profile by name or file, or for `auto` one that is made for these sequences.

    Raises:
        UsageError: There is none, or its content is not valid, or it has no class of the sequences.
    """
    parameters = _made_for(sequences) if profile == AUTO else read_profile(profile)
    labels = _labels(sequences)
    if labels and (class_indices(labels, parameters.labels) < 0).all():
        raise UsageError(
            f"--profile {profile}: it has the classes {', '.join(parameters.labels)}, and the detections are of "
            f"{', '.join(labels)}: nothing would be tracked (--profile auto takes any)"
        )
    return parameters


def profile_compared(profile: str, sequences: Sequence[DataSequence]) -> Parameters:
    """Return a profile as `profile_for` does, whose classes have the names of the sequences, as their truth has them.

    Raises:
        UsageError: There is none, or its content is not valid, or it has no class of the sequences.
    """
    parameters, labels = profile_for(profile, sequences), _labels(sequences)
    places = class_indices(labels, parameters.labels).tolist()
    renamed = {parameters.labels[place]: label for label, place in zip(labels, places, strict=True) if place >= 0}
    classes = {name if name in labels else renamed.get(name, name): one for name, one in parameters.classes.items()}
    return parameters.model_copy(update={"classes": classes})


def doubts(parameters: Parameters, sequences: Sequence[DataSequence]) -> Iterator[str]:
    """Yield doubts whether a profile fits the sequences, a line each."""
    known = parameters.labels
    labels = _labels(sequences)
    found = dict(zip(labels, class_indices(labels, known).tolist(), strict=True))
    if missing := [name for name, place in found.items() if place < 0]:
        yield f"profile {parameters.name} does not track {', '.join(missing)}: left out"
    if renamed := [f"{name} as {known[place]}" for name, place in found.items() if place >= 0 and name != known[place]]:
        yield f"profile {parameters.name} tracks {', '.join(renamed)}"
    period, nominal = _period(sequences, GLANCE), parameters.nominal_period
    reported = any(one.reports is not None for one in sequences)  # each in a frame of its own
    if period is not None and not reported and not 1.0 / FAR <= period / nominal <= FAR:
        yield (
            f"frames come at {1.0 / period:.3g} Hz, profile {parameters.name} is for {1.0 / nominal:.3g} Hz: "
            "--profile auto, or a profile tuned at this rate, may track better"
        )
    share, moves = headings_along(one for one in sequences if not one.time_column)  # tables told theirs
    if share < LEAST_ALONG and moves >= SURE_MOVES:
        yield f"headings and motion disagree: {share:.0%} of {moves} moves of boxes are along their headings"


def _labels(sequences: Sequence[DataSequence]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(label for one in sequences for label in one.labels))


def _period(sequences: Sequence[DataSequence], frames: int) -> float | None:
    """Return the median time in seconds between the first `frames` frames of the first sequences."""
    steps = [
        (after.stamp_ns - before.stamp_ns) / 1e9
        for one in itertools.chain.from_iterable(one.sensors or (one,) for one in sequences[:LOOKED_AT])
        for before, after in itertools.pairwise(itertools.islice(one.frames(), frames))
    ]
    return median(steps) or None if steps else None


def _made_for(sequences: Sequence[DataSequence]) -> Parameters:
    labels, reports = _labels(sequences), [one.reports for one in sequences if one.reports is not None]
    period = median(one.period for one in reports) if reports else _period(sequences, LOOKED_INTO) or USUAL_PERIOD
    try:
        parameters = generic_parameters(labels or ("object",), min(period, SLOWEST))
    except OptipmbError as error:
        raise UsageError(f"--profile {AUTO}: {error}") from error
    for name in {name for one in sequences for name in one.apart} & parameters.classes.keys():
        side_by_side = {"nms_iou": SIDE_BY_SIDE, "sure_nms_iou": SIDE_BY_SIDE}
        parameters.classes[name] = parameters.classes[name].model_copy(update=side_by_side)
    for name, own in parameters.classes.items() if reports else ():
        # The gate grows with the time since the last frame, and not since the last report of the object.
        gate = max(own.gate, *(one.distance for one in reports))
        speed = max(own.birth.unknown_speed, 0.5 * max(one.speed for one in reports))
        birth = own.birth.model_copy(update={"unknown_speed": speed})
        own_reports = {"gate": gate, "birth": birth, "clutter_rate": REPORTED_CLUTTER}
        parameters.classes[name] = own.model_copy(update=own_reports)
    return parameters
