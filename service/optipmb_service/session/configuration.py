"""What a session runs with: the tracker of its profile, the longest wait for a cloud, and what may be changed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from optipmb_service.session.transition import Transition
from optipmb_service.session.values import MAX_CLOUD_WAIT_NS, SECOND, RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import optipmb
    from optipmb_service.session.values import Policy, Steps


class Configuration:
    """The settings of one session.

    Args:
        stream: that of the tracks.
        policy: waiting, restarting, going back.
        tracker: makes the tracker of a profile.
        fused: whether several sensors feed the session.
    """

    def __init__(
        self, stream: str, policy: Policy, tracker: Callable[[optipmb.Parameters], Steps], *, fused: bool
    ) -> None:
        self._stream = stream
        self._make = tracker
        self._fused = fused
        self.policy = _of_several(policy) if fused else policy
        """What is in force."""
        self.cloud_wait_ns: int | None = None
        """The longest wait for a cloud, where it was set for this session; None: that of the service."""

    def transition(self, parameters: optipmb.Parameters) -> Transition:
        """Return what tracks with a profile."""
        return Transition(self._stream, parameters, self._make(parameters), self.policy)

    def wait(self, cloud_wait_ns: int) -> None:
        """Set the longest wait for a cloud."""
        self.cloud_wait_ns = cloud_wait_ns
        policy = replace(self.policy, cloud_wait_ns=cloud_wait_ns)
        self.policy = _of_several(policy) if self._fused else policy


def wait_of(cloud_wait_s: float | None) -> int | None:
    """Return the longest wait for a cloud that is asked for, ns; None: as before.

    Raises:
        RefusedError: it is too long.
    """
    if cloud_wait_s is None:
        return None
    if cloud_wait_s * SECOND > MAX_CLOUD_WAIT_NS:
        longest = f"at most {MAX_CLOUD_WAIT_NS / SECOND:g} seconds"
        raise RefusedError("cloud_wait_s", longest, f"{cloud_wait_s:g}")
    return round(cloud_wait_s * SECOND)


def profile_of(
    before: optipmb.Parameters,
    parameters: optipmb.Parameters | None,
    horizons: Sequence[float] | None,
    *,
    frames: int,
    restart: bool,
) -> tuple[optipmb.Parameters, bool]:
    """Return the profile that is asked for, and whether it tracks otherwise than the one before.

    Args:
        before: the one in force.
        parameters: the one asked for; None: as before.
        horizons: those of predicted paths; None: those of the profile that is set, else as before.
        frames: how many frames were tracked with the one in force.
        restart: whether the session may begin anew.

    Raises:
        RefusedError: it tracks otherwise, frames were tracked, and no restart was asked for.
    """
    wanted = parameters or before
    if horizons is not None:
        wanted = wanted.model_copy(update={"horizons": tuple(horizons)})
    changes = wanted.model_copy(update={"horizons": before.horizons}) != before
    if changes and not restart and frames:
        raise RefusedError(
            "profile",
            f"{before.name!r}, or restart = true: {frames} frames have been tracked with it",
            repr(wanted.name),
        )
    return wanted, changes


def _of_several(policy: Policy) -> Policy:
    """Return the policy of several sensors: a frame that waited for its cloud must still find its place."""
    return replace(policy, cloud_wait_ns=min(policy.cloud_wait_ns, policy.rewind_ns // 2))
