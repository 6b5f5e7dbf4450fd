"""Tables of policies that were trained in different worlds for series of machines, and what they say in a sentence."""

from collections.abc import Sequence

import pandas as pd

from torchrl_h2o.comparison.aggregates import mean_of_runs
from torchrl_h2o.comparison.markdown import markdown_table

REPS = 2000  # bootstrap samples


def series_tables(runs: pd.DataFrame, columns: Sequence[str]) -> str:
    """Format means over seeds with 95 % bootstrap intervals, a table and a sentence for each series.

    The sentence compares the first worlds of each series with all others, seed by seed.

    Args:
        runs: a row per policy, with the columns ``series``, ``worlds``, ``seed`` and ``return``.
        columns: the columns to show; those without values in a series are left out there.

    Example:
        >>> told = {"series": ["arm"] * 4, "worlds": list("aabb"), "seed": [0, 1, 0, 1], "return": [3.0, 5.0, 1.0, 2.0]}
        >>> print(series_tables(pd.DataFrame(told), ["return"]))
        **arm**
        <BLANKLINE>
        | worlds | return | seeds |
        | --- | --- | --- |
        | a | 4 [3, 5] | 2 |
        | b | 1.5 [1, 2] | 2 |
        <BLANKLINE>
        The return with a is higher than with b (by 2.5 [2, 3]).
    """
    parts = []
    for name, own in runs.groupby("series", sort=False):
        shown = [column for column in columns if own[column].notna().any()]
        rows = [
            [str(worlds), *(mean_of_runs(its[column].tolist(), REPS).text() for column in shown), str(len(its))]
            for worlds, its in own.groupby("worlds", sort=False)
        ]
        parts += [f"**{name}**", markdown_table(["worlds", *shown, "seeds"], rows), _sentence(own)]
    return "\n\n".join(parts)


def _sentence(runs: pd.DataFrame) -> str:
    """Say how the return with the first worlds differs from that with each of the others."""
    returns = runs.pivot(index="seed", columns="worlds", values="return")
    first, *others = runs["worlds"].unique()
    parts = []
    for other in others:
        gain = mean_of_runs((returns[first] - returns[other]).dropna().tolist(), REPS)
        told = "higher than" if gain.low > 0.0 else "lower than" if gain.high < 0.0 else "not distinguishable from that"
        parts.append(f"{told} with {other} (by {gain.text()})")
    return f"The return with {first} is {', '.join(parts)}."
