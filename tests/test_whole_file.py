"""Files that are written whole or not at all: on a full disk, after a kill, and by several processes."""

import os

import pytest

from tests.full_disk import full_disk
from tests.residuals.report.made_up_reports import full_report, nothing_missing
from torchrl_h2o.whole_file import remove_partial, write_text


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_a_full_disk_leaves_the_earlier_report(tmp_path):
    nothing_missing().save(tmp_path)
    before = contents(tmp_path)
    with full_disk(), pytest.raises(OSError, match="too large"):
        full_report().save(tmp_path)
    assert contents(tmp_path) == before


def test_a_file_is_replaced(tmp_path):
    path = write_text(tmp_path / "new" / "a.txt", "one")
    assert write_text(path, "größer").read_text(encoding="utf-8") == "größer"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]


def test_text_that_cannot_be_written_leaves_the_earlier_file_and_nothing_else(tmp_path):
    path = write_text(tmp_path / "a.csv", "earlier")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half \ud800")
    assert contents(tmp_path) == {"a.csv": b"earlier"}


LEFT = f"{'0a' * 16}.partial"


def test_the_next_writing_removes_what_a_killed_process_left_a_day_ago(tmp_path):
    old, new = tmp_path / f".a[1].{LEFT}.csv", tmp_path / f".b.{LEFT}.csv"
    for path in (old, new):
        path.write_text("half")
    os.utime(old, (0.0, 0.0))
    write_text(tmp_path / "a[1].csv", "whole")
    assert contents(tmp_path) == {"a[1].csv": b"whole", new.name: b"half"}  # another process may write the other one


def test_temporary_files_and_folders_are_removed_and_files_of_other_names_are_not(tmp_path):
    left = [tmp_path / f".summary.{LEFT}.json", tmp_path / "deep" / f".mended.{LEFT}" / "report.json"]
    kept = [tmp_path / ".my.partial", tmp_path / "a.partial.json", tmp_path / f"summary.{LEFT}.json"]
    for path in (*left, *kept):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("half")
    remove_partial(tmp_path)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(kept)
    assert not left[1].parent.exists()
