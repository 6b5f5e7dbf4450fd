"""Over all tasks of a group: interquartile mean and probability of improvement, with intervals, by rliable."""

from dataclasses import dataclass

import numpy as np
from rliable import library, metrics
from score_table import Cell, Task, normalised

BASE = "h2o_plus"


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def text(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True)
class Scores:
    """Normalised scores of some methods on the tasks and seeds that all of them have.

    Args:
        by_method: ``[num_seeds, num_tasks]`` each.
        tasks: of the columns.
        seeds: of the rows.
    """

    by_method: dict[str, np.ndarray]
    tasks: list[Task]
    seeds: list[int]


def common_scores(table: dict[Task, dict[str, Cell]]) -> Scores:
    """The largest full block of a table: the tasks that every method has, and the seeds that all of these have."""
    methods = sorted({name for cells in table.values() for name in cells})
    tasks = sorted(task for task, cells in table.items() if set(cells) == set(methods))
    of_each = [set(table[task][name].returns) for task in tasks for name in methods]
    seeds = sorted(set.intersection(*of_each)) if of_each else []

    def score(name: str, seed: int, task: Task) -> float:
        return normalised(task[0], table[task][name].returns[seed])

    by_method = {name: np.array([[score(name, seed, task) for task in tasks] for seed in seeds]) for name in methods}
    return Scores(by_method, tasks, seeds)


def interquartile_means(scores: Scores, reps: int, seed: int = 0) -> dict[str, Interval]:
    """Of each method, with an interval from seeds drawn anew within each task."""
    return _intervals(scores.by_method, lambda x: np.array([metrics.aggregate_iqm(x)]), reps, seed)


def improvements(scores: Scores, reps: int, seed: int = 0, base: str = BASE) -> dict[str, Interval]:
    """The probability that a run of ``base`` does better than one of each other method, averaged over tasks."""
    pairs = {name: (scores.by_method[base], x) for name, x in scores.by_method.items() if name != base}
    return _intervals(pairs, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]), reps, seed)


def _intervals(scores: dict, statistic, reps: int, seed: int) -> dict[str, Interval]:
    state = np.random.get_state()
    np.random.seed(seed)  # rliable draws from the global generator, whatever random_state it is given
    try:
        points, bounds = library.get_interval_estimates(scores, statistic, reps=reps)
    finally:
        np.random.set_state(state)
    return {name: Interval(float(points[name][0]), *(float(b) for b in bounds[name][:, 0])) for name in scores}
