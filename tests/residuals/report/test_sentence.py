"""The sentence of a report."""

import dataclasses
import math

import pytest

from tests.residuals.report.made_up_reports import DATA, few_pictures, full_report, no_conclusion, nothing_missing
from torchrl_h2o.data.audit import Audit, Finding
from torchrl_h2o.effects import Gravity
from torchrl_h2o.residuals.progress import FORCES, NOISE, OTHERS
from torchrl_h2o.residuals.report.contents import NOTHING_MISSING, FoundEffect, OtherExplanation, Verdict
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.errors import ErrorSummary


def test_the_sentence_names_what_is_lacking_and_what_that_pays():
    found = FoundEffect(Gravity(0.500123), True, {}, 0.004)
    report = Report(simulator="a", data=DATA, error=ErrorSummary("RMSE", "rad/s", 0.031, 0.004, 0.003), found=(found,))
    assert report.sentence() == (
        "Your simulator lacks: gravity × 0.5; one-step error 0.031 → 0.004 rad/s (−87 %), floor 0.003."
    )


def test_the_sentence_names_a_group_as_a_group_and_marks_what_is_on_no_list():
    sentence = full_report().sentence()
    assert "These data cannot tell mass of bodies pole × 1.2 from actuators 0 × 0.83." in sentence
    assert "outside the catalogue: dry friction of joints elbow + 0.0412 N·m" in sentence
    assert sentence.count("outside the catalogue") == 1


def test_the_sentence_counts_what_else_it_could_be_where_naming_all_would_bury_it():
    report = full_report()
    (group,) = [g for g in report.indistinguishable if len(g.words) == 2]
    more = dataclasses.replace(group, words=(*group.words, "gravity × 1.1"))
    sentence = dataclasses.replace(report, indistinguishable=(more,)).sentence()
    assert "These data cannot tell mass of bodies pole × 1.2 from 2 other effects." in sentence


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "Another set of effects explains these data as well: gravity × 0.5."),
        (2, "2 other sets of effects explain these data as well, such as gravity × 0.5."),
    ],
)
def test_the_sentence_names_one_other_set_and_counts_the_rest(count, words):
    other = OtherExplanation((Gravity(0.5),), 0.1)
    assert words in dataclasses.replace(full_report(), others=(other,) * count).sentence()


def test_a_report_without_effects_says_whether_nothing_is_missing_or_nothing_can_be_said():
    assert nothing_missing().sentence() == (
        "Nothing is missing: the effects tried explain no more than chance; one-step error 0.0041 rad/s, floor 0.004."
    )
    assert no_conclusion().sentence() == "No conclusion: 7 rows are too few."


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (0, ""),
        (1, " Not identifiable in these data, because noise or a lack of motion would hide them: gravity × 1."),
        (
            9,
            " 9 effects are not identifiable in these data, because noise or a lack of motion would hide them, such as "
            "gravity × 1, gravity × 2, gravity × 3 and gravity × 4.",
        ),
    ],
)
def test_where_nothing_is_missing_the_sentence_names_what_the_data_could_not_have_shown(count, words, tmp_path):
    effects = tuple(f"gravity × {i + 1}" for i in range(count))
    report = dataclasses.replace(nothing_missing(), verdict=Verdict(NOTHING_MISSING, undetectable=effects))
    assert report.sentence() == nothing_missing().sentence() + words
    assert Report.load(report.save(tmp_path)).verdict == report.verdict
    assert ("gravity × 1" in (tmp_path / "report.html").read_text(encoding="utf-8")) is (count > 0)


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        (
            OTHERS,
            "The time for the search was up while it was looking for other explanations: effects may still be added or "
            "replaced, and others may explain these data as well.",
        ),
        (
            FORCES,
            "The time for the search was up: a force outside the catalogue, and action noise, were not looked for.",
        ),
        (NOISE, "The time for the search was up: action noise was not looked for."),
    ],
)
def test_the_sentence_says_what_a_search_whose_time_was_up_has_not_done(stage, words, tmp_path):
    report = dataclasses.replace(few_pictures(full_report()), ended_in=stage)
    assert words in report.sentence()
    assert report.sentence().startswith("The best explanation so far" if stage == OTHERS else "Your simulator lacks")
    assert report.recommended is (stage != OTHERS)
    assert ("its time was up while" in report.why_not_recommended()) is (stage == OTHERS)
    assert Report.load(report.save(tmp_path)).ended_in == stage
    assert words in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("severity", "check", "words"),
    [
        ("severe", "time", "Do not rely on this: the data are faulty (the zero is off)."),
        ("warning", "model", "Check this first, because the effects found may stand for it: the zero is off."),
        ("warning", "rows", ""),
        ("note", "model", ""),
    ],
)
def test_the_sentence_says_what_the_audit_found_wrong(severity, check, words):
    report = dataclasses.replace(full_report(), audit=Audit((Finding(check, severity, "the zero is off"),)))
    assert report.sentence() == " ".join([full_report().sentence(), words]).rstrip()
    nothing = dataclasses.replace(report, found=(), indistinguishable=())
    assert ("Check this first" in nothing.sentence()) is False


def test_an_error_that_is_not_known_is_left_out_of_the_sentence():
    error = ErrorSummary("RMSE", "rad/s", math.nan, math.inf)
    assert "error" not in dataclasses.replace(nothing_missing(), error=error).sentence()
