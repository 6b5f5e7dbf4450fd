"""The rows of a group's CSV as cells of a table: what was asked (a row), by which method (a column), over the seeds."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from torchrl_h2o.comparison.grids import OFFLINE

Reference = tuple[float, float]  # returns that count as 0 and as 100
#: Returns that count as 0 and as 100: D4RL's random and expert policies (Fu et al., 2020, arXiv 2004.07219); for the
#: robot nothing, and 30 s without a fault.
REFERENCES = {
    "HalfCheetah-v5": (-280.178953, 12135.0),
    "Walker2d-v5": (1.629008, 4592.3),
    "wheel_legged/standing_still": (0.0, 180_000.0),
    "wheel_legged/moving_forward": (0.0, 90_000.0),
}

Row = Mapping[str, str]
Task = tuple[str, ...]


class MixedRunsError(ValueError):
    """Runs that one table cannot hold."""


@dataclass(frozen=True)
class Cell:
    """The returns of one method in one task, by seed.

    Args:
        returns: mean return of each run, by its seed.
        within: standard deviation over the episodes of each run.
        seconds: how long an episode lasts on average, of each run.
    """

    returns: dict[int, float] = field(default_factory=dict)
    within: dict[int, float] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    def text(self) -> str:
        """Mean and standard deviation over the seeds; of a single seed, over its episodes."""
        values = list(self.returns.values())
        spread = statistics.stdev(values) if len(values) > 1 else next(iter(self.within.values()))
        return f"{statistics.mean(values):,.0f} ± {spread:,.0f} ({len(values)})"

    def lasts(self) -> str:
        """Mean length of an episode, in s."""
        return f"{statistics.mean(self.seconds.values()):.1f}" if self.seconds else ""

    def score(self, reference: Reference) -> str:
        """The mean return, normalised."""
        return f"{normalised(statistics.mean(self.returns.values()), reference):.1f}" if self.returns else ""


#: what tells H2O+'s variants apart in the ablations, and how a table says it
VARIANTS = {"backbone": "", "mixing": "λ", "ratio": "ratio"}


def task_of(row: Row) -> Task:
    """What is compared across methods: environment, data, gap and strength, and then whatever else was chosen."""
    variant = [f"{name} {row[key]}".strip() for key, name in VARIANTS.items() if row.get(key)]
    gap = f"{row['gap']} {float(row['strength']):g}" if row["gap"] else ""
    others = [row["others"]] if row.get("others") else []
    return (row["env"], row["data"], gap, *variant, *others)


def placed(rows: Iterable[Row], variants: bool) -> list[Row]:
    """Rows where they are to be read: those of a method that saw no simulator in every gap of its data.

    Args:
        rows: of a group's CSV.
        variants: whether H2O+'s backbone, λ and ratio tell tasks apart, as in the ablations; else they are left out.
    """
    rows = [dict(row) if variants else {**row, **dict.fromkeys(VARIANTS, "")} for row in rows]
    gaps = {(row["env"], row["data"], row["others"], row["gap"], row["strength"]) for row in rows if row["gap"]}
    read = []
    for row in rows:
        there = [where[3:] for where in sorted(gaps) if where[:3] == (row["env"], row["data"], row["others"])]
        if row["method"] in OFFLINE and not row["gap"] and there:
            read += [{**row, "gap": gap, "strength": strength} for gap, strength in there]
        else:
            read.append(row)
    return read


def cells(rows: Iterable[Row]) -> dict[Task, dict[str, Cell]]:
    """Cells by task and method, of rows that are :func:`placed`.

    Raises:
        MixedRunsError: if a method has two runs of a seed in a task.
    """
    table: dict[Task, dict[str, Cell]] = defaultdict(dict)
    for row in rows:
        cell, seed = table[task_of(row)].setdefault(row["method"], Cell()), int(row["seed"])
        if seed in cell.returns:
            raise MixedRunsError(
                f"{row['method']} has two runs of seed {seed} in {' '.join(filter(None, task_of(row)))}, of another "
                f"{', '.join(VARIANTS)}: give those a file of their own, results=..."
            )
        cell.returns[seed] = float(row["return_mean"])
        cell.within[seed] = float(row["return_std"])
        cell.seconds[seed] = float(row["seconds"])
    return dict(table)


def normalised(value: float, reference: Reference) -> float:
    """A return on the scale of an environment's reference, as of :data:`REFERENCES`."""
    low, high = reference
    return 100 * (value - low) / (high - low)


def markdown(
    table: dict[Task, dict[str, Cell]],
    titles: Mapping[str, str],
    paper: dict[Task, dict[str, str]],
    references: Mapping[str, Reference] = REFERENCES,
) -> str:
    """The table, ours above the paper's, as GitHub shows it.

    Args:
        table: of :func:`cells`.
        titles: methods in the order of the columns, with their titles.
        paper: the paper's cells, as text.
        references: by environment; without one, no scores.
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
