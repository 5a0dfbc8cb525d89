"""Records in one array: numpy and kernels read the given columns, and nothing else fits."""

from __future__ import annotations

import copy
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import optipmb
from optipmb.model.density import Misses, components_in, objects_in
from optipmb.model.tracks import tracks_in

if TYPE_CHECKING:
    from optipmb.model.rows import Rows

RECORDS = pytest.mark.parametrize("record", [optipmb.Bernoullis, optipmb.Poissons, Misses, optipmb.Tracks])


def random_columns(record: type[Rows], count: int) -> dict[str, Any]:
    """Columns of so many rows."""
    rng = np.random.default_rng(count)
    columns: dict[str, Any] = {}
    for name, one in record.described.items():
        numbers = rng.normal(0, 1e6, (count, *one.shape))
        columns[name] = numbers > 0 if one.number == np.bool_ else numbers.astype(one.number)
    return columns


@RECORDS
@pytest.mark.parametrize("count", [0, 1, 7])
def test_columns_are_those_that_were_given(record: type[Rows], count: int) -> None:
    """Names, types, shapes and numbers, in pieces that nothing is left between; in copies too."""
    given = random_columns(record, count)
    rows = record(**given)
    for one in (rows, copy.deepcopy(rows), rows.replaced(), rows.take(np.arange(count))):
        assert (len(one), one.words.size) == (count, count * record.width)
        assert [name for name, _ in one.columns()] == list(given)
        for name, column in one.columns():
            np.testing.assert_array_equal(column, given[name], strict=True)
            assert column.flags.c_contiguous or column.dtype == np.bool_
            assert column.flags.aligned
    assert len(record.empty()) == 0


@RECORDS
def test_a_column_is_a_view(record: type[Rows]) -> None:
    """A written column reads back, and no other column changes."""
    given = random_columns(record, 5)
    for name in given:
        rows = record(**given)
        getattr(rows, name)[2] = 1
        for other, column in rows.columns():
            wanted = given[other].copy()
            if other == name:
                wanted[2] = 1
            np.testing.assert_array_equal(column, wanted)


@pytest.mark.parametrize(
    ("record", "columns_in"),
    [(optipmb.Bernoullis, objects_in), (optipmb.Poissons, components_in), (optipmb.Tracks, tracks_in)],
)
@pytest.mark.parametrize("count", [0, 1, 7])
def test_kernels_read_the_columns_that_numpy_does(record: type[Rows], columns_in: Any, count: int) -> None:
    """The same names, types, shapes and numbers at the same places; a flag is an integer for kernels."""
    rows = record(**random_columns(record, count))
    found = columns_in(rows.words)
    assert found._fields == tuple(record.described)
    for (_, column), other in zip(rows.columns(), found, strict=True):
        wanted = column.astype(np.int64) if column.dtype == np.bool_ else column
        np.testing.assert_array_equal(other, wanted, strict=True)
        assert other.ctypes.data == column.ctypes.data or not count


@RECORDS
def test_what_does_not_fit_is_refused(record: type[Rows]) -> None:
    """A column that is missing, unknown, of another type or shape, longer than the others, or a list: it is named."""
    given = random_columns(record, 3)
    for name, column in given.items():
        broken = [
            column[:2],
            np.asarray(column[0]),
            column.tolist(),
            None,
            column[..., None],
            column.astype(np.float32),
        ]
        for values in broken:
            # The first column says how many rows there are: when it is short, the second is named.
            with pytest.raises(record.refused, match=rf"^{record.part}\."):
                record(**given | {name: values})
        with pytest.raises(record.refused, match=re.escape(f"{record.part}.{name}: expected")):
            record(**{other: values for other, values in given.items() if other != name})
    with pytest.raises(record.refused, match=r"expected the columns .*, received colour$"):
        record(**given, colour=np.zeros(3))
