"""Interquartile mean and probability of improvement over all tasks of a group, with bootstrap intervals, by rliable.

Methods as in Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (2021), arXiv
2108.13264.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from rliable import library, metrics

from torchrl_h2o.comparison.grids import SIX
from torchrl_h2o.comparison.scores import REFERENCES, Reference, Task, normalised
from torchrl_h2o.options.train import OFFLINE

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
    """Normalised scores of several methods on their common tasks and seeds.

    Args:
        runs: scores by method, ``[num_seeds, num_runs]``. An offline method has one run for all gaps of a data set.
        columns: by method, the column index in ``runs`` for each task, ``[num_tasks]``.
        tasks: the tasks compared.
        seeds: the seed of each row of ``runs``.
    """

    runs: dict[str, np.ndarray]
    columns: dict[str, np.ndarray]
    tasks: list[Task]
    seeds: list[int]

    def by_task(self, name: str) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function from (resampled) runs of a method to its scores by task, ``[num_seeds, num_tasks]``."""
        return lambda runs: runs[:, self.columns[name]]


def common_scores(placed: pd.DataFrame, references: Mapping[str, Reference] = REFERENCES) -> Scores:
    """Select the tasks and seeds for which all of the paper's methods in the table have results.

    Methods that are not in the paper are included only if they have results for all of these tasks and seeds.

    Args:
        placed: runs from :func:`~torchrl_h2o.comparison.scores.placed`.
        references: by environment, the returns with score 0 and score 100.
    """
    returns = {key: runs.set_index("seed")["return_mean"] for key, runs in placed.groupby(["task", "method"])}
    has = {key: set(values.index) for key, values in returns.items()}  # seeds by task and method
    present = sorted({method for _, method in has})
    methods = [name for name in SIX if name in present] or present
    tasks = sorted(task for task in {task for task, _ in has} if all((task, name) in has for name in methods))
    seeds = sorted(set.intersection(*(has[task, name] for task in tasks for name in methods))) if tasks else []
    methods += [
        name for name in present
        if name not in methods and all(set(seeds) <= has.get((task, name), set()) for task in tasks)
    ]  # fmt: skip
    runs, columns = {}, {}
    for name in methods if tasks else []:
        # an offline method's run does not depend on the gap
        seen = [(*task[:2], "" if name in OFFLINE else task[2], *task[3:]) for task in tasks]
        own = dict(zip(seen, tasks, strict=True))  # one task for each distinct run
        scores = [normalised(returns[task, name][seeds].to_numpy(), references[task[0]]) for task in own.values()]
        runs[name] = np.array(scores).T
        columns[name] = np.array([list(own).index(run) for run in seen], dtype=int)
    return Scores(runs, columns, tasks, seeds)


def interquartile_means(scores: Scores, reps: int, seed: int = 0) -> dict[str, Interval]:
    """Interquartile mean of each method, with a bootstrap interval over its seeds.

    Args:
        scores: normalised scores.
        reps: number of bootstrap samples.
        seed: random seed of the bootstrap.
    """

    def statistic(name: str) -> Callable:
        spread = scores.by_task(name)
        return lambda x: np.array([metrics.aggregate_iqm(spread(x))])

    return {name: _interval(runs, statistic(name), reps, seed) for name, runs in scores.runs.items()}


def mean_of_runs(values: Sequence[float], reps: int, seed: int = 0) -> Interval:
    """Mean of one method's runs, with a bootstrap interval over its seeds; of a single run, the interval is a point.

    Args:
        values: one per run.
        reps: number of bootstrap samples.
        seed: random seed of the bootstrap.

    Example:
        >>> mean_of_runs([1.0, 2.0, 3.0], reps=100).value
        2.0
    """
    runs = np.array(values, dtype=float)[:, None]
    if len(runs) == 1:
        return Interval(*[float(runs[0, 0])] * 3)
    return _interval(runs, lambda x: np.array([metrics.aggregate_mean(x)]), reps, seed)


def improvements(scores: Scores, reps: int, seed: int = 0, base: str = BASE) -> dict[str, Interval]:
    """Probability that a run of ``base`` has a higher score than a run of each other method, averaged over tasks.

    Args:
        scores: normalised scores.
        reps: number of bootstrap samples.
        seed: random seed of the bootstrap.
        base: the method that the others are compared with.
    """

    def statistic(name: str) -> Callable:
        ours, theirs = scores.by_task(base), scores.by_task(name)
        return lambda x, y: np.array([metrics.probability_of_improvement(ours(x), theirs(y))])

    others = {name: runs for name, runs in scores.runs.items() if name != base}
    return {name: _interval((scores.runs[base], runs), statistic(name), reps, seed) for name, runs in others.items()}


def _interval(runs: np.ndarray | tuple[np.ndarray, ...], statistic: Callable, reps: int, seed: int) -> Interval:
    state = np.random.get_state()
    np.random.seed(seed)  # rliable ignores random_state and draws from the global generator
    try:
        scores: Mapping[str, Any] = {"": runs}  # rliable accepts a tuple too, although it annotates a list
        points, bounds = library.get_interval_estimates(scores, statistic, reps=reps)
    finally:
        np.random.set_state(state)
    return Interval(float(points[""][0]), *(float(bound) for bound in bounds[""][:, 0]))
