"""Lets kernels that were compiled at installation be loaded where nothing may be written, as in an image.

Numba looks for its cache only where it could also write. With
``NUMBA_CACHE_LOCATOR_CLASSES=optipmb.prepared.PreparedCacheLocator`` it reads the cache in the package's folder.
"""

from pathlib import Path

from numba.core.caching import InTreeCacheLocator


class PreparedCacheLocator(InTreeCacheLocator):  # numba ships no types
    """The cache in the package's folder, read-only or not."""

    def ensure_cache_path(self) -> None:
        """Make the folder where it is missing; an `OSError` tells numba that there is no cache."""
        Path(self.get_cache_path()).mkdir(exist_ok=True)  # type: ignore[no-untyped-call]  # the same
