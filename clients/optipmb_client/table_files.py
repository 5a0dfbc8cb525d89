"""Tables on disk: CSV, Parquet, JSON Lines and Feather, read into columns and written from them.

The formats are pyarrow's, which is an extra of the installation and imported here alone. Lists and structures inside a
row become columns of their own: `center` with three numbers is `center.0`, `center.1`, `center.2`.
"""

import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from optipmb_schemas.installation import install_command

from optipmb_client.errors import ClientError
from optipmb_client.files import AtomicText, DatasetError

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["SUFFIXES", "Columns", "is_table", "read_table", "to_arrow", "write_table"]

Columns: TypeAlias = dict[str, NDArray[Any]]
"""By name, all of one length: float64 (NaN where no value is), int64 (none missing), datetime64[ns] or str."""

SUFFIXES: Final = (".csv", ".tsv", ".parquet", ".jsonl", ".ndjson", ".feather", ".arrow")
_COMPRESSED: Final = (".gz", ".bz2", ".zst")
_SEPARATORS: Final = ",;\t"
_MOST_PARTS: Final = 16


def is_table(path: Path) -> bool:
    """Tell by its name whether a file is a table; CSV and JSON Lines may be compressed."""
    return _kind(path) in SUFFIXES


def _kind(path: Path) -> str:
    name = path.name.lower()
    for ending in _COMPRESSED:
        if name.removesuffix(ending).endswith((".csv", ".tsv", ".jsonl", ".ndjson")):
            name = name.removesuffix(ending)
    return Path(name).suffix


def _pyarrow() -> Any:
    try:
        import pyarrow as pa  # noqa: PLC0415  packages of an extra
    except ImportError as error:
        raise ClientError(f"tables need pyarrow, which is not installed: {install_command('table')}") from error
    return pa


def read_table(path: Path) -> Columns:
    """Read a table into memory.

    Raises:
        DatasetError: there is no such file, or it is not of the format that its name says; says which.
        ClientError: pyarrow is not installed.
    """
    pa = _pyarrow()
    kind = _kind(path)
    if kind not in SUFFIXES:
        raise DatasetError(path, f"a table ({', '.join(SUFFIXES)})", f"a file named *{kind}" if kind else "no suffix")
    try:
        if not path.stat().st_size:
            raise DatasetError(path, "a table", "an empty file")
        table = _read(pa, path, kind)
    except OSError as error:  # pyarrow's errors of content are of this kind too
        raise DatasetError(path, f"a table ({kind})", error.strerror or str(error)) from error
    except (pa.ArrowException, UnicodeDecodeError) as error:
        raise DatasetError(path, f"a table ({kind})", str(error)) from error
    columns: Columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        for part, values in _parts(pa, str(name), column.combine_chunks()):
            if part in columns:
                raise DatasetError(path, "every column once", f"{part!r} twice")
            columns[part] = values
    return columns


def _read(pa: Any, path: Path, kind: str) -> Any:
    if kind in {".csv", ".tsv"}:
        from pyarrow import csv  # noqa: PLC0415  as above

        with pa.input_stream(path) as stream:
            data = stream.read()
        head = data[: data.find(b"\n") + 1 or len(data)].decode("utf-8-sig")
        separator = "\t" if kind == ".tsv" else max(_SEPARATORS, key=head.count)
        if all(_is_number(name) for name in head.strip().split(separator)):
            raise DatasetError(path, "a first line with the names of the columns", repr(head.strip()[:60]))
        options = csv.ConvertOptions(null_values=["", "nan", "NaN", "NA", "null", "None"], strings_can_be_null=True)
        parse = csv.ParseOptions(delimiter=separator)
        return csv.read_csv(io.BytesIO(data), parse_options=parse, convert_options=options)
    if kind in {".jsonl", ".ndjson"}:
        from pyarrow import json as arrow_json  # noqa: PLC0415  as above

        with pa.input_stream(path) as stream:
            return arrow_json.read_json(stream)
    if kind == ".parquet":
        from pyarrow import parquet  # noqa: PLC0415  as above

        return parquet.read_table(path)
    from pyarrow import feather  # noqa: PLC0415  as above

    return feather.read_table(path)


def _is_number(text: str) -> bool:
    try:
        float(text.strip().strip('"'))
    except ValueError:
        return False
    return True


def _parts(pa: Any, name: str, column: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Give a column as arrays of numpy, one for each number of a list and each field of a structure."""
    kind = column.type
    types = pa.types
    if types.is_dictionary(kind):
        column, kind = column.dictionary_decode(), kind.value_type
    if types.is_struct(kind):
        for field, child in zip(kind, column.flatten(), strict=True):
            yield from _parts(pa, f"{name}.{field.name}", child)
    elif types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        lengths = {len(row) for row in column if row.is_valid}
        if len(lengths) == 1 and (count := lengths.pop()) <= _MOST_PARTS:
            rows = column.to_pylist()
            for place in range(count):
                child = pa.array([None if row is None else row[place] for row in rows])
                yield from _parts(pa, f"{name}.{place}", child)
    elif types.is_timestamp(kind):
        yield name, column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False).astype("datetime64[ns]")
    elif types.is_integer(kind) and not column.null_count:
        yield name, column.to_numpy(zero_copy_only=False).astype(np.int64)
    elif types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind) or types.is_null(kind):
        yield name, column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    else:
        yield name, np.array(["" if value is None else str(value) for value in column.to_pylist()], dtype=np.str_)


def to_arrow(columns: Mapping[str, NDArray[Any]]) -> "pa.Table":
    """Return columns as a table of pyarrow; NaN becomes no value.

    Raises:
        ClientError: pyarrow is not installed.
    """
    pa = _pyarrow()
    return pa.table({name: pa.array(values, from_pandas=values.dtype.kind == "f") for name, values in columns.items()})


def write_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table in the format that its name says; it appears complete, or not at all. NaN is written as no value.

    Raises:
        DatasetError: the name says no format that can be written.
        ClientError: pyarrow is not installed.
    """
    table, kind = to_arrow(columns), path.suffix.lower()
    path.parent.mkdir(parents=True, exist_ok=True)
    content: Any = io.BytesIO()
    if kind in {".csv", ".tsv"}:
        from pyarrow import csv  # noqa: PLC0415  packages of an extra

        separator = "\t" if kind == ".tsv" else ","
        texts = [name for name, values in columns.items() if values.dtype.kind == "U"]
        special = any(
            mark in text for name in texts for text in np.unique(columns[name]) for mark in (separator, '"', "\n")
        )
        style = "needed" if special else "none"  # "needed" quotes every text
        csv.write_csv(table, content, csv.WriteOptions(delimiter=separator, quoting_style=style, quoting_header=style))
    elif kind in {".jsonl", ".ndjson"}:
        content.write("".join(json.dumps(row) + "\n" for row in table.to_pylist()).encode())
    elif kind == ".parquet":
        from pyarrow import parquet  # noqa: PLC0415  as above

        parquet.write_table(table, content)
    elif kind in {".feather", ".arrow"}:
        from pyarrow import feather  # noqa: PLC0415  as above

        feather.write_feather(table, content)
    else:
        raise DatasetError(path, f"a table ({', '.join(SUFFIXES)})", f"a file named *{kind}")
    file = AtomicText(path)
    try:
        file.write_bytes(content.getvalue())
        file.close()
    finally:
        file.discard()
