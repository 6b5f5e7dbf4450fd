"""Means over seeds with bootstrap intervals, as a table, and what differs beyond chance, as a sentence."""

from collections.abc import Sequence

import pandas as pd

from torchrl_h2o.comparison.aggregates import mean_of_runs
from torchrl_h2o.comparison.markdown import markdown_table

REPS = 2000  # bootstrap samples


def interval_table(runs: pd.DataFrame, by: Sequence[str], columns: Sequence[str]) -> str:
    """Format means over seeds with 95 % intervals in Markdown, a line per group in the order of the runs.

    Args:
        runs: a row per run.
        by: the columns that name a group.
        columns: the columns to average; groups without values have empty cells.

    Example:
        >>> runs = pd.DataFrame({"method": ["a", "a", "b"], "return": [1.0, 3.0, 5.0]})
        >>> print(interval_table(runs, ["method"], ["return"]))
        | method | return | seeds |
        | --- | --- | --- |
        | a | 2 [1, 3] | 2 |
        | b | 5 [5, 5] | 1 |
    """
    rows = []
    for names, own in runs.groupby(list(by), sort=False):
        values = [own[column].dropna() for column in columns]
        cells = [mean_of_runs(its, REPS).text() if len(its) else "" for its in values]
        rows.append([*map(str, names), *cells, str(len(own))])
    return markdown_table([*by, *columns, "seeds"], rows)


def differences(runs: pd.DataFrame, by: str, first: str, column: str) -> str:
    """Say how one group differs from each other group on the same seeds.

    Args:
        runs: a row per run, with the column ``seed``.
        by: the column that names a group.
        first: the group that the others are compared with.
        column: the column to compare.

    Example:
        >>> runs = pd.DataFrame({"method": list("aabb"), "seed": [0, 1, 0, 1], "return": [3.0, 5.0, 1.0, 2.0]})
        >>> differences(runs, "method", "a", "return")
        'return with a is higher than with b (by 2.5 [2, 3])'
    """
    values = runs.pivot(index="seed", columns=by, values=column)
    parts = []
    for other in [name for name in runs[by].unique() if name != first]:
        gain = mean_of_runs((values[first] - values[other]).dropna(), REPS)
        told = "higher than" if gain.low > 0.0 else "lower than" if gain.high < 0.0 else "not distinguishable from that"
        parts.append(f"{told} with {other} (by {gain.text()})")
    return f"{column} with {first} is {', '.join(parts)}"
