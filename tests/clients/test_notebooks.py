"""The notebooks run from the first cell to the last one, and are stored with such outputs."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
RESULTS = {"boxes": "fastest", "evaluate": "nearest", "zones": "junction"}
"""A word of the last table of each notebook."""
LARGEST = 200_000
"""Bytes of a notebook with its outputs."""


def kinds(cells: Any) -> list[list[list[str]]]:
    """Return the kinds of the outputs of each cell."""
    return [[sorted(output.get("data", {"stream": ""})) for output in cell.outputs] for cell in cells]


@pytest.mark.parametrize("name", sorted(path.stem for path in (EXAMPLES / "notebooks").glob("*.ipynb")))
def test_a_notebook_runs_and_draws(name: str, tmp_path: Path) -> None:
    """Every cell runs in a copy of the folder, with outputs of the kinds that are stored: the last one is a picture.

    `make pictures` stores them again.
    """
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("nbclient")
    from notebooks import executed  # noqa: PLC0415 - an extra

    folder = shutil.copytree(EXAMPLES, tmp_path / "examples") / "notebooks"
    file = EXAMPLES / "notebooks" / f"{name}.ipynb"
    stored, made = (
        [cell for cell in notebook.cells if cell.cell_type == "code"]
        for notebook in (nbformat.read(file, as_version=4), executed(folder, name))
    )
    assert kinds(stored) == kinds(made)
    assert file.stat().st_size < LARGEST
    assert RESULTS[name] in json.dumps([cell.outputs for cell in stored])
    assert any("image/png" in output.get("data", {}) for output in stored[-1].outputs)
