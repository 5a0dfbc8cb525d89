"""A service with its own router and a gateway, as processes, for all tests; each test has its own stream."""

import itertools
import json
from collections.abc import Iterator
from typing import Any

import pytest
from gateway import GatewayProcess
from service_process import ServiceProcess

NUMBERS = itertools.count()
FUSED = {"OPTIPMB_FUSE": "fused-yard/*/*"}


@pytest.fixture(scope="session")
def service() -> Iterator[ServiceProcess]:
    yard = {"streams": ["zoned/*/*"], "polygon": [[10, -5], [30, -5], [30, 5], [10, 5]]}
    zones = {"yard": yard, "gate": {"streams": ["zoned/*/*"], "line": [[20, -5], [20, 5]]}}
    with ServiceProcess(environment={"OPTIPMB_ZONES": json.dumps(zones)} | FUSED) as process:
        process.wait_ready()
        yield process


@pytest.fixture(scope="session")
def gateway(service: ServiceProcess) -> Iterator[GatewayProcess]:
    """A gateway of that service; a new interpreter, for the memory that it takes is measured."""
    with GatewayProcess(service.endpoint, environment=FUSED, fresh=True) as process:
        process.wait_ready()
        yield process


@pytest.fixture
def stub(gateway: GatewayProcess) -> Any:
    return gateway.stub()


@pytest.fixture
def stream() -> str:
    return f"yard/robot-{next(NUMBERS)}/lidar"
