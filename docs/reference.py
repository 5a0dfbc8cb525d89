"""The tables of `docs/reference.md`, made from the code that they describe.

python docs/reference.py docs/reference.md            write them
python docs/reference.py --check docs/reference.md    status 1 when they are not current
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args, get_origin

from optipmb_service.observability.logs import EVENTS
from optipmb_service.observability.metrics import METRICS, NAMESPACE
from optipmb_service.session.problems import CODES
from optipmb_service.settings.model import Settings
from optipmb_service.settings.tables import LimitSettings, Ros2Settings, Ros2Stream

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from pydantic.fields import FieldInfo

MOST_ALLOWED: Final = 60
"""Characters of allowed values beyond which they are in the column of the meaning, which is wider."""

_TABLE: Final = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(text: str) -> str:
    """Return a page with its tables made anew."""
    tables = {"settings": settings(), "problems": problems(), "events": events(), "metrics": metrics()}
    return _TABLE.sub(lambda match: f"{match[1]}{tables[match[2]]}{match[3]}", text)


def settings() -> str:
    """Return the table of all settings."""
    rows = [_setting(name, field) for name, field in Settings.model_fields.items() if name not in {"limits", "ros2"}]
    rows += [_setting(f"limits.{name}", field) for name, field in LimitSettings.model_fields.items()]
    rows += [_setting(f"ros2.{name}", field) for name, field in Ros2Settings.model_fields.items()]
    rows += [_setting(f"ros2.streams.NAME.{name}", field) for name, field in Ros2Stream.model_fields.items()]
    return _table(("setting", "default", "allowed", "meaning"), rows)


def problems() -> str:
    """Return the table of the codes of problems."""
    return _table(("code", "meaning", "what to do"), [(f"`{code}`", *texts) for code, texts in CODES.items()])


def events() -> str:
    """Return the table of the log events."""
    return _table(("event", "meaning"), [(f"`{event}`", text) for event, text in EVENTS.items()])


def metrics() -> str:
    """Return the table of the metrics."""
    rows = [
        (f"`{NAMESPACE}{name}{'{' + ','.join(metric.labels) + '}' if metric.labels else ''}`", metric.meaning)
        for name, metric in METRICS.items()
    ]
    return _table(("metric", "meaning"), rows)


def _setting(name: str, field: FieldInfo) -> tuple[str, str, str, str]:
    default = field.get_default(call_default_factory=False) if field.default_factory is None else None
    shown = "required" if field.is_required() else "" if default in (None, (), "") else f"`{_plain(default)}`"
    bounds = {
        kind: value
        for rule in field.metadata
        for kind in ("ge", "gt", "le")
        if (value := getattr(rule, kind, None)) is not None
    }
    allowed = _interval(bounds)
    if get_origin(field.annotation) is Literal:
        allowed = ", ".join(f"`{choice}`" for choice in get_args(field.annotation))
    if len(allowed) > MOST_ALLOWED:
        return f"`{name}`", "", "", f"{field.description}: {allowed}; default: {shown}"
    return f"`{name}`", shown, allowed, field.description or ""


def _interval(bounds: dict[str, Any]) -> str:
    low = f"[{_plain(bounds['ge'])}" if "ge" in bounds else f"({_plain(bounds['gt'])}" if "gt" in bounds else ""
    if "le" in bounds:
        return f"{low}, {_plain(bounds['le'])}]"
    return low.replace("[", "≥ ").replace("(", "> ")


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def main(arguments: Sequence[str]) -> int:
    """Write or check the page; returns the exit status."""
    check = "--check" in arguments
    (file,) = (Path(argument) for argument in arguments if argument != "--check")
    old = file.read_text(encoding="utf-8")
    new = page(old)
    if not check:
        file.write_text(new, encoding="utf-8")
    elif new != old:
        print(f"{file} is not current: python docs/reference.py {file}", file=sys.stderr)  # noqa: T201 - a command
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
