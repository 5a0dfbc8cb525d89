"""When a process restarts for the keys that it has declared, and when it does not."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_client.zenoh.session import KeyNumbers
from optipmb_service.app.lifecycle import StopRequest, watch_keys
from unbounded import NO_BOUND

MOST = 1000
TURNS = 20
"""Of the loop: more than it takes to look once."""


@pytest.mark.parametrize(
    ("keys", "restarts"),
    [
        (KeyNumbers(999, 0), False),
        (KeyNumbers(1000, 0), True),
        (KeyNumbers(1000, 900), True),
        (KeyNumbers(1000, 901), False),
    ],
)
async def test_a_process_restarts_where_that_gives_it_numbers(keys: KeyNumbers, *, restarts: bool) -> None:
    """When enough are used up, unless reopening would need more than nine of ten of them again."""
    asked = StopRequest(NO_BOUND)
    session: Any = SimpleNamespace(key_numbers=keys)
    watching = asyncio.create_task(watch_keys(asked, lambda: session, MOST))
    for _ in range(TURNS):
        await asyncio.sleep(0)
    assert (asked.is_set(), asked.restarts) == (restarts, restarts)
    watching.cancel()


async def test_who_wants_the_end_gets_it() -> None:
    """A process that was told to end does not restart, whichever of the two came first."""
    earlier, later = StopRequest(NO_BOUND), StopRequest(NO_BOUND)
    earlier.ask("SIGTERM")
    earlier.restart("keys_used_up")
    later.restart("keys_used_up")
    assert later.restarts
    later.ask("SIGTERM")
    assert not earlier.restarts
    assert not later.restarts
