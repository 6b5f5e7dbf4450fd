"""Damaged report.json files: Report.load returns a report that can be written again, or raises a short DataError."""

import dataclasses
import json

import pytest
from hypothesis import given

from tests.fuzzing import changes_of_entries, damaged, few, many, outcome, text_damages, with_changed_entries
from tests.residuals.report.made_up_reports import few_pictures, narrow, trace, windowed
from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals import Report

ONE_OF_EACH = {"trace": narrow(trace(rows=20), 1), "windows": windowed().windows[:1]}  # as pictures take long
ENTRIES = dataclasses.replace(windowed(), **ONE_OF_EACH).to_json()
FEW_PICTURES = few_pictures(windowed()).to_json()
TEXT = json.dumps(ENTRIES).encode()


def assert_read_or_refused(folder, content):
    path = folder / "report.json"
    path.write_bytes(content)
    report = outcome(Report.load, path)
    if report is not None:
        assert all(isinstance(effect, Effect) for effect in report.effects)
        json.dumps(report.to_json(), allow_nan=False)
        assert isinstance(report.recommended, bool)
        assert isinstance(report.sentence(), str)
        saved = report.save(folder / "again")
        assert Report.load(saved).to_json() == report.to_json()


@few
@given(changes=changes_of_entries)
def test_a_report_with_changed_entries(tmp_path_factory, changes):
    content = json.dumps(with_changed_entries(FEW_PICTURES, changes)).encode()
    assert_read_or_refused(tmp_path_factory.getbasetemp(), content)


@pytest.mark.slow
@many
@given(changes=changes_of_entries)
def test_many_reports_with_changed_entries(tmp_path_factory, changes):
    content = json.dumps(with_changed_entries(ENTRIES, changes)).encode()
    assert_read_or_refused(tmp_path_factory.getbasetemp(), content)


@pytest.mark.slow
@many
@given(changes=text_damages)
def test_many_damaged_reports(tmp_path_factory, changes):
    assert_read_or_refused(tmp_path_factory.getbasetemp(), damaged(TEXT, changes))
