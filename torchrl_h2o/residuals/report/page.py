"""Writes ``report.html``: a single file without references to other resources."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from torchrl_h2o.effects import is_negligible
from torchrl_h2o.residuals.report import plots
from torchrl_h2o.residuals.report.agreement import logged_values
from torchrl_h2o.residuals.report.contents import FoundEffect, ReportContents
from torchrl_h2o.residuals.report.mended_model import REMEDY
from torchrl_h2o.residuals.report.sentence import sentences
from torchrl_h2o.residuals.report.templates import templates
from torchrl_h2o.residuals.report.windows import RunError
from torchrl_h2o.residuals.report.words import (
    change,
    duration,
    in_readable_unit,
    interval,
    interval_digits,
    number,
    quantity,
)
from torchrl_h2o.whole_file import write_text

FILE = "report.html"
SHOWN_RUNS = 12  # those with the largest errors; the others are in a list that opens
_TEMPLATE = "report.html.jinja"


@dataclass(frozen=True)
class _Tried:
    """A row of the ranking."""

    words: str
    error: float
    p_value: float | None
    verdict: str
    found: bool


def write_page(report: ReportContents, folder: str | Path) -> Path:
    """Writes ``report.html`` into a folder, which is created if it does not exist, and returns the file's path."""
    return write_text(Path(folder) / FILE, report_page(report))


def report_page(report: ReportContents) -> str:
    """Renders the report as a page.

    Args:
        report: the report; sections without contents are left out.

    Returns:
        HTML with its style and pictures embedded, without references to other resources.
    """
    environment = templates(Path(__file__).parent)
    environment.filters |= {"number": number, "quantity": quantity}
    return environment.get_template(_TEMPLATE).render(
        report=report,
        sentences=sentences(report),
        change=change,
        duration=duration,
        readable=in_readable_unit,
        parameters=_parameters,
        ranking=_ranking(report),
        shown_runs=sorted(report.runs, key=_worst_first)[:SHOWN_RUNS],
        logged=logged_values(report),
        remedy=REMEDY,
        held=_held(report),
        pictures=_pictures(report),
        colours={"before": plots.BEFORE, "after": plots.AFTER},
    )


def _parameters(found: FoundEffect) -> list[tuple[str, str, str]]:
    """Name, value with unit, and interval of each parameter of an effect."""
    return [
        (name, quantity(value, unit, interval_digits(*ends)), interval(*ends, unit))
        for name, unit, value, ends in found.values
    ]


def _ranking(report: ReportContents) -> list[_Tried]:
    """The effects put in, in order, then the rejected ones in ascending order of their error."""
    found = [
        _Tried(f.words, f.error_after, None, "put in" if k == 0 else "put in, with those above", True)
        for k, f in enumerate(report.found)
    ]
    rejected = [
        _Tried(r.words, r.error_after, r.p_value, r.reason, False)
        for r in report.rejected
        if not is_negligible(r.effect)  # as in reports of earlier versions
    ]
    # NaN, the error of a divergence, sorts last
    return found + sorted(rejected, key=lambda tried: (number(tried.error) == "–", tried.error))


def _held(report: ReportContents) -> str:
    """The effects found that the file with the mended model holds."""
    left_out = () if report.mended_model is None else report.mended_model.effects
    return ", ".join(found.words for found in report.found if found.effect not in left_out) or "none of them"


def _worst_first(run: RunError) -> tuple[bool, float]:
    return math.isfinite(run.after), -run.after


def _pictures(report: ReportContents) -> Mapping[str, Any]:
    """The pictures as SVG, by section of the page; those of the windows by window."""
    pictures: dict[str, Any] = {"dimensions": [], "horizons": [], "windows": [], "time": [], "states": []}
    pictures["windows"] = [[plots.window_lines(window, q) for q in window.quantities] for window in report.windows]
    if report.error is not None:
        by_unit = sorted(report.error.per_dimension, key=lambda dimension: dimension.unit)
        pictures["dimensions"] = [
            plots.error_bars(list(dimensions)) for _, dimensions in groupby(by_unit, lambda d: d.unit)
        ]
        if report.error.horizons:
            pictures["horizons"] = [
                plots.horizon_lines(report.error.horizons, dimension) for dimension in report.error.per_dimension
            ]
    if report.trace is not None:
        trace = report.trace.thinned()
        pictures["time"] = [
            plots.residual_in_time(trace, dimension, report.unexplained_intervals)
            for dimension in range(len(trace.names))
        ]
        pictures["states"] = [
            plots.residual_against_state(trace, dimension, state, report.unexplained_intervals)
            for dimension, state in plots.telling_pairs(trace)
        ]
    return pictures
