"""Names that detectors and datasets give to the same kinds of objects.

`Car`, `car`, `vehicle.car` and `CAR` are one kind; so are `Cyclist`, `bicycle` and `vehicle.bicycle`.
"""

import re
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

KINDS: Final[tuple[tuple[str, tuple[str, ...]], ...]] = (
    ("car", ("car", "van", "suv", "vehicle", "auto", "automobile", "taxi", "sedan", "passenger_car", "police",
            "regular_vehicle", "pickup", "type_vehicle")),
    ("truck", ("truck", "lorry", "construction", "construction_vehicle", "large_vehicle", "box_truck", "emergency",
              "fire_truck", "ambulance")),
    ("bus", ("bus", "coach", "bendy", "rigid", "articulated_bus", "school_bus", "tram", "train")),
    ("trailer", ("trailer", "truck_trailer", "semitrailer", "vehicular_trailer")),
    ("pedestrian", ("pedestrian", "person", "people", "human", "adult", "child", "walker", "worker",
                   "person_sitting", "construction_worker", "police_officer", "type_pedestrian")),
    ("bicycle", ("bicycle", "cyclist", "bike", "bicyclist", "cycle", "rider", "type_cyclist", "wheeled_rider")),
    ("motorcycle", ("motorcycle", "motorbike", "motorcyclist", "scooter", "moped")),
)  # fmt: skip
"""The kinds of objects that a profile for unknown detectors knows, with the words for them."""

_KIND: Final = {word: kind for kind, words in KINDS for word in words}


def common_name(name: str) -> str | None:
    """Return the kind of object that a class name means; None for names that are not known.

    The whole name counts first, then its parts from the last to the first: `vehicle.bus.rigid` is a bus,
    `human.pedestrian.adult` a pedestrian.
    """
    text = re.sub(r"[^a-z0-9.]+", "_", re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower()).strip("_")
    for part in (text, *reversed(text.split("."))):
        for word in (part, part.removesuffix("s")):
            if word in _KIND:
                return _KIND[word]
    return None


def like(name: str, names: tuple[str, ...]) -> str | None:
    """Return the one of `names` that means the same as `name`, at best itself; None where there is none, or several."""
    if name in names:
        return name
    kind = common_name(name)
    fitting = [one for one in names if one.lower() == name.lower()] or [
        one for one in names if kind is not None and common_name(one) == kind
    ]
    return fitting[0] if len(fitting) == 1 else None


@lru_cache(maxsize=64)  # lists of classes, of which a detector has one or a few
def class_indices(labels: tuple[str, ...], names: tuple[str, ...]) -> NDArray[np.int64]:
    """Return where in `names` each label has the name that means the same, -1 for none; for looking up only."""
    found = np.array([names.index(known) if (known := like(label, names)) else -1 for label in labels], dtype=np.int64)
    found.setflags(write=False)
    return found
