"""Kernels that were compiled at installation are found where nothing may be written."""

from __future__ import annotations

import tempfile
from typing import TYPE_CHECKING, Any, NoReturn

from numba.core.caching import InTreeCacheLocator

from optipmb import motion
from optipmb.prepared import PreparedCacheLocator
from optipmb.warm import kernels

if TYPE_CHECKING:
    import pytest


def test_a_cache_that_cannot_be_written_is_still_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where numba finds no cache because it may not write, ours is found, and it is the one beside the source."""
    function = next(kernel.py_func for name, kernel in kernels().items() if name.startswith(motion.__name__))
    usual = InTreeCacheLocator.from_function(function, motion.__file__)

    def refuse(*_arguments: Any, **_options: Any) -> NoReturn:
        raise PermissionError("read-only")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    assert InTreeCacheLocator.from_function(function, motion.__file__) is None
    ours = PreparedCacheLocator.from_function(function, motion.__file__)
    assert ours.get_cache_path() == usual.get_cache_path()
    assert ours.get_source_stamp() == usual.get_source_stamp()
