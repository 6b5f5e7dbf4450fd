"""Reports on a full disk: the earlier files stay."""

import pytest

from tests.full_disk import full_disk
from tests.residuals.report.made_up_reports import full_report, nothing_missing
from torchrl_h2o.residuals.report.atomic import write_text


def test_a_full_disk_leaves_the_earlier_report(tmp_path):
    nothing_missing().save(tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with full_disk(), pytest.raises(OSError, match="too large"):
        full_report().save(tmp_path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_a_file_is_replaced(tmp_path):
    path = write_text(tmp_path / "new" / "a.txt", "one")
    assert write_text(path, "größer").read_text(encoding="utf-8") == "größer"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]
