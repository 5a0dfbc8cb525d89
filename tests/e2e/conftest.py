"""A real service for the tests of a module, as a process of its own."""

from collections.abc import Iterator

import pytest
from service_process import ServiceProcess


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    with ServiceProcess("--instance", "garage") as process:
        process.wait_ready()
        yield process
