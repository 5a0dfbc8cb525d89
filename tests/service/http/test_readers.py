"""Readers of any edge, without a network."""

import asyncio

import pytest
from optipmb_client.merging import MOST_STREAMS
from optipmb_service.edges.queues import Outbox, Pace


async def test_a_reader_is_cancelled_also_as_an_item_comes() -> None:
    """One that waits and is cancelled in the turn of the loop in which an item comes does not read on."""
    outbox: Outbox[str] = Outbox()

    async def read() -> None:
        while await outbox.take(60.0):
            pass

    reading = asyncio.create_task(read())
    await asyncio.sleep(0.0)
    outbox.put("a/b/c", "item", 4)
    await asyncio.sleep(0.0)
    await asyncio.sleep(0.0)
    reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        async with asyncio.timeout(10.0):
            await reading


def test_streams_that_are_silent_the_longest_have_no_pace() -> None:
    """A reader of all streams remembers a bounded number of them, the last that it heard."""
    pace = Pace(1.0)
    assert pace.passes("a/b/ended", 0)
    assert pace.passes("a/b/goes-on", 0)
    for number in range(MOST_STREAMS - 1):
        assert not pace.passes("a/b/goes-on", 1)
        assert pace.passes(f"a/b/{number}", 0)
    assert not pace.passes("a/b/goes-on", 1)
    assert pace.passes("a/b/ended", 1)
