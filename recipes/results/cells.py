"""What the pages' tables have in common: stored runs as rows, the known machines and families, and numbers in cells."""

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from scipy.stats import binomtest

from torchrl_h2o.comparison.records import Record

HERE = Path(__file__).parent
NOT_RUN = "not run on this code"
Runs = Mapping[str, pd.DataFrame]  # by table, a row for each record


def frame(records: Iterable[Record]) -> pd.DataFrame:
    """Arrange the records of one table as rows: their names, values, commits, processors and CPU minutes."""
    made_by = ("commit", "instruction_set")
    rows = []
    for record in records:
        told = {key: record.made_by[key] or "unknown" for key in made_by}
        rows.append({"run": record.name, **record.values, **told, "minutes": record.made_by["cpu_s"] / 60})
    return pd.DataFrame(rows)


@cache
def machines() -> dict[str, dict[str, Any]]:
    return yaml.safe_load((HERE / "machines.yaml").read_text())


@cache
def drawn_families() -> dict[str, dict[str, Any]]:
    return yaml.safe_load((HERE / "drawn.yaml").read_text())


def share(right: int, of: int) -> str:
    """A number of cases with the 95 % interval of Wilson of their share.

    Example:
        >>> share(9, 10)
        '9 of 10 [60, 98 %]'
    """
    if not of:
        return ""
    low, high = binomtest(int(right), int(of)).proportion_ci(method="wilson")
    return f"{right} of {of} [{100 * low:.0f}, {100 * high:.0f} %]"


def number(value: float) -> str:
    return f"{value:.3g}"
