"""Tables of one number per seed: seconds balanced, largest distance from the start, mean speed; a line per variant."""

from collections.abc import Iterable, Sequence

from torchrl_h2o.comparison.results_file import IDENTITY
from torchrl_h2o.comparison.scores import Row

EPISODE = 30.0  # s, an episode of the robot without a fall
#: column, title and format of each table
QUANTITIES = (
    ("seconds", "seconds balanced in reality", ".3g"),
    ("max_abs_x", "largest distance from the start in reality, m", ".2f"),
    ("mean_v", "mean speed in reality, m/s", ".3f"),
)
VARIANT = tuple(column for column in IDENTITY if column not in ("env", "seed"))


def seed_tables(rows: Sequence[Row], at: Sequence[int] = ()) -> str:
    """Format Markdown tables with a line per variant and a column per seed, for each environment and quantity.

    A variant is named by the settings in which the rows differ. The speed is shown for tasks in which the robot has to
    move, which do not observe its position.

    Args:
        rows: rows of a results file, or of its learning curves.
        at: of learning curves, the numbers of updates to show.

    Example:
        >>> row = {"env": "robot", "method": "iql", "seed": "0", "seconds": "30.0", "others": "n_steps=5"}
        >>> print(seed_tables([row, row | {"seed": "1", "seconds": "4.25"}]))
        **robot: seconds balanced in reality**
        <BLANKLINE>
        | variant | seed 0 | seed 1 | all 30 s |
        | --- | --- | --- | --- |
        | iql | 30 | 4.25 | 1 of 2 |
        <BLANKLINE>
    """
    rows = [row for row in rows if not at or int(row["at"]) in at]
    lines = []
    for env in sorted({row["env"] for row in rows}):
        of_env = [row for row in rows if row["env"] == env]
        for quantity, title, form in QUANTITIES:
            told = [row for row in of_env if row.get(quantity)]
            if quantity == "mean_v" and any(row.get("max_abs_x") for row in of_env):
                continue
            if told:
                lines += [f"**{env}: {title}**", "", *_table(told, quantity, form), ""]
    return "\n".join(lines)


def _table(rows: Sequence[Row], quantity: str, form: str) -> list[str]:
    seeds = sorted({row["seed"] for row in rows}, key=int)
    columns = [*VARIANT, "at"]
    differ = [column for column in columns if len({row.get(column, "") for row in rows}) > 1]
    variants: dict[str, dict[str, float]] = {}
    for row in rows:
        variants.setdefault(_name(row, differ), {})[row["seed"]] = float(row[quantity])
    whole = [f"all {EPISODE:g} s"] if quantity == "seconds" else []
    head = ["variant", *(f"seed {seed}" for seed in seeds), *whole]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for name, of_seed in variants.items():
        cells = [format(of_seed[seed], form) if seed in of_seed else "" for seed in seeds]
        if whole:
            cells.append(f"{_whole(of_seed.values())} of {len(of_seed)}")
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return lines


def _whole(seconds: Iterable[float]) -> int:
    return sum(value >= EPISODE for value in seconds)


def _name(row: Row, differ: Sequence[str]) -> str:
    """Name a run by its method and the settings in which the rows differ."""
    named = [row["method"]]
    for column in differ:
        if column == "others":
            named.append(row["others"] or "(defaults)")
        elif column != "method" and row.get(column):
            named.append(f"{column}={row[column]}")
    return " ".join(named)
