"""Certificates that expire: who reports it, and where; a renewed one is used."""

import re
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
from optipmb_client import Publisher
from optipmb_client.errors import ConnectionFailed
from optipmb_schemas import Keys, ServiceStatus, decode
from protected import Network, Party
from router import until
from routers import free_endpoint
from service_process import ServiceProcess

KEYS = Keys()
NAMES = ("--node", "garage/robot", "--service", "tracker", "--viewer", "ops")


@pytest.fixture
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with Network(tmp_path_factory.mktemp("tls"), *NAMES) as one:
        yield one


def started(network: Network, address: str) -> ServiceProcess:
    config = str(network.config("service/tracker"))
    options = ("--instance", "tracker", "--connect", network.endpoint, "--zenoh-config", config, "--http", address)
    return ServiceProcess(*options, listen=False)


def get(address: str, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def days(address: str) -> dict[str, float]:
    text = get(address, "/metrics")[1]
    return {
        use: float(value)
        for use, value in re.findall(r'^optipmb_certificate_days{use="(\w+)"} (\S+)$', text, re.MULTILINE)
    }


def test_a_certificate_that_has_ended_is_named(network: Network) -> None:
    """Log, readiness, metric and the message of a client name the file; renewed files are used without a restart."""
    network.make("--renew", "--days", "-1")
    address = free_endpoint().removeprefix("tcp/")
    said = f"TLS: the certificate {network.folder / 'service' / 'tracker' / 'cert.pem'} ended on "
    with started(network, address) as service:
        service.wait_log("certificate_ended")
        assert said in service.errors
        until(lambda: said in get(address, "/readyz")[1], "it is named")
        assert get(address, "/readyz")[0] == 503
        held = days(address)
        assert held["zenoh"] < 0 < held["zenoh_authority"]
        with pytest.raises(ConnectionFailed, match=r"TLS: the certificate \S+/node/garage/robot/cert.pem ended on "):
            Publisher(
                "garage/robot/lidar", connect=network.endpoint, config=network.config("node/garage/robot"), timeout=1
            )
        network.make("--renew")
        service.wait_ready()
        until(lambda: get(address, "/readyz")[0] == 200, "it is ready")
        assert days(address)["zenoh"] > 80


def test_a_certificate_that_ends_while_running_is_a_problem(network: Network) -> None:
    """The status of a service has the problem, its readiness the file, while its link is still there."""
    address = free_endpoint().removeprefix("tcp/")
    with started(network, address) as service, Party(network.config("viewer/ops")) as viewer:
        service.wait_ready()
        assert get(address, "/readyz") == (200, '{"ready":true,"state":"ready"}')
        network.make("--renew", "--days", "-1")

        def problems() -> list[str]:
            answers = viewer.ask(KEYS.status("tracker"))
            return [one.code for answer in answers for one in decode(answer, ServiceStatus).problems]

        until(lambda: "certificate" in problems(), "the problem")
        status, body = get(address, "/readyz")
        assert status == 503
        assert "TLS: the certificate" in body
