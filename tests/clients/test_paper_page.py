"""docs/paper.md names code and commands that exist, and leaves out no equation, table or figure."""

import re
from pathlib import Path
from pkgutil import resolve_name

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "paper.md").read_text(encoding="utf-8")

TABLES = ("Table I", "Table II", "Table III", "Table IV", "Table V", "Table VI")


def section(title: str) -> str:
    return PAGE[PAGE.index(f"## {title}") :].split("\n## ")[0]


def test_the_code_of_each_equation_exists() -> None:
    """Equations 1 to 41 have a row each; `module.name` is in the tracker, or in the tools where it says so."""
    numbers: list[int] = []
    named = 0
    for line in section("Equations").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for part in re.findall(r"[0-9]+(?:-[0-9]+)?", cells[0]) if re.match("[0-9]", cells[0]) else []:
            first, _, last = part.partition("-")
            numbers += range(int(first), int(last or first) + 1)
        for name in re.findall(r"`((?:\w+\.)+\w+)`", line):
            assert resolve_name(name if name.startswith("optipmb_tools") else f"optipmb.{name}")
            named += 1
    assert sorted(numbers) == list(range(1, 42))
    assert named > 20


def test_each_table_and_figure_has_its_row() -> None:
    """Figures 1 to 5 and tables I to VI."""
    items = [line.split("|")[1].strip() for line in section("Tables and figures").splitlines() if line.startswith("| ")]
    assert items[2:] == ["Fig. 1, 2", "Fig. 3", "Fig. 4", "Fig. 5", *TABLES]
