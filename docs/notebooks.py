"""The outputs of the notebooks: `make pictures`; needs the extra `dev`."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbclient
import nbformat
from traitlets.config import Config


def executed(folder: Path, name: str) -> Any:
    """Run a notebook in its folder, where it may write; return it with its outputs, and without times."""
    notebook = nbformat.read(folder / f"{name}.ipynb", as_version=4)
    with tempfile.TemporaryDirectory() as sockets:  # in place of ports, which other tests may take; its path is short
        link = Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets}/kernel"}})
        where = {"metadata": {"path": f"{folder}"}}
        nbclient.NotebookClient(notebook, timeout=100, resources=where, config=link, record_timing=False).execute()
    return notebook


def main(examples: Path) -> None:
    """Write the outputs into the notebooks."""
    with tempfile.TemporaryDirectory() as place:
        settings = Path(place) / "matplotlibrc"
        settings.write_text("svg.hashsalt: optipmb\n", encoding="ascii")
        os.environ |= {"SOURCE_DATE_EPOCH": "0", "MATPLOTLIBRC": f"{settings}"}  # the same pictures, the same bytes
        folder = shutil.copytree(examples, Path(place) / "examples") / "notebooks"
        for file in sorted((examples / "notebooks").glob("*.ipynb")):
            nbformat.write(executed(folder, file.stem), file)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
