"""Writes the JSON Schemas of the messages: `python -m optipmb_schemas.export [--check] [--page FILE] DIR`.

One file per message type, `<Type>.v1.schema.json`, describing the JSON form. With `--page` the tables of a
documentation page are brought up to date as well. With `--check` nothing is written: every file that is not up to date
gets one line, and the exit status is 1.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from optipmb_schemas.codec import MAJOR, MESSAGES, encoding_of
from optipmb_schemas.model import Message
from optipmb_schemas.pages import fill

SUFFIX = ".schema.json"


class _Untitled(GenerateJsonSchema):
    """Leaves out titles: they would repeat the names of the fields."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - no field has one
        """Return False: no field has a title."""
        return False


def schema_of(kind: type[Message]) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the JSON form of a message type."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:optipmb:{kind.__name__}.v{MAJOR}",
        "x-encoding": encoding_of(kind, form="json"),
        **kind.model_json_schema(schema_generator=_Untitled),
    }


def schema_files() -> dict[str, str]:
    """Return the names and texts of all schema files."""
    return {
        f"{kind.__name__}.v{MAJOR}{SUFFIX}": json.dumps(schema_of(kind), indent=2, sort_keys=True) + "\n"
        for kind in MESSAGES
    }


def stale(files: dict[Path, str], folder: Path) -> list[str]:
    """Return one line for every file that is missing, not up to date, or a schema of a message that there is not."""
    lines = [f"{path}: missing" for path in files if not path.is_file()]
    lines += [f"{path}: not up to date" for path, text in files.items() if path.is_file() and _read(path) != text]
    lines += [f"{path}: no such message" for path in sorted(folder.glob(f"*{SUFFIX}")) if path not in files]
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit status: 0 done, 1 not up to date, 2 not possible."""
    parser = argparse.ArgumentParser(
        prog="python -m optipmb_schemas.export", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="write nothing, report what is not up to date")
    parser.add_argument("--page", type=Path, metavar="FILE", help="a documentation page whose tables are updated too")
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the schema files")
    options = parser.parse_args(arguments)
    try:
        files = {options.folder / name: text for name, text in schema_files().items()}
        if options.page:
            files[options.page] = fill(_read(options.page))
        lines = stale(files, options.folder)
        if options.check:
            for line in lines:
                sys.stdout.write(f"{line}; run python -m optipmb_schemas.export {options.folder}\n")
            return 1 if lines else 0
        options.folder.mkdir(parents=True, exist_ok=True)
        for path, text in files.items():
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
