"""docs/reliability.md names tests that exist, for each of the faults."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")


def test_every_fault_has_tests_that_exist() -> None:
    """Twenty-two rows, each with at least one test, and every test that the page names is a function of its file."""
    (table,) = re.findall(r"<!-- faults -->\n(.*?)<!-- end -->", PAGE, re.DOTALL)
    rows = re.findall(r"^\| (\d+) \|(.*)$", table, re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, 23))
    assert all("::test_" in row for _, row in rows)


def test_every_test_that_is_named_exists() -> None:
    """No test was renamed without the page."""
    named = re.findall(r"`(tests/\S+?\.py)::(test_\w+)`", PAGE)
    assert named
    for file, name in named:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {part.name for part in ast.walk(tree) if isinstance(part, ast.FunctionDef)}, f"{file}::{name}"
