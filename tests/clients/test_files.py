"""Text files of datasets and results: errors that name the place, and no half files."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from optipmb_tools.files import DatasetError, numbers, read_rows, write_whole


def test_a_number_that_is_none_is_named_with_its_line(tmp_path: Path) -> None:
    """The error carries path, line, the expected form and the found text."""
    path = tmp_path / "a.txt"
    path.write_text("1 2\n\n3 four\n")
    with pytest.raises(DatasetError) as caught:
        numbers(path, read_rows(path, "numbers"), 2, "two numbers")
    assert (caught.value.path, caught.value.line) == (str(path), 3)
    assert (caught.value.expected, caught.value.received) == ("a number", "'four'")
    assert str(caught.value) == f"{path}:3: expected a number, received 'four'"


@pytest.mark.parametrize(("text", "received"), [("1\n", "1 fields"), ("1 nan\n", "'nan'"), ("1 inf\n", "'inf'")])
def test_missing_fields_and_numbers_without_end_are_refused(tmp_path: Path, text: str, received: str) -> None:
    """A row has all its fields, and they are finite."""
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(DatasetError) as caught:
        numbers(path, read_rows(path, "numbers"), 2, "two numbers")
    assert (caught.value.line, caught.value.received) == (1, received)


def test_an_empty_file_is_a_table_without_rows(tmp_path: Path) -> None:
    """No lines, no rows, but the columns."""
    path = tmp_path / "a.txt"
    path.touch()
    assert numbers(path, read_rows(path, "numbers"), 5, "five").shape == (0, 5)


def test_a_missing_file_and_bytes_that_are_no_text_are_dataset_errors(tmp_path: Path) -> None:
    """Neither raises anything else, and the error names the file."""
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    for name in ("a.txt", "b.txt"):
        with pytest.raises(DatasetError, match=name):
            read_rows(tmp_path / name, "numbers")


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    """While it is written, and after an error, the old content stands; then the new one, and nothing else is left."""
    path = tmp_path / "out.txt"
    path.write_text("old")

    def parts(*, fail: bool) -> Iterator[str]:
        yield "half"
        assert path.read_text() == "old"
        if fail:
            raise ValueError("half")
        yield "new\n"

    with pytest.raises(ValueError, match="half"):
        write_whole(path, parts(fail=True))
    assert path.read_text() == "old"
    write_whole(path, parts(fail=False))
    assert path.read_text() == "halfnew\n"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.txt"]


def test_a_finished_file_is_as_readable_as_any_other(tmp_path: Path) -> None:
    """Its permissions equal an ordinary new file, not a private temporary one."""
    (tmp_path / "ordinary").touch()
    write_whole(tmp_path / "ours", b"")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "ordinary").stat().st_mode
