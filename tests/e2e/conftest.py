"""Compiled kernels for all tests, and a real service for those of a module, as a process of its own."""

from collections.abc import Iterator

import pytest
from service_process import ServiceProcess

import optipmb


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    optipmb.warm_up()


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    with ServiceProcess("--instance", "garage") as process:
        process.wait_ready()
        yield process
