"""The errors of the tracker: all are `ValueError`, all name the path of the wrong field.

OptipmbError
├── FrameError       a frame's arrays have a wrong shape, dtype or value, or its stamp goes back
│   └── EffortError  a frame needs more pairs looked at than the tracker was made for
├── ParameterError   a profile cannot be found or read, or a value in it is not allowed
└── DensityError     a stored density is none: a column is missing, or has a shape, type or value that none has
"""

from __future__ import annotations


class OptipmbError(ValueError):
    """An input was refused.

    Attributes:
        path: the field, as ``center[3]`` or ``classes.Car.survival``.
        expected: what would have been accepted.
        received: the value given, shortened to be printable.
    """

    def __init__(self, path: str, expected: str, received: str) -> None:
        super().__init__(f"{path}: expected {expected}, received {received}")
        self.path = path
        self.expected = expected
        self.received = received


class FrameError(OptipmbError):
    """A frame was refused before it reached the filter."""


class EffortError(FrameError):
    """A frame was refused because a step with it would look at too many pairs."""


class ParameterError(OptipmbError):
    """A parameter profile was refused."""


class DensityError(OptipmbError):
    """A stored density was refused."""
