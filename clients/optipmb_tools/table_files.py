"""Tables on disk: CSV, Parquet, JSON Lines and Feather, read into columns and written from them.

The formats are pyarrow's, which is an extra of the installation and imported here alone. Lists and structures inside a
row become columns of their own: `center` with three numbers is `center.0`, `center.1`, `center.2`. JSON, and folders
with a file for each frame, are read as records, one for each box (`optipmb_tools.box_records`).
"""

import ast
import codecs
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from optipmb_tools.box_records import frame_files, is_kitti_object, read_frames, read_json, split_boxes
from optipmb_tools.extras import needed
from optipmb_tools.files import DatasetError, damage, decode_text, is_number, refuse_foreign, write_whole

if TYPE_CHECKING:
    import pyarrow as pa

Columns: TypeAlias = dict[str, NDArray[Any]]
"""By name, all of one length: float64 (NaN where no value is), int64 (none missing), datetime64[ns] or str."""

SUFFIXES: Final = (".csv", ".tsv", ".parquet", ".jsonl", ".ndjson", ".feather", ".arrow")
"""Formats that are read and written."""
NO_VALUE: Final = (
    *("", "NaN", "\\N", "?", "-", "--", ".", "*", "1.#QNAN", "1.#IND", "-1.#IND"),
    *(
        write(word)
        for word in ("nan", "na", "n/a", "n.a.", "#n/a", "<na>", "null", "none", "nil", "#value!", "#null!", "#div/0!")
        for write in (str.lower, str.upper, str.title)
    ),
)
"""Texts that stand for no value."""
_READ_ONLY: Final = (".json", ".txt")
_TEXT: Final = (".csv", ".tsv", ".txt")
_PICKLES: Final = (".pkl", ".pickle")
_COMPRESSED: Final = (".gz", ".bz2", ".zst")
_SEPARATORS: Final = ",;\t|"
_UNIT_WORDS: Final = {"", "-", "1", "m", "s", "ms", "us", "ns", "deg", "rad", "m/s", "rad/s", "deg/s", "%"}
_COMMENT: Final = re.compile(r"(?m)^(?:#|%|//).*\n?")
_MOST_PARTS: Final = 16
_EXACT: Final = 2**53  # integers up to it are exact as 64-bit numbers with a point
_INT64: Final = 2**63
_BLOCK: Final = 1 << 20  # characters of a text that are read at once
_ROWS: Final = 1 << 16  # of a text that are written at once
_PART: Final = 1 << 20  # texts that are compared at once: an array of pyarrow holds 2 GB of them
_LONGEST_LINE: Final = 1 << 25  # bytes of a line of JSON that pyarrow reads; longer ones are read one by one
_OWN: Final = {".parquet": (b"par1",), ".feather": (b"arrow1", b"feather"), ".arrow": (b"arrow1", b"feather")}
_OWN_COMPRESSED: Final = (b"\x1f\x8b", b"\x28\xb5\x2f\xfd")
_DATE: Final = re.compile(
    r"(\d{4}([-/])\d\d?\2\d\d?|\d\d?([-/.])\d\d?\3\d{4})[T ]+\d\d?:\d\d[:.,\d]*( ?UTC|(Z|[-+]\d\d(:?\d\d)?))?"
)
_BASIC: Final = re.compile(r"^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)(?=\D|$)")  # of ISO 8601
_DAY_OR_MONTH: Final = re.compile(r"^(\d{1,2})([-/.])(\d{1,2})\2(\d{4})")
_ONE_DIGIT: Final = re.compile(r"(?<=[-T ])(\d)(?=[-T :])")
_MONTHS: Final = 12
_COMMA: Final = r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$"


def is_table(path: Path) -> bool:
    """Tell by its name whether a file is a table; CSV and JSON Lines may be compressed."""
    return _kind(path) in SUFFIXES


def is_text(path: Path) -> bool:
    """Tell by its name whether a table is written as text."""
    return _kind(path) in {*_TEXT, ".jsonl", ".ndjson"}


def tables_in(path: Path) -> list[Path]:
    """Return the tables that a file or folder is; a folder with a file for each frame is one table by itself."""
    if not path.is_dir():
        return [path] if _kind(path) in (*SUFFIXES, *_READ_ONLY, *_PICKLES) else []
    files = sorted(file for file in path.iterdir() if not file.name.startswith("."))
    tables = [file for file in files if is_table(file)]
    if tables or any(file.suffix == ".mcap" for file in files):
        return tables
    if frame_files(path):
        return [path]
    return files if all(file.suffix.lower() in _READ_ONLY for file in files) else []


def _kind(path: Path) -> str:
    name = path.name.lower()
    for ending in _COMPRESSED:
        if name.removesuffix(ending).endswith((".csv", ".tsv", ".jsonl", ".ndjson")):
            name = name.removesuffix(ending)
    return Path(name).suffix


def _pyarrow() -> Any:
    needed("tables", "table", "pyarrow", need="need")
    import pyarrow as pa  # noqa: PLC0415  packages of an extra

    pa.set_memory_pool(pa.system_memory_pool())  # the only one that gives memory back
    return pa


def read_table(path: Path, options: Mapping[str, str] | None = None) -> Columns:
    """Read a table into memory; a header alone gives columns without rows.

    Args:
        path: a file, or a folder with a file for each frame.
        options: of the user: `decimal` and `encoding` of text tables, `date`.

    Raises:
        DatasetError: There is no such file, or it is not of the format that its name says.
        ClientError: pyarrow is not installed.
    """
    pa = _pyarrow()
    kind, options = _kind(path), options or {}
    if not path.is_dir() and kind not in (*SUFFIXES, *_READ_ONLY, *_PICKLES):
        found = f"a file named *{kind}" if kind else "no suffix"
        raise DatasetError(path, f"a table ({', '.join((*SUFFIXES, *_READ_ONLY))})", found)
    columns: Columns = {}
    try:
        if not path.stat().st_size:
            raise DatasetError(path, "a table", "an empty file")
        if not path.is_dir():
            with path.open("rb") as file:
                own = _OWN_COMPRESSED if path.suffix.lower() in _COMPRESSED else _OWN.get(kind, ())
                refuse_foreign(path, f"a table ({kind})", file.read(64), *own)
        with damage(path, f"a table ({kind})"):
            table = _read(pa, path, kind, options)
            for name in table.column_names:
                column, table = table.column(0).combine_chunks(), table.remove_column(0)
                pa.default_memory_pool().release_unused()
                for part, values in _parts(pa, str(name), column):
                    if part in columns:
                        raise DatasetError(path, "every column once", f"{part!r} twice")
                    columns[part] = _dates(pa, path, part, values, options) if values.dtype.kind == "U" else values
    except OSError as error:  # pyarrow's errors of content are of this kind too
        found = "no such file" if isinstance(error, FileNotFoundError) else error.strerror or str(error)
        raise DatasetError(path, f"a table ({kind})", found) from error
    return columns


def _read(pa: Any, path: Path, kind: str, options: Mapping[str, str]) -> Any:
    if path.is_dir():
        return _rows(pa, read_frames(path, options))
    if kind in _TEXT:
        return _read_text(pa, path, kind, options)
    if kind == ".json":
        return _rows(pa, split_boxes(path, read_json(path), options))
    if kind in _PICKLES:
        from optipmb_tools.pickles import read_pickle  # noqa: PLC0415  of one format

        return _rows(pa, split_boxes(path, read_pickle(path), options))
    if kind in {".jsonl", ".ndjson"}:
        table = _read_lines(pa, path, options)
    elif kind == ".parquet":
        from pyarrow import parquet  # noqa: PLC0415  as above

        table = parquet.read_table(path)
    else:
        from pyarrow import feather  # noqa: PLC0415  as above

        table = feather.read_table(path)
    if any(_has_lists(pa, one.type) for one in table.schema):
        return _rows(pa, split_boxes(path, table.to_pylist(), options))
    return table


def _read_lines(pa: Any, path: Path, options: Mapping[str, str]) -> Any:
    """Return the table of JSON Lines; read one by one where pyarrow cannot, so that the wrong one is named."""
    from pyarrow import json as arrow_json  # noqa: PLC0415  packages of an extra

    text = _text(path, options)
    try:
        read = arrow_json.ReadOptions(block_size=_LONGEST_LINE)
        table = arrow_json.read_json(io.BytesIO(text.encode()), read_options=read)
    except pa.ArrowInvalid:
        table = None
    if table is not None and not _rounded(pa, table):
        return table
    records = []
    for number, line in enumerate(text.split("\n"), start=1):
        if line.strip():
            try:
                record = json.loads(line)
            except json.JSONDecodeError as error:
                raise DatasetError(path, "an object of JSON in every line", error.msg, line=number) from error
            if not isinstance(record, dict):
                raise DatasetError(path, "an object of JSON in every line", repr(line[:60]), line=number)
            records.append(record)
    return _rows(pa, split_boxes(path, records, options))


def _rounded(pa: Any, table: Any) -> list[str]:
    """Return the columns whose integers may have lost digits, as pyarrow reads those beyond 64 bits with a point."""
    import pyarrow.compute as pc  # noqa: PLC0415  packages of an extra

    names = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    return [name for name in names if (pc.max(pc.abs(table[name])).as_py() or 0.0) >= _INT64]


def _text(path: Path, options: Mapping[str, str]) -> str:
    """Return the text of a file in the encoding that the user or its first bytes say; UTF-8 otherwise."""
    with _pyarrow().input_stream(path) as stream:
        data = bytes(stream.read())
    expected = "text in UTF-8 (--option encoding=latin-1, cp1252, gbk or utf-16-le reads others)"
    return re.sub(r"\Asep=.(?=\n)", "", decode_text(path, data, expected, options.get("encoding")))


def _blocks(path: Path, options: Mapping[str, str]) -> Iterator[str]:
    """Yield `_text` in blocks of whole lines, so that the text of a long table is never in memory as a whole."""
    encoding = options.get("encoding", "utf-8-sig")
    try:
        with _pyarrow().input_stream(path) as stream:
            if stream.read(2) in {codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE} and "encoding" not in options:
                encoding = "utf-16"
        with _pyarrow().input_stream(path) as stream:
            lines = io.TextIOWrapper(io.BufferedReader(stream), encoding, newline=None)
            while block := "".join(lines.readlines(_BLOCK)):
                if "\0" in block and encoding == "utf-8-sig":
                    _text(path, options)
                yield block
    except (ValueError, LookupError):
        _text(path, options)  # raises with the line
        raise


class _Blocks(io.RawIOBase):
    """File of the bytes of some texts."""

    def __init__(self, texts: Iterator[str]) -> None:
        self._texts = texts
        self._rest = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._rest:
            text = next(self._texts, None)
            if text is None:
                return 0
            self._rest = memoryview(text.encode())
        count = min(len(buffer), len(self._rest))
        buffer[:count], self._rest = self._rest[:count], self._rest[count:]
        return count


def line_of(path: Path, row: int, options: Mapping[str, str] | None = None) -> int:
    """Return the line, from 1, of a row of a text table, or the row, from 1, of another table."""
    if path.is_dir() or _kind(path) not in _TEXT:
        return row + 1
    lines = _text(path, options or {}).split("\n")
    filled = [number for number, line in enumerate(lines, start=1) if line.strip() and not _COMMENT.match(line)]
    first = _titles([lines[number - 1] for number in filled[:_MOST_PARTS]])
    named = _has_names(re.split(r"[,;\s]+", lines[filled[first] - 1].strip()))
    measured = filled[first + 1 :] and _are_units(re.split(r"[,;|\t]", lines[filled[first + 1] - 1]))
    return filled[first + row + named + bool(measured)]


def _titles(lines: Sequence[str]) -> int:
    """Return how many of the first lines of a table stand before the one with the names of the columns."""
    for place, line in enumerate(lines):
        for mark in _SEPARATORS:
            fields = line.split(mark)
            named = all(re.match(r"[\s\"']*([A-Za-z_]|$)", field) for field in fields)
            if line.count(mark) > 1 and named:  # a title may have a comma
                return 0 if any(one.count(mark) >= line.count(mark) for one in lines[:place]) else place
    return 0


def _with_units(head: str, rest: str, separator: str) -> tuple[str, str]:
    """Return the names of columns with the units that a row below them has, and the text after that row."""
    first, _, after = rest.partition("\n")
    if '"' in head or not _are_units(units := first.split(separator)):
        return head, rest
    pairs = zip(head.split(separator), (unit.strip(" []()-") for unit in units), strict=False)
    return separator.join(f"{name} [{unit}]" if unit else name for name, unit in pairs), after


def _are_units(fields: Sequence[str]) -> bool:
    """Tell whether a row below the names of columns has their units."""
    units = {field.strip(' []()"') for field in fields}
    return units <= _UNIT_WORDS and bool(units - {"", "-"})


def _has_names(fields: list[str]) -> bool:
    return 2 * sum(is_number(one.strip().strip('"')) for one in fields) < len(fields)


def _normal_text(path: Path, blocks: Iterator[str], kind: str) -> tuple[Iterator[str], str]:
    """Return the blocks of a text table without comments and with as many names as columns, and its separator."""
    original = text = ""
    for block in blocks:
        original += block
        text = _without_comments(original).lstrip("\n")
        if text:
            break
    lines = re.sub(r"\Asep=.\n", "", text).lstrip("\n").split("\n", _MOST_PARTS)
    head, rest = (lines := lines[_titles(lines[:_MOST_PARTS]) :])[0], "\n".join(lines[1:])
    comments = [line.lstrip("#%/ ") for line in original.split("\n", _MOST_PARTS) if _COMMENT.match(line)]
    separator = "\t" if kind == ".tsv" else max(_SEPARATORS, key=head.count)
    if separator not in head and len(head.split()) > 1:
        separator = " "
        head, rest = map(_with_single_blanks, (head, rest))
        comments = [" ".join(line.split()) for line in comments]
    if known := _benchmark(head):
        raise DatasetError(path, "a table", known)
    if not _has_names(head.split(separator)):  # numpy writes the names of the columns into a comment
        names = [line for line in comments if line.count(separator) == head.count(separator)]
        if not names:
            raise DatasetError(path, "a first line with the names of the columns", repr(head.strip()[:60]))
        head, rest = names[-1], f"{head}\n{rest}"
    head, rest = _with_units(head, rest, separator)
    head = _with_all_names(head, rest.split("\n", 1)[0].rstrip(), separator)
    more_blocks = map(_without_comments, blocks)
    if separator == " ":
        more_blocks = map(_with_single_blanks, more_blocks)
    return chain([f"{head}\n{rest}"], more_blocks), separator


def _with_all_names(head: str, first: str, separator: str) -> str:
    """Return the names of columns, as many as the first row has fields."""
    more = first.count(separator) - head.count(separator)
    if more == 1 and first.endswith(separator):
        return head + separator
    if more == 1:  # R writes the names of the rows without a title
        return f"row{separator}{head}"
    return head.removesuffix(separator) if more == -1 else head


def _without_comments(text: str) -> str:
    return _COMMENT.sub("", text) if any(mark in text for mark in ("#", "%", "//")) else text


def _with_single_blanks(text: str) -> str:
    return re.sub(r"(?m)^ +| +$", "", re.sub(r"[ \t]+", " ", text))


def _benchmark(line: str) -> str | None:
    """Return what a first line without names of columns is in the format of a benchmark."""
    fields = re.split(r"[,;\s]+", line.strip(" \t,;"))
    numeric = [is_number(one) for one in fields]
    if is_kitti_object(line):
        return "boxes of a frame as in KITTI's object benchmark: name their folder"
    if len(fields) in {17, 18} and numeric[:3] == [True, True, False] and all(numeric[3:]):
        return "labels or results of KITTI's tracking benchmark: --dataset kitti reads a folder of it"
    if len(fields) == 15 and all(numeric):  # noqa: PLR2004  fields of a detection
        return "detections for KITTI's tracking benchmark: --dataset kitti reads a folder of it"
    if len(fields) in {5, 6} and all(numeric) and all(0.0 <= float(one) <= 1.0 for one in fields[1:]):
        way = "join them to a table frame,class,xc,yc,w,h,score, which --camera and --option box=cxcywh read"
        return f"boxes of YOLO, as shares of the image: {way}"
    counted = all(one.isdigit() for one in fields[:2]) or fields[7:] == ["-1"] * 3
    if len(fields) in {9, 10} and counted and fields[0].isdigit() and all(numeric):
        way = "a first line frame,id,x,y,w,h,score,class and --camera place them on the ground"
        return f"image boxes as of MOTChallenge, which have no place in the world; {way}"
    return None


def _read_text(pa: Any, path: Path, kind: str, options: Mapping[str, str]) -> Any:
    from pyarrow import csv  # noqa: PLC0415  packages of an extra

    ragged: list[Any] = []
    attributes = [name.strip() for name in options.get("attributes", "").split(",")]  # texts, with their first zeros

    def keep(row: Any) -> str:
        ragged.append(row)
        return "error"

    def parsed(decimal: str, *texts: str, threads: bool = True) -> Any:
        blocks, separator = _normal_text(path, _blocks(path, options), kind)
        null = list(NO_VALUE)
        types = dict.fromkeys((*texts, *attributes), pa.string())
        convert = csv.ConvertOptions(
            null_values=null, strings_can_be_null=True, decimal_point=decimal, column_types=types
        )
        parse, read = csv.ParseOptions(delimiter=separator), csv.ReadOptions(use_threads=threads)
        if not threads:
            parse.invalid_row_handler = keep
        data = io.BufferedReader(_Blocks(blocks), _BLOCK)
        return csv.read_csv(data, parse_options=parse, convert_options=convert, read_options=read)

    decimal = options.get("decimal")
    if decimal not in {None, ",", "."}:
        raise DatasetError("--option decimal", "a comma or a point", repr(decimal))
    try:
        table = parsed(decimal or ".")
    except pa.ArrowInvalid:
        table = _again(path, partial(parsed, decimal or ".", threads=False), ragged, options)
    names = [name for name in table.column_names if name]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(path, "every column once", f"{twice[0]!r} twice")
    if decimal is None and _has_commas(pa, path, table):
        table = parsed(",")
    if rounded := _rounded(pa, table):
        table = _with_digits(table, parsed(".", *rounded), rounded)
    places = enumerate(table.column_names)  # a separator at the end of the lines gives one without name and values
    return table.select([place for place, name in places if name or table.column(place).null_count < len(table)])


def _again(path: Path, read: Callable[[], Any], ragged: Sequence[Any], options: Mapping[str, str]) -> Any:
    """Read a table again on one thread, which tells the number of the row that cannot be read."""
    try:
        return read()
    except ValueError as error:  # of pyarrow
        if not ragged:
            raise
        row = ragged[0]
        expected = f"{row.expected_columns} fields in each row, as many as names"
        line = line_of(path, row.number - 2, options)  # counted from 1, with the line of names
        raise DatasetError(path, expected, f"{row.actual_columns}: {row.text.strip()[:60]!r}", line=line) from error


def _with_digits(table: Any, texts: Any, names: Sequence[str]) -> Any:
    """Return a table with texts in place of integers that have lost digits."""
    import pyarrow.compute as pc  # noqa: PLC0415  packages of an extra

    for name in names:
        if pc.all(pc.match_substring_regex(texts[name], r"^\s*-?\d+\s*$")).as_py():
            table = table.set_column(table.column_names.index(name), name, texts[name])
    return table


def _has_commas(pa: Any, path: Path, table: Any) -> bool:
    """Tell whether the numbers of a table have a decimal comma; refuse one where only some have."""
    import pyarrow.compute as pc  # noqa: PLC0415  packages of an extra

    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    commas = [name for name in texts if pc.all(pc.match_substring_regex(table[name], _COMMA)).as_py()]
    points = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    if commas and points:
        expected = "decimal points or commas (--option decimal=. or decimal=, says which)"
        raise DatasetError(path, expected, f"commas in column {commas[0]}, points in column {points[0]}")
    return bool(commas)


def _dates(pa: Any, path: Path, name: str, texts: NDArray[Any], options: Mapping[str, str]) -> NDArray[Any]:
    """Return a column of dates with a time of day as such, and other texts as they are."""
    if _BASIC.match(next((text for text in texts.tolist() if text), "")):
        texts = np.array([_BASIC.sub(r"\1-\2-\3T\4:\5:\6", text) for text in texts.tolist()], dtype=np.str_)
    first = next((text for text in unique_texts(texts)[0].tolist() if text), "").strip()
    date = _DATE.fullmatch(first)
    if date is None:
        return texts
    unique, place = unique_texts(texts)
    found = [text.strip() for text in unique.tolist()]
    order = _order_of_days(path, name, found, options)
    days = [_DAY_OR_MONTH.sub(order, text.removesuffix("UTC").strip()).replace("/", "-") for text in found]
    dates = [_ONE_DIGIT.sub(r"0\1", text.replace(",", ".")) or None for text in days]
    try:
        stamps = pa.array(dates).cast(pa.timestamp("ns", "UTC" if date[5] else None)).to_numpy(zero_copy_only=False)
    except pa.ArrowInvalid as error:
        wrong = next(number for number, text in enumerate(dates) if f"'{text}'" in str(error))
        expected = f"a date as YYYY-MM-DD HH:MM:SS.ffffff in column {name}, with a zone in all rows or in none"
        line = line_of(path, int(np.flatnonzero(place == wrong)[0]), options)
        raise DatasetError(path, expected, repr(found[wrong]), line=line) from error
    return np.asarray(stamps.astype("datetime64[ns]")[place])


def _order_of_days(path: Path, name: str, texts: list[str], options: Mapping[str, str]) -> str:
    """Return how a date as 03/01/2025 is written as 2025-01-03, as a replacement of `_DAY_OR_MONTH`."""
    orders = {"dmy": r"\4-\3-\1", "mdy": r"\4-\1-\3"}
    found = [match for match in map(_DAY_OR_MONTH.match, texts) if match is not None]
    first, second = (any(int(match[place]) > _MONTHS for match in found) for place in (1, 3))
    order = options.get("date", "dmy" if not found or first or found[0][2] == "." else "mdy" if second else "")
    if order not in orders:
        expected = "dates as YYYY-MM-DD, or --option date=dmy (day first) or date=mdy"
        raise DatasetError(path, expected, repr(options.get("date", texts[-1])) + f" for column {name}")
    return orders[order]


def _rows(pa: Any, records: list[dict[str, Any]]) -> Any:
    """Return records as a table; values of several types as text, so that the first wrong one can be named."""
    columns = {}
    for name in dict.fromkeys(name for one in records for name in one):
        values = [one.get(name) for one in records]
        try:
            columns[name] = pa.array(values)
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
            columns[name] = pa.array([None if value is None else str(value) for value in values])
    return pa.table(columns)


def _is_list(pa: Any, kind: Any) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _has_lists(pa: Any, kind: Any) -> bool:
    """Tell whether values hold lists of structures or of lists."""
    if _is_list(pa, kind):
        return bool(pa.types.is_nested(kind.value_type))
    return bool(pa.types.is_struct(kind)) and any(_has_lists(pa, one.type) for one in kind)


def _parts(pa: Any, name: str, column: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Give a column as arrays of numpy, one for each number of a list and each field of a structure."""
    kind = column.type
    types = pa.types
    if types.is_dictionary(kind):
        column, kind = column.dictionary_decode(), kind.value_type
    if types.is_struct(kind):
        for field, child in zip(kind, column.flatten(), strict=True):
            yield from _parts(pa, f"{name}.{field.name}", child)
    elif (
        _is_list(pa, kind)
        and len(lengths := {len(row) for row in column if row.is_valid}) == 1
        and max(lengths) <= _MOST_PARTS
    ):
        rows = column.to_pylist()
        for place in range(max(lengths)):
            child = pa.array([None if row is None else row[place] for row in rows])
            yield from _parts(pa, name if max(lengths) == 1 else f"{name}.{place}", child)
    elif types.is_timestamp(kind):
        yield name, column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False).astype("datetime64[ns]")
    elif types.is_integer(kind) or (types.is_decimal(kind) and not kind.scale):
        yield name, _integers(pa, column)
    elif types.is_floating(kind) or types.is_decimal(kind) or types.is_null(kind):
        yield name, column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    elif types.is_binary(kind) or types.is_large_binary(kind):
        yield from _parts(pa, name, column.cast(pa.string()))
    else:
        texts = _texts(pa, column)
        lists = _written(pa, texts) if types.is_string(kind) or types.is_large_string(kind) else None
        yield from [(name, texts)] if lists is None else _parts(pa, name, lists)


def _written(pa: Any, texts: NDArray[np.str_]) -> Any:
    """Return the lists or structures that all texts of a column are, as data frames write them; None for others."""
    first = next((text for text in texts.tolist() if text), "").strip()
    if not re.fullmatch(r"(?s)\[.*\]|\(.*\)|\{.*\}", first):
        return None
    try:
        found = pa.array([_literal(text) if text else None for text in texts.tolist()])
    except (ValueError, SyntaxError, RecursionError, MemoryError, OverflowError, pa.ArrowException):
        return None
    return found if pa.types.is_nested(found.type) else None


def _literal(text: str) -> Any:
    """Return what a text in the notation of JSON, Python or numpy stands for."""
    inner = text.strip().strip("[]()").replace(",", " ").split()
    if all(map(is_number, inner)):
        return [float(one) for one in inner]
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return ast.literal_eval(text)


def _texts(pa: Any, column: Any) -> NDArray[np.str_]:
    """Return values as texts, none as an empty one."""
    if not pa.types.is_string(column.type):
        return np.array(["" if value is None else str(value) for value in column.to_pylist()], dtype=np.str_)
    column.validate(full=True)  # offsets of a damaged file are read without a check otherwise
    coded = column.dictionary_encode()
    texts = np.array([*coded.dictionary.to_pylist(), ""], dtype=np.str_)
    return np.asarray(texts[coded.indices.fill_null(len(texts) - 1).to_numpy(zero_copy_only=False)])


def unique_texts(texts: NDArray[np.str_]) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    """Return the different ones of some texts (R,), in the order of their first rows, and the place (R,) of each."""
    pa = _pyarrow()
    if not len(texts):
        return texts, np.zeros(0, dtype=np.int64)
    parts = np.array_split(texts, 1 + len(texts) // _PART)
    coded = pa.chunked_array([pa.array(part) for part in parts], pa.string()).dictionary_encode().unify_dictionaries()
    places = np.concatenate([one.indices.to_numpy() for one in coded.chunks])
    return np.array(coded.chunk(0).dictionary.to_pylist(), dtype=texts.dtype), places.astype(np.int64)


def _integers(pa: Any, column: Any) -> NDArray[Any]:
    """Return integers as such; with missing ones, as float64 where that is exact; others as text."""
    import pyarrow.compute as pc  # noqa: PLC0415  packages of an extra

    low, high = (value or 0 for value in pc.min_max(column).as_py().values())
    if not column.null_count and -_INT64 <= low <= high < _INT64:
        return np.asarray(column.cast(pa.int64()).to_numpy(zero_copy_only=False), dtype=np.int64)
    if -_EXACT <= low <= high <= _EXACT:
        return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False))
    return _texts(pa, column)


def to_arrow(columns: Mapping[str, NDArray[Any]]) -> "pa.Table":
    """Return columns as a table of pyarrow; NaN becomes no value.

    Raises:
        ClientError: pyarrow is not installed.
    """
    pa = _pyarrow()
    return pa.table({name: pa.array(values, from_pandas=values.dtype.kind == "f") for name, values in columns.items()})


def joined(blocks: Iterable[Columns]) -> Columns:
    """Return the columns of blocks of rows, one below the other."""
    parts: dict[str, list[NDArray[Any]]] = {}
    for block in blocks:
        for name, values in block.items():
            parts.setdefault(name, []).append(values)
    return {name: np.concatenate(parts.pop(name)) for name in list(parts)}


def write_table(path: Path, columns: Columns) -> None:
    """Write a table as `write_blocks` does."""
    write_blocks(path, lambda: [columns])


def write_blocks(path: Path, blocks: Callable[[], Iterable[Columns]]) -> None:
    """Write a table in the format that its name says; it appears complete, or not at all. NaN is written as no value.

    Args:
        path: The file.
        blocks: Gives the rows in blocks with the same columns; of CSV no more than one is in memory.

    Raises:
        DatasetError: The name says no format that can be written.
        ClientError: pyarrow is not installed.
    """
    pa = _pyarrow()
    kind = path.suffix.lower()
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind in {".csv", ".tsv"}:
        separator = "\t" if kind == ".tsv" else ","
        try:
            write_whole(path, _csv_parts(blocks(), separator, "none"))
        except pa.ArrowInvalid:  # a text has a separator, a quote or the end of a line
            write_whole(path, _csv_parts(blocks(), separator, "needed"))
        return
    columns = joined(blocks())
    if kind in {".jsonl", ".ndjson"}:  # dates as text
        columns = {name: one.astype(np.str_) if one.dtype.kind == "M" else one for name, one in columns.items()}
    table = to_arrow(columns)
    content: Any = io.BytesIO()
    if kind in {".jsonl", ".ndjson"}:
        content.write("".join(json.dumps(row) + "\n" for row in table.to_pylist()).encode())
    elif kind == ".parquet":
        from pyarrow import parquet  # noqa: PLC0415  as above

        parquet.write_table(table, content)
    elif kind in {".feather", ".arrow"}:
        from pyarrow import feather  # noqa: PLC0415  as above

        feather.write_feather(table, content)
    else:
        raise DatasetError(path, f"a table ({', '.join(SUFFIXES)})", f"a file named *{kind}")
    write_whole(path, content.getbuffer())


def _csv_parts(blocks: Iterable[Columns], separator: str, style: str) -> Iterator[str | bytes]:
    """Yield the line of names, and the rows in parts: the text of a long table is never in memory as a whole."""
    from pyarrow import csv  # noqa: PLC0415  packages of an extra

    options = csv.WriteOptions(include_header=False, delimiter=separator, quoting_style=style)
    for number, columns in enumerate(blocks):
        if number == 0:  # releases of pyarrow differ in the line of names; "needed" quotes every text
            yield separator.join(f'"{name}"' if style == "needed" else name for name in columns) + "\n"
        for start in range(0, len(next(iter(columns.values()), ())), _ROWS):
            part = io.BytesIO()
            csv.write_csv(to_arrow({name: one[start : start + _ROWS] for name, one in columns.items()}), part, options)
            yield part.getvalue()
