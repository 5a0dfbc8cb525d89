"""A real service for the tests of a module, as a process of its own."""

from collections.abc import Iterator

import pytest
from optipmb_tools.run.service_process import ServiceProcess

START_S = 240.0  # the first start on a machine compiles


@pytest.fixture(scope="module")
def service() -> Iterator[ServiceProcess]:
    with ServiceProcess() as process:
        process.wait_until_ready(START_S)
        yield process
