"""Prints the licences of the packages in a CycloneDX list, as each package declares them: `python licences.py SBOM`."""

import json
import sys
from pathlib import Path

for one in json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["components"]:
    declared = [licence.get("expression") or licence["license"].get("id") or licence["license"]["name"]
                for licence in one.get("licenses", [])]  # fmt: skip
    names = dict.fromkeys(name.rpartition(" :: ")[2] for name in declared)
    print(f"{one['name']:40} {one['version']:16} {', '.join(names) or 'none declared'}")
