"""A bridge into the log in a process of its own, asked for its figures as Prometheus asks."""

import json
import re
import urllib.error
import urllib.request

from router import Node, Sensor, until
from routers import free_endpoint
from service_process import ServiceProcess

PROBE = Sensor(stream="probe/probe/probe")


class LogProcess(ServiceProcess):
    """`optipmb-service log`.

    Args:
        endpoint: of the router.
        nats: of the NATS server.
        instance: its name.
        options: further ones.
    """

    def __init__(self, endpoint: str, nats: str, instance: str = "log", *options: str) -> None:
        self.http = free_endpoint().removeprefix("tcp/")
        super().__init__(
            *("log", "--connect", endpoint, "--cluster", nats, "--instance", instance, "--http", self.http),
            *options,
            listen=False,
        )

    def ask(self, path: str) -> str:
        try:
            with urllib.request.urlopen(f"http://{self.http}{path}", timeout=10) as answer:
                return str(answer.read().decode())
        except urllib.error.HTTPError as error:
            return error.read().decode()
        except OSError:
            return ""

    def figure(self, name: str) -> float:
        found = re.search(rf"^optipmb_message_log_{name} (\S+)$", self.ask("/metrics"), re.MULTILINE)
        return float(found[1]) if found else 0.0

    @property
    def handled(self) -> float:
        """Messages that are in the log by this bridge, or that it found there."""
        return self.figure("written_total") + self.figure("repeated_total")

    @property
    def readiness(self) -> tuple[str, str]:
        answer = json.loads(self.ask("/readyz") or "{}")
        return answer.get("state", ""), answer.get("failure", "")

    def wait_receiving(self, node: Node) -> None:
        """Wait until it gets what a node publishes without a cache: it does not matter when it was started."""
        seq = 0

        def came() -> bool:
            nonlocal seq
            seq += 1
            node.send_plain(PROBE.detections(seq))
            return self.handled > 0

        self.wait_ready()
        until(came, "the bridge puts messages into the log")
