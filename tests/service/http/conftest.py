"""A service as the HTTP server sees it."""

import pytest
from watched import Session, Watched


@pytest.fixture
def watched() -> Watched:
    return Watched()


@pytest.fixture
def session(watched: Watched) -> Session:
    assert watched.network is not None
    return watched.network
