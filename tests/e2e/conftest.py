"""A real service for the tests of a module, as a process of its own."""

import signal
from collections.abc import Iterator

import pytest
from optipmb_client.child import ServiceProcess

START_S = 180.0  # the first start on a machine compiles

# What a shell starts in the background ignores it, and hands that on to what it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    """A running service with its own router."""
    with ServiceProcess() as process:
        process.wait_until_ready(START_S)
        yield process
