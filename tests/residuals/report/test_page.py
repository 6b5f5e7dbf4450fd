"""The report as a page: complete, escaped, and without external resources."""

import dataclasses
import html
import math
import re
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.residuals.report.made_up_reports import (
    few_pictures,
    full_report,
    narrow,
    no_conclusion,
    nothing_missing,
    renamed,
    trace,
    windowed,
)
from torchrl_h2o.effects import Gravity, JointForce, Payload
from torchrl_h2o.residuals.report import plots
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect, RejectedEffect
from torchrl_h2o.residuals.report.errors import (
    DimensionError,
    ErrorSummary,
    PredictedRow,
    Prediction,
    PredictionTable,
)
from torchrl_h2o.residuals.report.page import report_page
from torchrl_h2o.residuals.report.words import effect_units, effect_words

HOSTILE = "<script>alert(1)</script>\"'$x_1$&{{ 7 * 7 }}"


class Page(HTMLParser):
    """The tags of a page, their attributes, and its text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.open, self.texts = [], [], []
        self.feed(page)
        self.text = " ".join(" ".join(self.texts).split())

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in {"meta", "br"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)

    def count(self, tag):
        return sum(name == tag for name, _ in self.tags)


@cache
def page_of(make):
    """The page of a made-up report; the windows are drawn without the trace, as the full report has it."""
    return report_page(dataclasses.replace(make(), trace=None) if make is windowed else make())


@pytest.fixture(scope="module")
def full():
    return Page(page_of(full_report))


def test_the_page_opens_with_the_sentence(full):
    assert full.count("h1") == 1
    assert full.text.index(full_report().sentence()) < full.text.index("Effects that the simulator lacks")


def test_the_page_names_every_effect_that_was_tried(full):
    report = full_report()
    for tried in (*report.found, *report.rejected):
        assert tried.words in full.text
    for rejected in report.rejected:
        assert rejected.reason in full.text
    assert "actuators 0 × 0.83" in full.text
    assert "The option next of close-the-loop designs the log that tells them apart" in full.text


def test_the_page_shows_what_each_step_of_the_search_put_in_and_gained(full):
    for step in full_report().steps:
        assert all(words in full.text for words in (*step.put_in, *step.dropped))
        assert f"{step.gain:.2g}" in full.text


def test_the_page_compares_the_predictions_with_their_intervals(full):
    assert "velocities stay" in full.text
    assert "0.873 0.79 to 0.96" in full.text
    assert "0.0698 0.063 to 0.077" in full.text


def test_the_page_gives_values_with_units_and_intervals(full):
    assert "torque 0.0412 N·m between 0.0391 and 0.0433 N·m" in full.text
    assert "scale 0.5001 between 0.4991 and 0.5012" in full.text
    assert full.text.count("undeclared") == 1


def test_the_page_tells_of_the_data_and_of_the_test(full):
    report = full_report()
    for text in ("swing_up.csv", "5000", "1500", "left out: a gap in time", report.stop_test, "84.2 s"):
        assert text in full.text
    assert "14.2 s 14.9 s 70 38 a push from outside" in full.text


def test_every_dimension_is_drawn(full):
    # errors per unit, each dimension over horizons and over time, twelve pictures against states
    assert full.count("svg") == 2 + 4 + 4 + 12
    for name in full_report().trace.names:
        assert f"residual of {name} (" in full.text


def test_windows_are_drawn_with_units_and_their_errors():
    parsed = Page(page_of(windowed))
    assert parsed.count("svg") == 2 + 4 + 3 * 2
    assert "Measured against simulated, 0.1 s ahead" in parsed.text
    assert "Worst window: – → 0.1 σ" in parsed.text
    assert "from 2 s, row 100, run 1" in parsed.text
    assert "elbow velocity (rad/s)" in parsed.text


def test_the_error_of_each_run_is_a_table_with_the_worst_first():
    text = Page(page_of(windowed)).text
    assert text.index("1 1500 0.029") < text.index("0 3500 0.031")
    assert re.search(r"1 1500 0.029 \S+ 0.0041 \S+ −86 % held out", text)
    (only,) = windowed().runs[:1]
    assert "The error by run" not in Page(report_page(dataclasses.replace(few_pictures(windowed()), runs=(only,)))).text


def test_the_page_says_what_the_model_s_file_lacks():
    text = Page(page_of(windowed)).text
    assert "mended.xml holds gravity × 0.5, mass of bodies pole × 1.2." in text
    assert "dry friction of joints elbow + 0.0412 N·m MJCF has no such force" in text
    assert "Report.load(folder).mended(env)" in text


def test_every_error_has_a_unit(full):
    for error in (full_report().error, *full_report().found):
        value = getattr(error, "before", None) or error.error_after
        assert re.search(rf"{value:g} (σ|rad)", full.text), value


def test_units_are_those_of_the_joint():
    names = {"joints": ["rail"], "joint_bodies": ["cart"], "joint_types": ["slide"]}
    push = JointForce(6.72, "rail")
    found = FoundEffect(push, True, {"torque": (6.5, 6.9)}, 0.1, effect_words(push, names), effect_units(push, names))
    text = Page(report_page(dataclasses.replace(few_pictures(full_report()), found=(found,)))).text
    assert "constant force of 6.72 N on joints rail" in text
    assert "force 6.72 N between 6.5 and 6.9 N" in text


def test_attempts_of_no_size_are_left_out_of_the_ranking():
    nothing = RejectedEffect(Payload(1e-18, x=0.2), 0.01, 0.5, "explains no more than chance")
    report = few_pictures(full_report())
    text = Page(report_page(dataclasses.replace(report, rejected=(*report.rejected, nothing)))).text
    assert "payload" not in text


@pytest.mark.parametrize("make", [full_report, windowed, nothing_missing, no_conclusion])
def test_the_page_is_whole_and_asks_for_nothing(make):
    page = page_of(make)
    parsed = Page(page)
    assert not parsed.open
    assert {tag for tag, _ in parsed.tags}.isdisjoint({"script", "link", "iframe", "object", "embed", "base"})
    links = [attributes.get(key) for _, attributes in parsed.tags for key in ("src", "href", "xlink:href")]
    assert all(link.startswith(("#", "data:")) for link in links if link)
    assert "@import" not in page
    assert all(target.startswith(("#", "'#", '"#')) for target in re.findall(r"url\(([^)]*)", page))


@pytest.mark.filterwarnings("ignore:constrained_layout not applied")
def test_hostile_texts_are_shown_and_not_obeyed():
    report = dataclasses.replace(full_report(), trace=narrow(trace(), 2))
    page = report_page(renamed(report, HOSTILE))
    parsed = Page(page)
    assert not parsed.open
    assert parsed.count("script") == 0
    assert "<script" not in page
    for place in (f"against {HOSTILE}", f"left out: {HOSTILE}", f"{HOSTILE}elbow angle", f"{HOSTILE} (put in)"):
        assert place in parsed.text
    labels = [attributes["aria-label"] for tag, attributes in parsed.tags if tag == "svg"]
    assert any(HOSTILE in label for label in labels)


def test_a_name_in_a_picture_is_no_formula():
    made = dataclasses.replace(trace(rows=50), names=("$x_1$", "b", "c", "d"))
    assert ">residual of $x_1$ (rad)</text>" in plots.residual_in_time(made, 0)


@pytest.mark.parametrize("make", [nothing_missing, no_conclusion])
def test_a_page_without_effects_says_why_and_leaves_out_what_is_not_known(make):
    parsed = Page(page_of(make))
    assert make().sentence() in parsed.text
    assert parsed.count("svg") == 0
    for heading in ("Effects that the simulator lacks", "Effects tried", "Excluded intervals", "The residual"):
        assert heading not in parsed.text


def test_a_report_without_a_trace_has_no_residual_pictures():
    parsed = Page(report_page(dataclasses.replace(full_report(), trace=None)))
    assert "The residual over time" not in parsed.text
    assert "The error several steps ahead" in parsed.text


def test_numbers_that_are_not_known_are_dashes_on_the_page():
    dimensions = (DimensionError("v", "m/s", math.nan, math.inf), DimensionError("w", "m/s", 0.0, 0.0, 0.0))
    report = dataclasses.replace(
        few_pictures(full_report()),
        error=ErrorSummary("RMSE", "1", math.nan, math.nan, math.nan, dimensions),
        found=(FoundEffect(Gravity(2.0), True, {}, math.nan),),
        predictions=PredictionTable(0.1, (PredictedRow("total", *[Prediction(math.nan, math.nan, math.inf)] * 4),)),
        wall_s=None,
    )
    text = Page(report_page(report)).text
    assert "scale 2 not known" in text
    assert "Computed in" not in text
    assert not re.search(r"\b(nan|inf|None)\b", text)


def test_residuals_that_are_not_numbers_are_not_drawn():
    gappy = narrow(trace(rows=200), 2)
    gappy.before[:] = np.nan
    gappy.after[::2] = np.inf
    assert Page(report_page(dataclasses.replace(few_pictures(full_report()), trace=gappy))).count("svg") == 2 + 2 + 4


def test_the_same_report_gives_the_same_page():
    report = dataclasses.replace(few_pictures(full_report()), trace=narrow(trace(rows=50), 1))
    equal = report_page(report) == report_page(report)
    assert equal  # keeps pytest from printing a difference of a megabyte


def test_each_state_is_drawn_against_the_residual_that_depends_on_it():
    made = trace(rows=2000)
    rng = np.random.default_rng(0)
    made.before[:] = rng.normal(size=made.before.shape)
    made.states[:] = rng.normal(size=made.states.shape)
    made.before[:, 3] += 2.0 * made.states[:, 0] ** 2
    assert plots.telling_pairs(made, pictures=4)[0] == (3, 0)
    assert [state for _, state in plots.telling_pairs(made, pictures=4)] == [0, 1, 2, 3]


def test_what_was_set_aside_does_not_stretch_the_pictures():
    made, (pushed,) = trace(), full_report().unexplained_intervals

    def ticks(aside):
        svg = plots.residual_in_time(made, 2, aside)
        texts = [html.unescape(text).replace("−", "-") for text in re.findall(r"<text[^>]*>([^<]*)</text>", svg)]
        return [float(text) for text in texts if re.fullmatch(r"-0\.\d+", text)]

    assert min(ticks([pushed])) > -0.2 > min(ticks([]))


def test_a_long_name_of_the_source_is_kept_whole():
    source = "a" * 300
    report = dataclasses.replace(few_pictures(full_report()), data=DataSummary(source, 1, 1))
    assert source in Page(report_page(report)).text
