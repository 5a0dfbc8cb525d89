"""Text files of datasets and results: errors that name the place, and no half files."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from optipmb_tools.files import DatasetError, numbers, read_rows, write_whole


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ("3 four", "expected a number, received 'four'"),
        ("3", "(two numbers), received 1 fields"),
        ("3 nan", "received 'nan'"),
        ("3 inf", "received 'inf'"),
    ],
)
def test_a_row_that_is_none_is_named_with_its_line(tmp_path: Path, row: str, text: str) -> None:
    """The error carries path, line, the expected form and the found text; a file without rows is no error."""
    path = tmp_path / "a.txt"
    path.write_text(f"1 2\n\n{row}\n")
    with pytest.raises(DatasetError) as caught:
        numbers(path, read_rows(path, "numbers"), 2, "two numbers")
    assert str(caught.value).startswith(f"{path}:3: expected ")
    assert str(caught.value).endswith(text)
    path.write_text("")
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
