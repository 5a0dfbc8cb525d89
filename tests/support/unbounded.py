"""An end without a bound: a real one would end the process of the tests."""

from types import SimpleNamespace
from typing import Any, Final

NO_BOUND: Final[Any] = SimpleNamespace(begin=lambda: True, left=lambda: 60.0)
