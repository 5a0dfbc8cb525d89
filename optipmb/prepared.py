"""Lets kernels that were compiled at installation be loaded where nothing may be written, as in an image.

Numba looks for its cache only where it could also write. With
``NUMBA_CACHE_LOCATOR_CLASSES=optipmb.prepared.PreparedCacheLocator`` it takes what lies beside the source as it is.
"""

from pathlib import Path

from numba.core.caching import InTreeCacheLocator


class PreparedCacheLocator(InTreeCacheLocator):  # numba ships no types
    """The cache beside the source, whether or not it can be written to."""

    def ensure_cache_path(self) -> None:
        """Make the folder if need be, and ask for nothing more.

        Raises:
            OSError: it is not there and cannot be made; numba then knows no cache.
        """
        Path(self.get_cache_path()).mkdir(exist_ok=True)  # type: ignore[no-untyped-call]  # the same
