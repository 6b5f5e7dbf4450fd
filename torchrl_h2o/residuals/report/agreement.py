"""Which values agree between logs and between equal joints, in words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.effects import quantity_name
from torchrl_h2o.residuals.between_logs import NOT_IDENTIFIABLE, WEAK, InLogs
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.report.words import number, quantity

NAMED = 4  # values that a sentence names
_SIDES = r"left|right|front|back|rear|hind|[fbrh]?[lr]|[fbrh]"  # of a robot, as words in the names of its joints
_SIDE = re.compile(rf"(?<![^\W\d_])(?:{_SIDES})(?![^\W\d_])[\W_]*", re.IGNORECASE)
_ONE_VALUE = re.compile(r" [+×] \{\w+\}")  # how the wording of an effect of one value ends


@dataclass(frozen=True)
class LoggedValue:
    """A fitted value in words, with its values in each log.

    Args:
        words: the effect, with the parameter's name if it has several.
        unit: the value's unit.
        in_logs: the values in each log.
    """

    words: str
    unit: str
    in_logs: InLogs

    @property
    def cells(self) -> list[str]:
        """The value in each log with its standard error, for a table."""
        own = self.in_logs
        return [
            kind if kind == NOT_IDENTIFIABLE else f"{number(value)} ± {number(error, 1)}{f' ({kind})' * (kind == WEAK)}"
            for value, error, kind in zip(own.values, own.errors, own.kinds, strict=True)
        ]

    @property
    def agreement(self) -> str:
        """Whether the logs agree, with the p-value, for a table."""
        own = self.in_logs
        if own.agree is None:
            return "in one log only"
        return f"{'agree' if own.agree else f'differ, {self.range}'} (p = {number(own.p_value, 2)})"

    @property
    def agrees(self) -> bool | None:
        """Whether the logs agree, or differ by less than the digits that are shown; None for a single log."""
        low, high = map(number, self.in_logs.range)
        return True if low == high and self.in_logs.agree is False else self.in_logs.agree

    @property
    def range(self) -> str:
        """Lowest and highest value over the logs."""
        low, high = self.in_logs.range
        return f"{number(low)} to {quantity(high, self.unit)}"

    @property
    def lacking(self) -> str:
        """The logs in which the value is weak or not identifiable; empty without any."""
        own, found = self.in_logs, []
        for kind in (WEAK, NOT_IDENTIFIABLE):
            logs = [str(log) for log, one in zip(own.logs, own.kinds, strict=True) if one == kind]
            if logs:
                found.append(f"{kind} in log{'s' * (len(logs) > 1)} {', '.join(logs)}")
        return ", ".join(found)


def logged_values(report: ReportContents) -> list[LoggedValue]:
    """The fitted values that a report has of each of several logs, in order."""
    return [
        LoggedValue(
            found.words if len(found.in_logs) == 1 else f"{quantity_name(name, found.units[name])} of {found.words}",
            found.units[name],
            in_logs,
        )
        for found in report.found
        for name, in_logs in found.in_logs.items()
    ]


def agreement_words(report: ReportContents) -> list[str]:
    """Which values agree between the logs, which do not, and which some logs do not contain, a sentence each."""
    values = logged_values(report)
    if not values:
        return []
    agree = [one.words for one in values if one.agrees]
    differ = [f"{one.words} ({one.range})" for one in values if one.agrees is False]
    lacking = [f"{one.words} ({one.lacking})" for one in values if one.lacking]
    logs = f"The {len(values[0].in_logs.logs)} fitted logs"
    return [
        *([f"{logs} agree on {_some(agree)}."] if agree else []),
        *([f"{logs} differ in {_some(differ)}."] if differ else []),
        *([f"Not every log contains {_some(lacking)}."] if lacking else []),
    ]


def equal_joints_words(report: ReportContents) -> list[str]:
    """Mean and scatter of what was found on several joints whose names differ by their side alone.

    Examples:
        >>> from torchrl_h2o.effects import JointDamping
        >>> from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect
        >>> values = {"FL_hip": 0.2, "FR_hip": 0.3, "FL_knee": 0.9}
        >>> found = tuple(FoundEffect(JointDamping(value, joint), True, {}, 0.0) for joint, value in values.items())
        >>> equal_joints_words(ReportContents(simulator="a", data=DataSummary("b", 1, 1), found=found))
        ['Of the 2 joints hip, the damping is 0.25 N·m·s/rad on average, with a standard deviation of 0.0707.']
    """
    groups: dict[tuple[str, str, str], list[float]] = {}
    for found in report.found:
        joint = getattr(found.effect, "joints", "*")
        what, _, rest = found.effect.wording.partition(" of {joints}")
        name = _SIDE.sub("", joint).strip("_") if isinstance(joint, str) else ""
        if _ONE_VALUE.fullmatch(rest) and name not in ("", joint):
            for _, unit, value, _ in found.values:
                groups.setdefault((name, what, unit), []).append(value)
    return [
        f"Of the {len(values)} joints {name}, the {what} is {quantity(float(np.mean(values)), unit)} on average, with "
        f"a standard deviation of {number(float(np.std(values, ddof=1)))}."
        for (name, what, unit), values in groups.items()
        if len(values) > 1
    ]


def _some(words: Sequence[str]) -> str:
    """The first few of some phrases, and how many more there are."""
    more = len(words) - NAMED
    named = [*words[:NAMED], *([f"{more} more"] if more > 0 else [])]
    return " and ".join([", ".join(named[:-1]), named[-1]]) if len(named) > 1 else named[0]
