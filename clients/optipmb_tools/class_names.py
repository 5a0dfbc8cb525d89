"""Class names of detectors, results and benchmarks, matched without case and by common names."""

from collections.abc import Sequence


def class_like(name: str, names: Sequence[str]) -> str | None:
    """Return the one of `names` that means the same class, as profiles match them; None for none or several.

    `Car`, `car` and `vehicle.car` are one class. An equal name comes first, then one that differs in case only.
    """
    if name in names:
        return name
    from optipmb.class_names import like  # noqa: PLC0415  loads the tracker, which equal names do not need

    return like(name, tuple(names))
