"""Parameters without tuning, for any detector: careful values from the classes and the rate.

Counts of frames follow from durations and the period. The noise fits an average LiDAR detector and is rather too wide.
The tracker calibrates scores itself (`optipmb.learning.self_calibration`): thresholds and the curve of existence hold
for any detector.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from optipmb.model.class_names import common_name
from optipmb.model.parameters import parse_parameters

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optipmb.model.parameters import Parameters

OTHER: Final = "other"
REACH: Final = (  # the gate, m, and the standard deviation of an unknown speed, m/s, of which it holds GATE_DEVIATIONS
    ("car", (3.0, 12.0)), ("truck", (4.0, 12.0)), ("bus", (4.0, 12.0)), ("trailer", (4.0, 12.0)),
    ("pedestrian", (1.8, 2.0)), ("bicycle", (2.5, 5.0)), ("motorcycle", (2.5, 12.0)), (OTHER, (2.5, 10.0)),
)  # fmt: skip
GATE_DEVIATIONS: Final = 2.75
VELOCITY_DEVIATIONS: Final = 2.45  # holds 95 % of the velocities of sound detections

REMEMBERED_S, REMEMBERED_OTHER_S = 2.0, 4.0
"""How long a road user, and another object, is kept without a detection."""
OF_LENGTH: Final = 0.1
"""Error of the centre of another object, which may be a ship, as a share of its length: a part of it is hit."""
DETECTION_S: Final = 0.5
"""Time that the detection probability holds for: what hides an object hides it about so long."""
SHOWN_S: Final = 0.3
"""How long a track is shown without a detection: in whole frames, rounded up."""
EVIDENCE: Final = tuple(round(-3.0 + 0.5 * k, 1) for k in range(13))
EXISTENCE: Final = tuple(
    tuple(round(min(max(1.0 / (1.0 + math.exp(-a - b * e)), 0.002), 0.998), 3) for e in EVIDENCE)
    for a, b in ((-0.56, 1.82), (-1.9, 3.4))
)
"""Share of tracks that are objects, by evidence: of vehicles, and of pedestrians, of whom detectors imagine more."""
DOUBT: Final = ((0.5, 0.6, 0.8, 0.9, 0.95, 0.98), (3.2, 2.75, 2.4, 2.1, 1.8, 1.0))
"""Lasting errors relative to those of sure tracks, by existence: boxes of far and half-hidden objects, which have low
scores, are off."""
WALKERS: Final = ((0.2, 0.5), (0.5, 0.8))
"""Process noise of the speed of people by the period: within a fifth of a second they go on as they went."""
HISTORY: Final = (
    {"offset": -0.25, "existence": 0.85, "duration": 0.4, "share": 0.85, "speed": 0.0},
    {"offset": -1.0, "existence": 0.45, "duration": 0.45, "share": 0.5, "speed": 1.2},
)
"""How whole tracks count: of cars, and of people and cyclists, who move where they are not clutter. Boxes of trucks and
buses that last are often parts of something else."""


def generic_parameters(labels: Iterable[str], period: float, *, name: str = "auto") -> Parameters:
    """Return parameters for classes, by what their names mean (`optipmb.model.class_names`).

    Args:
        labels: names of the classes; what their names do not tell is taken for objects of middling size and speed.
        period: seconds between frames.
        name: of the profile.

    Raises:
        ParameterError: no label, a name that is none, or a period that is not positive.
    """
    classes = {label: _of_class(common_name(label) or OTHER, period) for label in labels}
    kinds = ", ".join(f"{label} as {common_name(label) or OTHER}" for label in classes)
    provenance = f"For a detector that nobody tuned: {1.0 / period if period > 0.0 else 0.0:.3g} Hz; {kinds}."
    return parse_parameters(
        {
            "name": name,
            "nominal_period": period,
            "detection_time": DETECTION_S,
            "self_calibration": True,
            "sensor_motion": True,
            "provenance": provenance[:10_000],
            "classes": classes,
        }
    )


def _of_class(kind: str, period: float) -> dict[str, Any]:
    gate, unknown_speed = dict(REACH)[kind]
    agile, two_wheeled, sized = kind == "pedestrian", kind.endswith("cycle"), kind in {"truck", "bus", "trailer"}
    remembered = REMEMBERED_OTHER_S if kind == OTHER else REMEMBERED_S
    return {
        **({"group": "vehicle", "suppress_in_group": False} if kind in {"car", "truck"} else {}),
        "score_filter": 0.05,
        "announce_score": 0.15,
        "birth_score": 0.4 if agile else 0.5,
        "nms_iou": 0.05,
        **({"sure_nms_iou": 0.15} if agile else {}),
        "survival": 1.0,
        "gate": gate,
        "gate_deviations": GATE_DEVIATIONS,
        "velocity_gate": VELOCITY_DEVIATIONS,
        "detection": 0.8,
        "expected_points": 10.0,
        "detection_floor": 0.6,
        "adaptive_birth_rate": 0.2,
        "undetected_birth_rate": 0.5,
        "clutter_rate": 4.0,
        "area": 10_000.0,
        "poisson_steps": 2,
        "extract_new": 0.7,
        "extract_known": 0.8,
        "extract_misses": 1 + max(1, math.ceil(SHOWN_S / period - 0.1)),
        "max_misses": max(4, round(remembered / period)),
        "min_existence": 1e-4,  # objects are kept for their time, not for their misses
        "heading_sign": {"speed": 1.0 if agile or two_wheeled else 4.0},  # vehicles reverse at up to 4 m/s
        "birth_heading_speed": 1.0,
        "birth_over_clutter": True,  # a wide gate holds components that are of other objects
        "crowded": True,
        "birth_overlap": 0.1,
        "motion": "cv" if agile else "ctra",
        "acceleration_time": None if agile else 1.0 if two_wheeled else 3.0,
        "confirm_from": 0.65,
        "confirm_until": 0.55,
        "calibration": {
            "memory": round(0.8 ** (10.0 * period), 4),  # 0.8 over a tenth of a second
            "missed": 1.0,
            "evidence": EVIDENCE,
            "existence": EXISTENCE[agile],
            "along": _lasting(0.11, EXISTENCE[agile]),
            "across": _lasting(0.07, EXISTENCE[agile]),
            "speed": 0.3 if agile else 0.5,
            "turn_rate": 0.5 if agile else 0.4,
            "history": None if sized else HISTORY[agile or two_wheeled],
        },
        "reported_noise": {"position": 0.04, "heading": 0.3} if agile else {"position": 0.06, "heading": 0.06},
        "process_noise": {
            "position": 0.1,
            "speed": round(float(np.interp(period, *WALKERS)), 3) if agile else 1.0,
            "heading": 0.3 if agile else 0.2 if two_wheeled else 0.08,
            "turn_rate": 0.4 if agile or two_wheeled else 0.15,
            "acceleration": 0.5 if agile else 1.5,
        },
        "measurement_noise": {
            "position": 0.5 if sized else 0.25 if agile or two_wheeled else 0.3,
            "length": OF_LENGTH if kind == OTHER else 0.0,
            "velocity": 1.0,
            "heading": 0.6 if agile else 0.3,
        },
        "birth": {
            "position": 0.5,
            "speed": 1.0 if agile else 3.0,
            "unknown_speed": unknown_speed,
            "heading": 0.8 if agile else 0.4,
            "turn_rate": 0.3,
            "acceleration": 0.5 if agile else 1.0,
        },
    }


def _lasting(sure: float, existence: Iterable[float]) -> list[float]:
    """Return the lasting errors of tracks by their existence, m, from that of sure ones."""
    return [round(sure * float(np.interp(one, *DOUBT)), 3) for one in existence]
