"""What several tests of the client need."""

import signal
from collections.abc import Iterator

import pytest
from routers import free_endpoint, open_router

# What a shell starts in the background ignores it, and hands that on to what it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def endpoint() -> Iterator[str]:
    """The endpoint of a router without any service."""
    address = free_endpoint()
    with open_router(address):
        yield address
