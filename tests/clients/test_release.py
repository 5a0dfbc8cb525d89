"""`make release` prepares everything and publishes nothing."""

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "release.sh"
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
    """All tests, two wheels, the check of their content; tag and upload are printed for a person to run."""
    done, calls = release(checkout)
    assert done.returncode == 0, done.stderr
    assert calls[1:] == [
        "make test wheel accuracy alone",
        "python -m build --outdir dist .",
        "python -m build --wheel --outdir dist node",
        "python -m twine check --strict dist/*",
    ]
    assert "git tag -a v9.9.9" in done.stdout
    assert "twine upload dist/*" in done.stdout
    assert not subprocess.run(["git", "-C", checkout, "tag"], capture_output=True, check=True).stdout  # noqa: S607


@pytest.mark.parametrize("wrong", ["changed", "unreleased", "missing", "tagged"])
def test_what_is_not_ready_stops_it_at_once(checkout: Path, wrong: str) -> None:
    """Before any test runs, and with one line that says why."""
    text = {"changed": CHANGES, "tagged": CHANGES, "missing": "# Changelog\n"}.get(wrong, "## 9.9.9 (unreleased)\n")
    (checkout / "CHANGELOG.md").write_text(text)
    if wrong == "changed":
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
