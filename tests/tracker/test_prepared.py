"""Kernels that were compiled at installation are found where nothing may be written."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from typing import TYPE_CHECKING, Any, NoReturn

import numba
import pytest
from numba.core.caching import InTreeCacheLocator

from optipmb.filter import predict
from optipmb.prepared import PreparedCacheLocator
from optipmb.warm import kernels

if TYPE_CHECKING:
    from pathlib import Path

PROGRAM = """
import optipmb
from optipmb.filter.predict import wrap

print(wrap(0.5))  # a small kernel
"""


def test_a_cache_that_cannot_be_written_is_still_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where numba finds no cache because it may not write, ours is found in the package's folder."""
    function = next(kernel.py_func for name, kernel in kernels().items() if name.startswith(predict.__name__))
    usual = InTreeCacheLocator.from_function(function, predict.__file__)

    def refuse(*_arguments: Any, **_options: Any) -> NoReturn:
        raise PermissionError("read-only")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    assert InTreeCacheLocator.from_function(function, predict.__file__) is None
    ours = PreparedCacheLocator.from_function(function, predict.__file__)
    assert ours.get_cache_path() == usual.get_cache_path()
    assert ours.get_source_stamp() == usual.get_source_stamp()


@pytest.mark.parametrize("mode", [0o700, 0o777])
def test_a_user_without_a_writable_cache_can_import(mode: int, tmp_path: Path) -> None:
    """Where numba finds no folder, kernels go to a private one, unless others may write there; and it is said."""
    kept = tmp_path / f"optipmb-kernels-{os.getuid()}"
    kept.mkdir()
    kept.chmod(mode)
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "TMPDIR": str(tmp_path)}
    nowhere["OPTIPMB_COMPILE_PROCESSES"] = "0"  # for the one kernel that is needed
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | nowhere
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False, env=environment)
    assert (done.returncode, done.stdout) == (0, "0.5\n"), done.stderr
    assert done.stderr.count("set NUMBA_CACHE_DIR") == 1
    is_private = mode == 0o700
    assert (f"kernels are kept in {kept}" in done.stderr) is is_private
    assert any(kept.rglob("*.nbi")) is is_private


def test_machine_code_of_a_version_with_other_modules_is_compiled_anew(tmp_path: Path) -> None:
    """After an update in place, an index in the package's folder may refer to removed names."""
    source = tmp_path / "some_kernel.py"
    source.write_text("from optipmb.compiled import kernel\n\n\n@kernel\ndef double(x):\n    return 2 * x\n")
    program = "import some_kernel; print(some_kernel.double(21))"
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == "42\n"
        (index,) = (tmp_path / "cache").rglob("*.nbi")
        index.write_bytes(pickle.dumps(numba.__version__) + b"cno_such_module\nname\n.")
