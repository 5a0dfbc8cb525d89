"""A service in the test's own process, with its own router on a free port, and a node that talks to it."""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest
from optipmb_service.app.configuration import load
from optipmb_service.app.service import Service
from optipmb_service.streams.profiles import Profiles
from router import Node
from routers import free_endpoint

import optipmb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    Start = Callable[..., tuple[Service, str]]


@pytest.fixture(scope="session")
def _compiled() -> None:
    """Do what the service does at its start: a full garbage collection may take as long as no frame is allowed to."""
    optipmb.warm_up()
    gc.collect()
    gc.freeze()


@pytest.fixture
def start(_compiled: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Start services; each is stopped at the end. Options are settings; `tracker` is the service's own."""
    with contextlib.ExitStack() as stack:

        def begin(*, tracker: Any = None, **options: Any) -> tuple[Service, str]:
            endpoint = free_endpoint()
            given = {"listen": [endpoint], "instance": "test", "grace_s": 0.2, "store": "none", "profile": "nuscenes"}
            given |= options
            settings = load(None, given).settings
            profiles = Profiles.read(settings.profile, settings.profiles, settings.sensors, settings.missing_s)
            service = Service(settings, profiles, arm, tracker)
            stack.callback(service.stop)
            service.start()
            return service, (settings.endpoints or settings.connect)[0]

        yield begin


@pytest.fixture
def node(start: Start) -> Iterator[Node]:
    _, endpoint = start()
    with Node(endpoint) as one:
        yield one


def arm(wake: Callable[[], None], at_ns: int) -> None:
    timer = threading.Timer(max(0.0, at_ns - time.monotonic_ns()) / 1e9, wake)
    timer.daemon = True
    timer.start()
