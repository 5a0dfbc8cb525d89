"""Runs the tests nearest to what changed: `python benchmarks/nearest.py COMMIT`, which may be a branch.

A test file is near when it imports a module that changed; when no test does, tests that import a module that imports
one, and so on. Of many that are equally near, the namesakes run: a package that imports all its parts brings them all
near. Tests that share the most and rarest words with a module run too: the rules of a session are tested through the
session. So do tests that changed. Files are compared with where the branch left COMMIT;
files that are not committed count. (Tools that watch which lines a test runs cannot see into compiled kernels.)
"""

from __future__ import annotations

import ast
import collections
import math
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = (".", "schemas", "service", "clients", "tests/support", "benchmarks", "docker")
"""Folders that imports are looked up in."""
WHOLE = {
    "optipmb": "tests/tracker/test_oracle.py",
    "clients/optipmb_tools/run": "tests/clients/test_mistakes.py",
    "service/optipmb_service/session": "tests/service/stream/test_recorded.py",
    "service/optipmb_service/streams": "tests/service/stream/test_recorded.py",
}
"""Tests that compare whole runs with what was computed otherwise or recorded: they are near to all of a folder."""
SLOW = ("e2e", "docker")
"""Tests of whole systems run only when they changed themselves."""
MANY = 8
"""Beyond so many files a check would take more than a minute."""
AKIN = 6
"""Test files chosen for each module by their words."""
WORD = re.compile(r"[A-Za-z_]\w{3,}")


def main(since: str) -> int:
    tests, changed = _tests(), _changed(since)
    chosen = sorted(nearest(changed) | (changed & tests))
    if not chosen:
        print("no test is near to what changed")
        return 0
    print(f"{len(chosen)} of {len(tests)} test files:", *(str(path.relative_to(ROOT)) for path in chosen), flush=True)
    options = ["-q", "-n", "2", "--dist", "worksteal", "-m", "not bounds and not ray"]
    command = [sys.executable, "-m", "pytest", *options, *map(str, chosen)]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


def nearest(changed: set[Path]) -> set[Path]:
    """Return the files of tests nearest to modules, without tests of whole systems."""
    tests = _tests()
    imports = {path: _imports(path) for path in _modules() | tests}
    quick = {path for path in tests if path.relative_to(ROOT / "tests").parts[0] not in SLOW}
    whole = {ROOT / test for folder, test in WHOLE.items() if any((ROOT / folder) in path.parents for path in changed)}
    return _nearest(changed, imports, quick) | _akin(changed - tests, quick) | whole


def _tests() -> set[Path]:
    return set(ROOT.glob("tests/*/**/test_*.py"))


def _changed(since: str) -> set[Path]:
    base = _git("merge-base", since, "HEAD") or ["HEAD"]
    names = _git("diff", "--name-only", base[0]) + _git("ls-files", "--others", "--exclude-standard")
    return {ROOT / name for name in names if name.endswith(".py") and (ROOT / name).exists()}


def _git(*words: str) -> list[str]:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S607
    return done.stdout.splitlines()


def _modules() -> set[Path]:
    folders = ("optipmb", "schemas", "service", "clients", "tests/support", "benchmarks", "docker")
    return {path for folder in folders for path in (ROOT / folder).rglob("*.py")}


def _imports(path: Path) -> set[Path]:
    found: set[Path] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {file for one in node.names if (file := _file(one.name))}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = (node.module, *(f"{node.module}.{one.name}" for one in node.names))
            found |= {file for name in names if (file := _file(name))}
    return found


def _file(name: str) -> Path | None:
    for source in SOURCES:
        place = ROOT / source / Path(*name.split("."))
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                return file
    return None


def _nearest(changed: set[Path], imports: dict[Path, set[Path]], tests: set[Path]) -> set[Path]:
    """Return the tests at the least distance from the changed modules."""
    reached = changed - tests
    while reached:
        importers = {path for path, found in imports.items() if found & reached} - reached
        if near := importers & tests:
            return (len(near) > MANY and _namesakes(near, changed)) or near
        if not importers:
            break
        reached |= importers
    return set()


def _akin(changed: set[Path], tests: set[Path]) -> set[Path]:
    """Return for each module the tests that share the most words with it: rare ones count more, long tests less."""
    words = {path: set(WORD.findall(path.read_text(encoding="utf-8"))) for path in changed | tests}
    number = collections.Counter(word for path in tests for word in words[path])

    def likeness(test: Path, module: Path) -> float:
        shared = words[test] & words[module]
        return sum(math.log(len(tests) / number[word]) for word in sorted(shared)) / math.sqrt(len(words[test]))

    return {test for module in changed for test in sorted(tests, key=lambda one: (-likeness(one, module), one))[:AKIN]}


def _namesakes(tests: set[Path], changed: set[Path]) -> set[Path]:
    """Return the tests that share a word of their name with a changed module or its folder."""
    words = {word for path in changed for part in (path.parent.name, path.stem) for word in part.split("_")} - {""}
    return {path for path in tests if words & set(path.stem.split("_"))}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
