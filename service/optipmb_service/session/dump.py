"""What is saved of a session whose step raised."""

from __future__ import annotations

import platform
import traceback
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas

import optipmb
from optipmb_service.session.transition import begins_with

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_service.session.state import Entry, FilterState
    from optipmb_service.session.transition import Transition

MAX_TRACE: Final = 100_000


def dump_of(transition: Transition, base: FilterState, placed: Sequence[Entry], error: Exception) -> bytes:
    """Return what `optipmb track --dump` replays to the same error.

    Args:
        transition: of the session.
        base: the state before the window.
        placed: the frames of the window with the one that failed, in the order of processing.
        error: what was raised.
    """
    frames: list[schemas.DumpedFrame] = []
    state = base
    for entry in placed:
        anew = begins_with(state, entry)
        if (moved := transition.on_new_clock(state, entry)) is not None:
            base, state, anew, frames = moved, moved, False, []  # a dump has one clock
        try:
            state, outcome = transition.step(state, entry)
        except Exception:  # noqa: BLE001 - the very one
            frames.append(schemas.DumpedFrame(entry.message, entry.points, anew))
            break
        if outcome.tracks is not None:
            begun = outcome.begins is not None and outcome.begins.reason not in {"first", "clock"}
            frames.append(schemas.DumpedFrame(entry.message, entry.points, begun))
    return schemas.encode_dump(
        schemas.Dump(
            stream=transition.stream,
            error=f"{type(error).__name__}: {error}",
            trace="".join(traceback.format_exception(error))[-MAX_TRACE:],
            versions={name: version(name) for name in ("optipmb", "numpy", "numba")}
            | {"python": platform.python_version()},
            parameters=transition.parameters.model_dump(mode="json"),
            stamp_ns=base.density.stamp_ns,
            next_id=base.density.next_id,
            density=optipmb.bytes_of(base.density),
            frames=tuple(frames),
        )
    )
