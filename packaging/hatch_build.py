"""Part of the build: puts machine code of kernels into a wheel, for one Python and one kind of processor."""

from __future__ import annotations

import os
import sys
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLATFORM = "manylinux_2_17_x86_64"
"""The oldest that numba has wheels for. The code is loaded by numba, and calls no C library of its own."""


class MachineCode(BuildHookInterface[Any]):
    """Takes the folder that the environment names, as `packaging/wheels.sh` does."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files and the tag of the wheel; without a folder it is for all."""
        folder = os.environ.get("OPTIPMB_MACHINE_CODE")
        if folder and version == "standard":
            python = f"cp{sys.version_info.major}{sys.version_info.minor}"
            build_data["force_include"][folder] = "optipmb/machine_code"
            build_data |= {"pure_python": False, "tag": f"{python}-{python}-{PLATFORM}"}
