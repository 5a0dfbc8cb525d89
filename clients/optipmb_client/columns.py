"""Tables of rich that fit the terminal: in parts one below the other, or without the columns that matter least."""

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table


def parts(table: Table, width: int) -> Iterator[Table]:
    """Yield a table in parts that fit a width; its leading columns that are aligned left stand in each of them."""
    widths = _widths(table)
    lead = [place for place in range(len(widths)) if all(one.justify == "left" for one in table.columns[: place + 1])]
    taken, used = list(lead), sum(widths[place] for place in lead)
    for place in range(len(lead), len(widths)):
        if used + widths[place] - _space(table) > width and taken != lead:
            yield _only(table, taken)
            taken, used = list(lead), sum(widths[one] for one in lead)
        taken.append(place)
        used += widths[place]
    yield _only(table, taken)


def without(table: Table, width: int, spare: Sequence[str]) -> Table:
    """Return a table that fits a width: of the columns with these headers it lacks the first ones, if it must."""
    widths = _widths(table)
    taken = list(range(len(widths)))
    for header in spare:
        if sum(widths[place] for place in taken) - _space(table) <= width:
            break
        taken = [place for place in taken if table.columns[place].header != header]
    return _only(table, taken)


def _widths(table: Table) -> list[int]:
    """Return what each column needs, with the space to the next."""
    console = Console(width=10_000)
    alone = (_only(table, [place]) for place in range(len(table.columns)))
    return [Measurement.get(console, console.options, one).maximum + _space(table) for one in alone]


def _space(table: Table) -> int:
    return 2 if table.box is None else 3


def _only(table: Table, places: Sequence[int]) -> Table:
    part = Table(
        box=table.box,
        pad_edge=table.pad_edge,
        title=table.title,
        title_justify=table.title_justify,
        header_style=table.header_style,
    )
    for place in places:
        column = table.columns[place]
        part.add_column(column.header, justify=column.justify, no_wrap=column.no_wrap, overflow=column.overflow)
    for row in zip(*(table.columns[place].cells for place in places), strict=True):
        part.add_row(*row)
    return part
