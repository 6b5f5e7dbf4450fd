"""Over all tasks of a group: interquartile mean and probability of improvement, with intervals, by rliable."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from rliable import library, metrics

from torchrl_h2o.comparison.grids import OFFLINE, SIX
from torchrl_h2o.comparison.scores import REFERENCES, Cell, Reference, Task, normalised

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
        runs: by method, ``[num_seeds, num_runs]``. A method without simulator has one run for all gaps of its data.
        columns: by method, which of its runs each task reads, ``[num_tasks]``.
        tasks: that are compared.
        seeds: of the rows.
    """

    runs: dict[str, np.ndarray]
    columns: dict[str, np.ndarray]
    tasks: list[Task]
    seeds: list[int]

    def by_task(self, name: str) -> Callable[[np.ndarray], np.ndarray]:
        """What spreads a method's runs, or runs drawn anew of them, over the tasks: ``[num_seeds, num_tasks]``."""
        return lambda runs: runs[:, self.columns[name]]


def common_scores(table: dict[Task, dict[str, Cell]], references: Mapping[str, Reference] = REFERENCES) -> Scores:
    """The tasks that every method of the paper has that is there at all, and the seeds that they all have in these.

    Further methods are in if they have all of these tasks and seeds.
    """
    there = {name for cells in table.values() for name in cells}
    methods = [name for name in SIX if name in there] or sorted(there)
    tasks = sorted(task for task, cells in table.items() if set(methods) <= set(cells))
    seeds = sorted(set.intersection(*(set(table[t][m].returns) for t in tasks for m in methods))) if tasks else []
    further = sorted(there - set(methods))
    methods += [m for m in further if all(m in table[t] and set(seeds) <= set(table[t][m].returns) for t in tasks)]
    runs, columns = {}, {}
    for name in methods:
        seen = [_seen(name, task) for task in tasks]
        own = dict(zip(seen, tasks, strict=True))  # one task of each run's
        cells = [(task[0], table[task][name]) for task in own.values()]
        runs[name] = np.array([[normalised(cell.returns[s], references[env]) for env, cell in cells] for s in seeds])
        columns[name] = np.array([list(own).index(run) for run in seen], dtype=int)
    return Scores(runs, columns, tasks, seeds)


def _seen(name: str, task: Task) -> Task:
    """What of a task a method's run depends on: without a simulator, not on its gap."""
    env, data, gap, *variant = task
    return (env, data, "" if name in OFFLINE else gap, *variant)


def interquartile_means(scores: Scores, reps: int, seed: int = 0) -> dict[str, Interval]:
    """Of each method, with an interval from runs drawn anew among the seeds."""

    def statistic(name: str) -> Callable:
        spread = scores.by_task(name)
        return lambda x: np.array([metrics.aggregate_iqm(spread(x))])

    return {name: _interval(runs, statistic(name), reps, seed) for name, runs in scores.runs.items()}


def improvements(scores: Scores, reps: int, seed: int = 0, base: str = BASE) -> dict[str, Interval]:
    """The probability that a run of ``base`` does better than one of each other method, averaged over tasks."""

    def statistic(name: str) -> Callable:
        ours, theirs = scores.by_task(base), scores.by_task(name)
        return lambda x, y: np.array([metrics.probability_of_improvement(ours(x), theirs(y))])

    others = {name: runs for name, runs in scores.runs.items() if name != base}
    return {name: _interval((scores.runs[base], runs), statistic(name), reps, seed) for name, runs in others.items()}


def _interval(runs: np.ndarray | tuple[np.ndarray, ...], statistic: Callable, reps: int, seed: int) -> Interval:
    state = np.random.get_state()
    np.random.seed(seed)  # rliable draws from the global generator, whatever random_state it is given
    try:
        points, bounds = library.get_interval_estimates({"": runs}, statistic, reps=reps)
    finally:
        np.random.set_state(state)
    return Interval(float(points[""][0]), *(float(bound) for bound in bounds[""][:, 0]))
