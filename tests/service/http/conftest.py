"""A service as the HTTP server sees it."""

from __future__ import annotations

import pytest
from watched import Session, Watched


@pytest.fixture
def watched() -> Watched:
    return Watched()


@pytest.fixture
def session(watched: Watched) -> Session:
    assert watched.network is not None
    return watched.network
