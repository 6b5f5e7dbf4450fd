"""Tables of policies for series of machines by the worlds in which they were trained, and the result in a sentence."""

from collections.abc import Sequence

import pandas as pd

from torchrl_h2o.comparison.aggregates import Interval, mean_of_runs
from torchrl_h2o.comparison.markdown import markdown_table

REPS = 2000  # bootstrap samples


def series_tables(runs: pd.DataFrame, worlds: Sequence[str], columns: Sequence[str]) -> str:
    """Format means over seeds with 95 % bootstrap intervals: a table and a sentence for each series and budget.

    Args:
        runs: a row per policy, with the columns ``series``, ``updates``, ``worlds``, ``seed`` and ``return``.
        worlds: the lines of a table in their order. The sentence compares the first with each other one, seed by seed.
        columns: the columns to show; those without values in a series are left out there.

    Example:
        >>> told = {"series": "arm", "updates": 8000, "worlds": list("aabb"), "seed": [0, 1, 0, 1]}
        >>> runs = pd.DataFrame(told | {"return": [3.0, 5.0, 1.0, 2.0]})
        >>> print(series_tables(runs, ["b", "a"], ["return"]))
        **arm, 8,000 updates**
        <BLANKLINE>
        | worlds | return | seeds |
        | --- | --- | --- |
        | b | 1.5 [1, 2] | 2 |
        | a | 4 [3, 5] | 2 |
        <BLANKLINE>
        The return with b is lower than with a (by -2.5 [-3, -2]).
    """
    parts = []
    for (name, updates), of_series in runs.groupby(["series", "updates"]):
        shown = [column for column in columns if column in of_series and of_series[column].notna().any()]
        by_worlds = {one: own for one in worlds if len(own := of_series[of_series["worlds"] == one])}
        rows = [[one, *(_mean(own[column]) for column in shown), str(len(own))] for one, own in by_worlds.items()]
        returns = {one: own.set_index("seed")["return"] for one, own in by_worlds.items()}
        parts += [
            f"**{name}, {updates:,} updates**",
            markdown_table(["worlds", *shown, "seeds"], rows),
            _sentence(returns),
        ]
    return "\n\n".join(parts)


def _sentence(returns: dict[str, pd.Series]) -> str:
    """Say how the returns with the first worlds differ from those with each of the others."""
    first, *others = returns
    parts = []
    for other in others:
        gain = mean_of_runs((returns[first] - returns[other]).dropna().tolist(), REPS)
        told = "higher than" if gain.low > 0.0 else "lower than" if gain.high < 0.0 else "not distinguishable from that"
        parts.append(f"{told} with {other} (by {_text(gain)})")
    return f"The return with {first} is {', '.join(parts)}." if parts else ""


def _mean(values: pd.Series) -> str:
    return _text(mean_of_runs(values.tolist(), REPS))


def _text(interval: Interval) -> str:
    value, low, high = (
        f"{number:,.0f}" if abs(number) >= 1000.0 else f"{number:.3g}"
        for number in (interval.value, interval.low, interval.high)
    )
    return f"{value} [{low}, {high}]"
