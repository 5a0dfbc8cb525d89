"""The highest rate that holds a latency: doubled until it does not hold, then halved in between."""

from collections.abc import Callable

from optipmb_client.load.run import Run

CLOSE = 1.05  # the search ends when the rates that hold and that do not differ by less than this factor

LEAST_HZ = 0.1
MOST_HZ = 10_000.0


def find_limit(measure: Callable[[float], Run], rate: float, latency_ms: float) -> tuple[float, list[Run]]:
    """Return the highest rate (Hz) found that holds, 0 when none does, and all runs in their order.

    Args:
        measure: runs a load at a rate per stream.
        rate: where the search begins.
        latency_ms: what 99 of 100 frames must not exceed, with nothing lost.
    """
    runs: list[Run] = []

    def holds(at: float) -> bool:
        runs.append(measure(at))
        return runs[-1].holds(latency_ms)

    good, bad = 0.0, 0.0
    while LEAST_HZ <= rate <= MOST_HZ and not (good and bad):
        if holds(rate):
            good, rate = rate, 2 * rate
        else:
            bad, rate = rate, rate / 2
    while good and bad and bad / good > CLOSE:
        middle = (good * bad) ** 0.5
        if holds(middle):
            good = middle
        else:
            bad = middle
    return good, runs
