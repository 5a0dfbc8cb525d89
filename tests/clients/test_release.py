"""`make release` prepares everything and publishes nothing; what is published is as its readers expect it."""

import importlib.metadata
import os
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from catkin_pkg.package import parse_package
from trove_classifiers import classifiers

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tests" / "release.sh"
ROS_PACKAGE = ROOT / "packaging" / "ros2" / "optipmb_ros"
CHANGES = "# Changelog\n\n## 9.9.9 (2030-01-01)\n"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A committed checkout whose `make` and `python` only note how they were called."""
    (tmp_path / "bin").mkdir()
    for name, said in (("make", ""), ("python", "case $1 in -c) echo 9.9.9;; esac\n")):
        program = tmp_path / "bin" / name
        program.write_text(f'#!/bin/sh\necho {name} "$@" >>"{tmp_path}/calls"\n{said}')
        program.chmod(0o755)
    work = tmp_path / "work"
    work.mkdir()
    (work / "CHANGELOG.md").write_text(CHANGES)
    git(work, "init", "-q")
    commit(work)
    return work


def git(work: Path, *arguments: str) -> None:
    person = ["-c", "user.name=x", "-c", "user.email=x@example.org"]
    subprocess.run(["git", "-C", work, *person, *arguments], check=True, capture_output=True)  # noqa: S607


def commit(work: Path) -> None:
    git(work, "add", "-A")
    git(work, "commit", "-q", "-m", "state")


def release(work: Path) -> "tuple[subprocess.CompletedProcess[str], list[str]]":
    """Run the script; return its end and the commands it called."""
    bin_ = work.parent / "bin"
    environment = {**os.environ, "PATH": f"{bin_}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", SCRIPT, bin_],  # noqa: S607
        cwd=work,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return done, (work.parent / "calls").read_text().splitlines()


def test_it_tests_builds_checks_and_stops_before_publishing(checkout: Path) -> None:
    """All tests, all wheels, their check, what is in the image; tag and upload are printed for a person to run."""
    done, calls = release(checkout)
    image = "docker/requirements.lock"
    assert done.returncode == 0, done.stderr
    assert calls[1:] == [
        "make test wheel accuracy alone",
        "python -m build --outdir dist .",
        "python -m build --wheel --outdir dist node",
        "make wheels DIST=dist",
        "python -m twine check --strict dist/*",
        "python -m venv --clear --without-pip out/image-env",
        f"python -m pip --python out/image-env install --quiet --no-deps --require-hashes --requirement {image}",
        "python -m cyclonedx_py environment out/image-env --output-file out/sbom.cdx.json",
        "python packaging/licences.py out/sbom.cdx.json",
        "python -m pip install --quiet --target out/audit pip-audit>=2.9,<3",
        f"python -m pip_audit --no-deps --disable-pip --requirement {image}",
    ]
    assert "git tag -a v9.9.9" in done.stdout
    assert "twine upload dist/*" in done.stdout
    assert not subprocess.run(["git", "-C", checkout, "tag"], capture_output=True, check=True).stdout  # noqa: S607


@pytest.mark.parametrize("wrong", ["changed", "unreleased", "missing", "tagged", "placeholder"])
def test_what_is_not_ready_stops_it_at_once(checkout: Path, wrong: str) -> None:
    """Before any test runs, and with one line that says why."""
    text = {**dict.fromkeys(("changed", "tagged", "placeholder"), CHANGES), "missing": "# Changelog\n"}.get(
        wrong, "## 9.9.9 (unreleased)\n"
    )
    (checkout / "CHANGELOG.md").write_text(text)
    if wrong == "placeholder":
        (checkout / "SECURITY.md").write_text("https://example.invalid/optipmb/security\n")
        commit(checkout)
    elif wrong == "changed":
        (checkout / "new").touch()
    elif text != CHANGES:
        commit(checkout)
    if wrong == "tagged":
        git(checkout, "tag", "v9.9.9")
    done, calls = release(checkout)
    assert done.returncode == 1
    assert len(done.stdout.splitlines()) == 1
    assert done.stdout.startswith("release: ")
    assert len(calls) == 1


def test_the_project_is_described_in_words_that_indexes_know() -> None:
    """Every classifier exists; the licence is said by SPDX alone."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(project["classifiers"]) <= classifiers
    assert not [one for one in project["classifiers"] if one.startswith("License ::")]
    assert project["license"] == "Apache-2.0"


@pytest.mark.parametrize(
    ("schema", "files"),
    [
        ("vendor.citation-file-format", ["CITATION.cff"]),
        ("vendor.github-issue-config", [".github/ISSUE_TEMPLATE/config.yml"]),
        (
            "vendor.github-issue-forms",
            [f".github/ISSUE_TEMPLATE/{n}.yml" for n in ("fault", "question", "wrong-tracks")],
        ),
    ],
)
def test_files_of_the_repository_fit_their_schemas(schema: str, files: list[str]) -> None:
    """As those who show them read them."""
    command = [Path(sys.executable).parent / "check-jsonschema", "--builtin-schema", schema, *(ROOT / f for f in files)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_version_is_one() -> None:
    """In the citation, in the package for ROS 2; the address for Rerun has the version that writes the file."""
    version = importlib.metadata.version("optipmb")
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    package = parse_package(str(ROS_PACKAGE))
    assert (package.version, package.licenses, package.get_build_type()) == (version, ["Apache-2.0"], "ament_python")
    assert (
        f"rerun-sdk=={re.findall(r'rerun.io/version/([0-9.]+)/', (ROOT / 'docs/watching.md').read_text())[0]}\n"
        in (ROOT / "requirements.lock").read_text()
    )


class Part:
    """What the launch file builds, with its arguments; a stand-in, because ROS 2 is not on PyPI."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


def test_the_launch_file_starts_the_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line of `optipmb-service ros2`, with the settings of the package, that can be changed one by one."""
    for module in ("launch", "launch.actions", "launch.substitutions"):
        fake = ModuleType(module)
        for name in ("LaunchDescription", "DeclareLaunchArgument", "ExecuteProcess", "LaunchConfiguration"):
            setattr(fake, name, type(name, (Part,), {}))
        monkeypatch.setitem(sys.modules, module, fake)
    launched = runpy.run_path(str(ROS_PACKAGE / "launch" / "bridge.launch.py"))["generate_launch_description"]()
    *declared, process = launched.given[0]
    values = {one.given[0]: one.named["default_value"] for one in declared}
    words = [values[one.given[0]] if isinstance(one, Part) else one for one in process.named["cmd"]]
    assert words[:-1] == ["optipmb-service", "ros2", "--connect", "tcp/127.0.0.1:7447", "--settings"]
    assert tomllib.loads(Path(words[-1]).read_text())["ros2"]["streams"]
    assert sorted(values) == ["connect", "domain", "program", "settings"]
