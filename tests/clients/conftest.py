"""What several tests of the client need."""

from collections.abc import Iterator

import pytest
from routers import free_endpoint, open_router


@pytest.fixture
def endpoint() -> Iterator[str]:
    address = free_endpoint()
    with open_router(address):
        yield address
