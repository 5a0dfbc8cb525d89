"""Part of the build of a wheel: machine code of kernels, and at a release no files of the wheel of the node."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLATFORM = "manylinux_2_17_x86_64"
"""The oldest that numba has wheels for. The code is loaded by numba, and calls no C library of its own."""
NODE = ("schemas/optipmb_schemas", "clients/optipmb_client")
"""Packages that the wheel of `node` has, too."""


class Wheel(BuildHookInterface[Any]):
    """Fills a wheel by where it is built, and by a folder that the environment names, as in `packaging/wheels.sh`."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files and the tag of the wheel; without a folder it is for all."""
        if version != "standard":
            return
        if (Path(self.root) / "PKG-INFO").exists():  # built from the source archive: a release
            config = self.build_config.target_config
            config["packages"] = [one for one in config["packages"] if one not in NODE]
            build_data["dependencies"] = [f"optipmb-node=={self.metadata.version}"]
        if folder := os.environ.get("OPTIPMB_MACHINE_CODE"):
            python = f"cp{sys.version_info.major}{sys.version_info.minor}"
            build_data["force_include"][folder] = "optipmb/machine_code"
            build_data |= {"pure_python": False, "tag": f"{python}-{python}-{PLATFORM}"}
