"""Arranges the rows of a results file as a table: one row per task, one column per method, all seeds in one cell."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from torchrl_h2o.comparison.grids import OFFLINE

Reference = tuple[float, float]  # returns with score 0 and score 100
#: Returns with score 0 and score 100. For HalfCheetah and Walker2d: D4RL's random and expert policies (Fu et al., 2020,
#: arXiv 2004.07219). For the robot: 0, and the return of 30 s without a fault.
REFERENCES = {
    "HalfCheetah-v5": (-280.178953, 12135.0),
    "Walker2d-v5": (1.629008, 4592.3),
    "wheel_legged/standing_still": (0.0, 180_000.0),
    "wheel_legged/moving_forward": (0.0, 90_000.0),
}

Row = Mapping[str, str]
Task = tuple[str, ...]


class MixedRunsError(ValueError):
    """Runs that cannot be combined in one table."""


@dataclass(frozen=True)
class Cell:
    """The returns of one method in one task, by seed.

    Args:
        returns: mean return of each run.
        within: standard deviation over each run's episodes.
        seconds: mean length of each run's episodes, s.
    """

    returns: dict[int, float] = field(default_factory=dict)
    within: dict[int, float] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    def text(self) -> str:
        """Format mean ± standard deviation over seeds (for one seed, over its episodes), and the number of seeds."""
        values = list(self.returns.values())
        spread = statistics.stdev(values) if len(values) > 1 else next(iter(self.within.values()))
        return f"{statistics.mean(values):,.0f} ± {spread:,.0f} ({len(values)})"

    def lasts(self) -> str:
        """Format the mean length of an episode, in s."""
        return f"{statistics.mean(self.seconds.values()):.1f}" if self.seconds else ""

    def score(self, reference: Reference) -> str:
        """Format the normalised score of the mean return."""
        return f"{normalised(statistics.mean(self.returns.values()), reference):.1f}" if self.returns else ""


#: columns in which the variants of H2O+ differ in the ablations, and their labels in tables
VARIANTS = {"backbone": "", "mixing": "λ", "ratio": "ratio"}
#: overrides that change how often a policy is evaluated during training, and nothing in the last policy
EVALUATION = ("eval_every=", "eval_episodes=", "trial_episodes=")


def task_of(row: Row) -> Task:
    """Return the task of a row: environment, data, gap, variant and other overrides. Methods are compared per task."""
    variant = [f"{name} {row[key]}".strip() for key, name in VARIANTS.items() if row.get(key)]
    gap = f"{row['gap']} {float(row['strength']):g}" if row["gap"] else ""
    others = [_without_evaluation(row.get("others") or "")]
    others += [f"{name}={row[name]}" for name in ("data_seconds", "mend") if row.get(name)]
    return (row["env"], row["data"], gap, *variant, *filter(None, others))


def _without_evaluation(others: str) -> str:
    """Leave out overrides that have no effect on the policy of a run that keeps its last one."""
    if "keep=" in others:
        return others
    return " ".join(override for override in others.split() if not override.startswith(EVALUATION))


def placed(rows: Iterable[Row], variants: bool) -> list[Row]:
    """Repeat each row of an offline method for every gap of its data, since that run counts for all of them.

    Args:
        rows: rows of a results file.
        variants: whether runs that differ in backbone, λ or ratio belong to different tasks, as in the ablations.
            If False, these columns are ignored.
    """
    rows = [dict(row) if variants else {**row, **dict.fromkeys(VARIANTS, "")} for row in rows]
    gaps = {(*_data_of(row), row["gap"], row["strength"]) for row in rows if row["gap"]}
    read = []
    for row in rows:
        present = [gap[4:] for gap in sorted(gaps) if gap[:4] == _data_of(row)]
        if row["method"] in OFFLINE and not row["gap"] and present:
            read += [{**row, "gap": gap, "strength": strength} for gap, strength in present]
        else:
            read.append(row)
    return read


def _data_of(row: Row) -> tuple[str, str, str, str]:
    """Return what the run of an offline method depends on."""
    return (row["env"], row["data"], row.get("data_seconds", ""), row["others"])


def cells(rows: Iterable[Row]) -> dict[Task, dict[str, Cell]]:
    """Collect rows returned by :func:`placed` into cells by task and method.

    Raises:
        MixedRunsError: if a method has two runs of a seed in a task.
    """
    table: dict[Task, dict[str, Cell]] = defaultdict(dict)
    for row in rows:
        cell, seed = table[task_of(row)].setdefault(row["method"], Cell()), int(row["seed"])
        if seed in cell.returns:
            raise MixedRunsError(
                f"{row['method']} has two runs of seed {seed} in {' '.join(filter(None, task_of(row)))} that differ in "
                f"{', '.join(VARIANTS)}: record them in a separate file with results=..."
            )
        cell.returns[seed] = float(row["return_mean"])
        cell.within[seed] = float(row["return_std"])
        cell.seconds[seed] = float(row["seconds"])
    return dict(table)


def normalised(value: float, reference: Reference) -> float:
    """Score of a return, linear in the return, with score 0 and score 100 at the two returns of ``reference``."""
    low, high = reference
    return 100 * (value - low) / (high - low)


def markdown(
    table: dict[Task, dict[str, Cell]],
    titles: Mapping[str, str],
    paper: dict[Task, dict[str, str]],
    references: Mapping[str, Reference] = REFERENCES,
) -> str:
    """Format the table as Markdown, our results above the paper's.

    Args:
        table: from :func:`cells`.
        titles: titles of the methods, in the order of the columns.
        paper: the paper's cells by task and method, as text.
        references: by environment, the returns with score 0 and score 100; other environments get no scores.
    """
    present = [name for name in titles if any(name in methods for methods in table.values())]
    head = ["environment", "data", "gap", "variant", "", *(titles[name] for name in present)]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for task in sorted(table):
        env, data, gap, *variant = task
        ours = [table[task][name].text() if name in table[task] else "" for name in present]
        first = [env, data, gap, ", ".join(variant)]
        lines.append("| " + " | ".join([*first, "ours", *ours]) + " |")
        if len({seconds for cell in table[task].values() for seconds in cell.seconds.values()}) > 1:
            lasts = [table[task].get(name, Cell()).lasts() for name in present]
            lines.append("| " + " | ".join(["", "", "", "", "lasts, s", *lasts]) + " |")
        if env in references:
            scores = [table[task].get(name, Cell()).score(references[env]) for name in present]
            lines.append("| " + " | ".join(["", "", "", "", "score", *scores]) + " |")
        if task in paper:
            theirs = [paper[task].get(name, "") for name in present]
            lines.append("| " + " | ".join(["", "", "", "", "paper", *theirs]) + " |")
    return "\n".join(lines)
