"""Arranges the runs of a results file as a table: one row per task, one column per method, all seeds in one cell."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.options.train import OFFLINE

Reference = tuple[float, float]  # returns with score 0 and score 100
#: Returns with score 0 and score 100. For HalfCheetah and Walker2d: D4RL's random and expert policies (Fu et al., 2020,
#: arXiv 2004.07219). For the robot: 0, and the return of 30 s without a fault. For the changed tasks: random and
#: expert policies in them, of Lyu et al. (ICLR 2025), info.py in github.com/dmksjfl/OTDF.
REFERENCES = {
    "HalfCheetah-v5": (-280.178953, 12135.0),
    "Walker2d-v5": (1.629008, 4592.3),
    "wheel_legged/standing_still": (0.0, 180_000.0),
    "wheel_legged/moving_forward": (0.0, 90_000.0),
    "halfcheetah_gravity": (-280.178953, 9509.15),
    "halfcheetah_kinematic": (-280.178953, 7065.03),
    "halfcheetah_morph": (-280.178953, 9713.59),
    "walker2d_gravity": (10.079455, 5194.713),
    "walker2d_kinematic": (10.079455, 3257.51),
    "walker2d_morph": (10.079455, 4398.43),
}
Task = tuple[str, ...]
#: columns in which the variants of H2O+ differ in the ablations, and their labels in tables
VARIANTS = {"backbone": "", "mixing": "λ", "ratio": "ratio"}
#: overrides that change how often a policy is evaluated during training, and nothing in the last policy
EVALUATION = ("eval_every=", "eval_episodes=", "trial_episodes=")
DATA = ["env", "data", "data_seconds", "others"]  # columns on which the run of an offline method depends


class MixedRunsError(ValueError):
    """Runs that cannot be combined in one table."""


def task_of(row: Mapping[str, Any]) -> Task:
    """Return the task of a row: environment, data, gap, variant and other overrides. Methods are compared per task."""
    variant = [f"{name} {row[key]}".strip() for key, name in VARIANTS.items() if row[key]]
    gap = f"{row['gap']} {float(row['strength']):g}" if row["gap"] else ""
    others = row["others"]
    if "keep=" not in others:  # a run that keeps its last policy is the same however often it is evaluated
        others = " ".join(override for override in others.split() if not override.startswith(EVALUATION))
    settings = [others, *(f"{name}={row[name]}" for name in ("data_seconds", "mend") if row[name])]
    return (row["env"], row["data"], gap, *variant, *filter(None, settings))


def placed(runs: pd.DataFrame, variants: bool) -> pd.DataFrame:
    """Arrange runs by task, with numbers as numbers.

    The run of an offline method is repeated for every gap of its data, since it counts for all of them.

    Args:
        runs: rows of a results file, or of its learning curves.
        variants: whether runs that differ in backbone, λ or ratio belong to different tasks, as in the ablations.
            If False, these columns are ignored.

    Returns:
        The runs, with the further column ``task``.
    """
    runs = runs if variants else runs.assign(**dict.fromkeys(VARIANTS, ""))
    gaps = runs.loc[runs["gap"] != "", [*DATA, "gap", "strength"]].drop_duplicates()
    offline = runs["method"].isin(OFFLINE) & (runs["gap"] == "")
    repeated = runs[offline].drop(columns=["gap", "strength"]).merge(gaps, how="left", on=DATA).fillna("")
    runs = pd.concat([runs[~offline], repeated], ignore_index=True)
    runs["task"] = [task_of(row) for row in runs.to_dict("records")]
    numbers = {"seed": int, "return_mean": float, "return_std": float, "seconds": float, "at": int}
    return runs.astype({column: kind for column, kind in numbers.items() if column in runs})


def require_distinct(runs: pd.DataFrame) -> None:
    """Require that no method has two runs of a seed in a task.

    Raises:
        MixedRunsError: if one has.
    """
    for row in runs[runs.duplicated(["task", "method", "seed"])].to_dict("records"):
        task = " ".join(filter(None, row["task"]))
        raise MixedRunsError(
            f"{row['method']} has two runs of seed {row['seed']} in {task} that differ in "
            f"{', '.join(VARIANTS)}: record them in a separate file with results=..."
        )


def normalised(value: Any, reference: Reference) -> Any:
    """Score of a return, linear in the return, with score 0 and score 100 at the two returns of ``reference``."""
    low, high = reference
    return 100 * (value - low) / (high - low)


def cell(runs: pd.DataFrame) -> str:
    """Format mean ± standard deviation over seeds (for one seed, over its episodes), and the number of seeds."""
    spread = runs["return_mean"].std() if len(runs) > 1 else runs["return_std"].iloc[0]
    return f"{runs['return_mean'].mean():,.0f} ± {spread:,.0f} ({len(runs)})"


def markdown(
    runs: pd.DataFrame,
    titles: Mapping[str, str],
    paper: Mapping[Task, Mapping[str, str]],
    references: Mapping[str, Reference] = REFERENCES,
) -> str:
    """Format the table as Markdown, our results above the paper's.

    Args:
        runs: from :func:`placed`.
        titles: titles of the methods, in the order of the columns.
        paper: the paper's cells by task and method, as text.
        references: by environment, the returns with score 0 and score 100; other environments get no scores.
    """
    present = [name for name in titles if (runs["method"] == name).any()]
    lines = []
    for task in sorted(runs["task"].unique()):
        of_task = runs[runs["task"] == task]
        own = dict(list(of_task.groupby("method")))
        env, data, gap, *variant = task

        def line(what: str, shown: Mapping[str, str], start: tuple[str, ...] = ("",) * 4) -> list[str]:
            return [*start, what, *(shown.get(name, "") for name in present)]

        first = (env, data, gap, ", ".join(variant))
        lines.append(line("ours", {name: cell(of_method) for name, of_method in own.items()}, first))
        if of_task["seconds"].nunique() > 1:
            lines.append(line("lasts, s", {name: f"{x['seconds'].mean():.1f}" for name, x in own.items()}))
        if env in references:
            scores = {name: normalised(x["return_mean"].mean(), references[env]) for name, x in own.items()}
            lines.append(line("score", {name: f"{score:.1f}" for name, score in scores.items()}))
        if task in paper:
            lines.append(line("paper", paper[task]))
    return markdown_table(["environment", "data", "gap", "variant", "", *(titles[name] for name in present)], lines)
