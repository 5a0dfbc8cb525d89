"""Prints constraints for the lowest versions that pyproject.toml allows: `python tests/lowest.py`."""

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
LOWEST = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)>=(?P<version>[0-9.]+)")

project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
extras = project["optional-dependencies"]
# Packages for development alone are not installed by users.
for requirement in (*project["dependencies"], *(one for name in extras if name != "dev" for one in extras[name])):
    if found := LOWEST.match(requirement):
        print(f"{found['name']}=={found['version']}")
