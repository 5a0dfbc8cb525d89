"""The notebooks run from the first cell to the last one, and are stored without outputs."""

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
RESULTS = {"boxes": "fastest", "evaluate": "nearest", "zones": "junction"}
"""A word of the last table of each notebook."""


@pytest.mark.parametrize("name", sorted(path.stem for path in (EXAMPLES / "notebooks").glob("*.ipynb")))
def test_a_notebook_runs_and_draws(name: str, tmp_path: Path) -> None:
    """Every cell runs in a copy of the folder; the last ones show a table and a picture. No output is in the file."""
    nbformat, nbclient, traitlets = map(pytest.importorskip, ("nbformat", "nbclient", "traitlets"))
    folder = shutil.copytree(EXAMPLES, tmp_path / "examples") / "notebooks"
    notebook: Any = nbformat.read(folder / f"{name}.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    with tempfile.TemporaryDirectory() as sockets:  # in place of ports, which other tests may take; its path is short
        link = traitlets.config.Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets}/kernel"}})
        where = {"metadata": {"path": f"{folder}"}}
        nbclient.NotebookClient(notebook, timeout=100, resources=where, config=link).execute()
    assert RESULTS[name] in json.dumps([cell.outputs for cell in cells])
    assert any("image/png" in output.get("data", {}) for output in cells[-1].outputs)
