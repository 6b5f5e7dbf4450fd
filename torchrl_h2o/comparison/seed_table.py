"""Tables of one number per seed: seconds balanced, largest distance from the start, mean speed; a line per variant."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.results_file import IDENTITY

MOST_COLUMNS = 12  # seeds side by side; more of them have a line each
EPISODE = 30.0  # s, an episode of the robot without a fall
#: column, title and format of each table
QUANTITIES = (
    ("seconds", "seconds balanced in reality", ".3g"),
    ("max_abs_x", "largest distance from the start in reality, m", ".2f"),
    ("mean_v", "mean speed in reality, m/s", ".3f"),
)


def seed_tables(runs: pd.DataFrame, at: Sequence[int] = ()) -> str:
    """Format Markdown tables with a line per variant and a column per seed, for each environment and quantity.

    Of many seeds, each has a line, and each variant a column.

    A variant is named by the settings in which the runs differ. The speed is shown for tasks in which the robot has to
    move, which do not observe its position.

    Args:
        runs: rows of a results file, or of its learning curves.
        at: of learning curves, the numbers of updates to show.

    Example:
        >>> row = {"env": "robot", "method": "iql", "seed": "0", "seconds": "30.0", "others": "n_steps=5"}
        >>> print(seed_tables(pd.DataFrame([row, row | {"seed": "1", "seconds": "4.25"}])))
        **robot: seconds balanced in reality**
        <BLANKLINE>
        | variant | seed 0 | seed 1 | all 30 s |
        | --- | --- | --- | --- |
        | iql | 30 | 4.25 | 1 of 2 |
        <BLANKLINE>
    """
    runs = runs[runs["at"].astype(int).isin(at)] if at else runs
    runs = runs.astype({"seed": int})
    lines = []
    for env, of_env in runs.groupby("env"):
        columns = [name for name in (*IDENTITY, "at") if name in runs and name not in ("env", "seed")]
        differ = [name for name in columns if of_env[name].nunique() > 1]
        named = of_env.assign(variant=[_name(row, differ) for row in of_env.to_dict("records")])
        observed = {name: named[named[name] != ""] for name, *_ in QUANTITIES if name in named}
        if "max_abs_x" in observed and len(observed["max_abs_x"]):
            observed.pop("mean_v", None)
        for quantity, title, form in QUANTITIES:
            if quantity in observed and len(observed[quantity]):
                lines += [f"**{env}: {title}**", "", _table(observed[quantity], quantity, form), ""]
    return "\n".join(lines)


def _table(runs: pd.DataFrame, quantity: str, form: str) -> str:
    values = runs.assign(value=runs[quantity].astype(float)).pivot(index="variant", columns="seed", values="value")
    values = values.loc[runs["variant"].unique()]  # in the order of the file
    cells = values.map(lambda value: "" if pd.isna(value) else format(value, form))
    cells.columns = [f"seed {seed}" for seed in values]
    if quantity == "seconds":
        whole = (values >= EPISODE).sum(axis=1), values.notna().sum(axis=1)
        cells[f"all {EPISODE:g} s"] = [f"{stood} of {count}" for stood, count in zip(*whole, strict=True)]
    if len(values.columns) > MOST_COLUMNS:
        cells = cells.T
    first = "seed" if len(values.columns) > MOST_COLUMNS else "variant"
    rows = [[str(name).removeprefix("seed "), *row] for name, row in zip(cells.index, cells.to_numpy(), strict=True)]
    return markdown_table([first, *cells.columns], rows)


def _name(row: Mapping[Any, str], differ: Sequence[str]) -> str:
    """Name a run by its method and the settings in which the runs differ."""
    named = [row["method"]]
    for column in differ:
        if column == "others":
            named.append(row["others"] or "(defaults)")
        elif column != "method" and row[column]:
            named.append(f"{column}={row[column]}")
    return " ".join(named)
