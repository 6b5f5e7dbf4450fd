"""Finds an effect that nobody declared: a force made of terms, for what no entry of a catalogue explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.effects import ResidualForce
from torchrl_h2o.effects.residual_force import degrees_of_freedom
from torchrl_h2o.residuals.fit import Fit, Problem, fit, losses
from torchrl_h2o.residuals.forces import force_response, residual_forces, step_path
from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.significance import p_value
from torchrl_h2o.residuals.simulation import Simulation
from torchrl_h2o.residuals.sparse_force import SparseForce, sparse_force
from torchrl_h2o.residuals.terms import TermLibrary

IN_WORDS = "a one-sided t-test on the held-out loss, paired over blocks of neighbouring transitions, at 1 %"
_LEVEL = 0.01
_PAYS = 0.01  # share of the loss that a term, or all of them, must take away
_ROUNDS = 4
_MOST_TERMS = 6
_NOTHING = 1e-6  # residual, in spreads, that rounding leaves


@dataclass(frozen=True, eq=False)
class Undeclared:
    """A force that no catalogue holds, found in the residual.

    Args:
        effect: the force.
        ci95: the 95 % interval of each of its parameters that was fitted, (low, high) in the parameter's unit.
        error_before: (n), held-out one-step RMSE of each dimension without it, in the dimension's unit.
        error_after: (n), with it.
        p_value: how likely chance alone explains as much of the held-out data.
    """

    effect: ResidualForce
    ci95: Mapping[str, tuple[float, float]]
    error_before: np.ndarray
    error_after: np.ndarray
    p_value: float


def find_undeclared(
    simulation: Simulation,
    measured: Measured,
    *,
    states: np.ndarray | None = None,
    progress: Callable[[str], object] | None = None,
) -> Undeclared | None:
    """Finds a force that explains what the simulation, with all effects found so far, does not.

    The residual is read as a force on each degree of freedom and regressed, sparsely, on a library of terms. The terms
    found are then fitted in the simulation, to the residual itself, and those that are not needed are taken out. The
    result must pay on held-out data: a one-sided t-test, paired over blocks of neighbouring transitions, at 1 %, and at
    least 1 % of the loss.

    Args:
        simulation: with all effects found so far.
        measured: the data.
        states: (T, nq + nv), to start from instead of the measured ones.
        progress: called with what has been found so far, in words, after each round.

    Returns:
        The effect, None if there is none that pays.
    """
    problem = Problem.pose(simulation, measured, states=states)
    search = _Search(problem, measured.windows(1, held_out=False))
    if search.nothing_to_explain():
        return None
    found = search.run(progress or (lambda words: None))
    if found is None:
        return None
    judged = measured.windows(1, held_out=True)
    before, after = problem.residual((), judged), problem.residual(found.effects, judged)
    gain = losses(before) - losses(after)
    p = p_value(gain)
    if p > _LEVEL or gain.mean() < _PAYS * losses(before).mean():
        return None
    errors = [problem.scale * np.sqrt((residual[:, 0] ** 2).mean(0)) for residual in (before, after)]
    return Undeclared(found.effects[0], found.ci95(0), *errors, p)


@dataclass(eq=False)
class _Search:
    """A search for terms on the transitions that may be fitted."""

    problem: Problem
    starts: np.ndarray

    def __post_init__(self):
        simulation, measured, states = self.problem.simulation, self.problem.measured, self.problem.states
        self.path = step_path(simulation, measured, self.starts, states=states)
        self.response = force_response(simulation, measured, self.starts, states=states)
        self.before = losses(self.problem.residual((), self.starts)).mean()

    def nothing_to_explain(self) -> bool:
        """Whether the residual is but rounding."""
        measured = self.problem.measured
        spread = np.maximum(measured.observation.std(0), 1e-12)
        return bool((self.problem.scale < _NOTHING * spread).all())

    def run(self, progress: Callable[[str], object]) -> Fit | None:
        """Adds terms while they pay, refits all of them together, and takes out what is not needed."""
        best, left = None, self.before
        for _ in range(_ROUNDS):
            effect = best.effects[0] if best else ResidualForce()
            added = self._added(effect)
            if not added.terms:
                break
            candidate = self._pruned(self._fitted(ResidualForce((*effect.terms, *map(str, added.terms)))))
            if left - candidate.loss < _PAYS * self.before:
                break
            best, left = candidate, candidate.loss
            progress(best.effects[0].describe())
            if len(best.effects[0].terms) >= _MOST_TERMS:
                break
        return best

    def _added(self, effect: ResidualForce) -> SparseForce:
        """The terms, on one degree of freedom, that explain most of what an effect leaves."""
        simulation = self.problem.simulation
        residual = self.problem.residual((effect,), self.starts)[:, 0] * self.problem.scale
        forces = residual_forces(
            simulation, self.problem.measured, self.starts, residual=residual, response=self.response
        )
        observed = simulation.state_map.restore.any(1)
        found = [
            sparse_force(
                TermLibrary(freedom, self.path, observed),
                forces.force[:, freedom.velocity],
                forces.weight[:, freedom.velocity],
            )
            for freedom in degrees_of_freedom(simulation.model)
        ]
        return max(found, key=lambda candidate: candidate.gain)

    def _fitted(self, effect: ResidualForce) -> Fit:
        free = tuple(name for name in effect.parameters if not name.startswith("start"))
        return fit(self.problem, (effect,), (free,), self.starts)

    def _pruned(self, best: Fit) -> Fit:
        """Takes out, one by one, the terms that explain least, while the others make up for them."""
        while len(terms := best.effects[0].terms) > 1:
            rest = [ResidualForce(terms[:i] + terms[i + 1 :]) for i in range(len(terms))]
            alone = [losses(self.problem.residual((effect,), self.starts)).mean() for effect in rest]
            candidate = self._fitted(rest[int(np.argmin(alone))])
            if candidate.loss - best.loss > _PAYS * (self.before - best.loss):
                break
            best = candidate
        return best
