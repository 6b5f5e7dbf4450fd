"""Finds an effect that nobody declared: a force made of terms, for what no entry of a catalogue explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.effects import ResidualForce
from torchrl_h2o.effects.force.residual_force import degrees_of_freedom
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.fit import Fit, fit
from torchrl_h2o.residuals.trace.problem import Problem, losses
from torchrl_h2o.residuals.trace.significance import p_value_of_losses
from torchrl_h2o.residuals.undeclared.inverse_force import force_response, residual_forces, step_path
from torchrl_h2o.residuals.undeclared.sparse_force import SparseForce, sparse_force
from torchrl_h2o.residuals.undeclared.terms import TermLibrary

_LEVEL = 0.01
_PAYS = 0.01  # share of the held-out loss that all terms must take away
_ADDS = 0.002  # share of the loss that a round of terms must take away, and that a term may not cost when taken out
_ROUNDS = 6
_FURTHER = 5  # steps ahead
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
    progress: Callable[[str], object] | None = None,
) -> Undeclared | None:
    """Finds a force that explains what the simulation, with all effects found so far, does not.

    The residual is read as a force on each degree of freedom and regressed, sparsely, on a library of terms. The terms
    found are then fitted in the simulation, to the residual itself, and those that are not needed are taken out. The
    result must pay on held-out data: the one-sided tests of the search, paired over blocks of neighbouring transitions,
    at 1 %, and at least 1 % of the loss, one step ahead and further. Further, because noise of the sensors has a bias
    one step ahead that terms can imitate: they pay there, and do harm where the simulation runs on.

    Args:
        simulation: with all effects found so far.
        measured: the data.
        progress: called with what has been found so far, in words, after each round.

    Returns:
        The effect, None if there is none that pays.
    """
    problem = Problem.pose(simulation, measured)
    search = _Search(problem, measured.fitted())
    if search.nothing_to_explain():
        return None
    found = search.run(progress or (lambda words: None))
    if found is None:
        return None
    judged = measured.judged()
    before, after = problem.residual((), judged), problem.residual(found.effects, judged)
    gain = losses(before) - losses(after)
    p = max(p_value_of_losses(losses(before), losses(after)), search.chance_further((), found.effects, held_out=True))
    if p > _LEVEL or gain.mean() < _PAYS * losses(before).mean():
        return None
    size = problem.scale_of(judged)
    errors = [np.sqrt(((size * residual)[:, 0] ** 2).mean(0)) for residual in (before, after)]
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
        self.further = Problem.pose(simulation, measured, _FURTHER, sensor_std=self.problem.sensor_std)
        self.before = losses(self.problem.residual((), self.starts)).mean()

    def nothing_to_explain(self) -> bool:
        """Whether the residual is but rounding."""
        spread = np.maximum(self.problem.measured.observation.std(0), 1e-12)
        return bool((self.problem.scale_of(self.starts).mean((0, 1)) < _NOTHING * spread).all())

    def run(self, progress: Callable[[str], object]) -> Fit | None:
        """Adds terms while they pay, refits all of them together, and takes out what is not needed."""
        best, left = None, self.before
        barred = set()  # degrees of freedom on which a term did not pay
        for _ in range(_ROUNDS):
            effect = best.effects[0] if best else ResidualForce()
            added = self._added(effect, barred)
            if left < _ADDS * self.before or not added.terms or len(effect.terms) >= _MOST_TERMS:
                break
            candidate = self._pruned(self._fitted(ResidualForce((*effect.terms, *map(str, added.terms)))))
            pays = left - candidate.loss > _ADDS * self.before
            if pays and self.chance_further((effect,), candidate.effects, held_out=False) < _LEVEL:
                best, left = candidate, candidate.loss
                progress(best.effects[0].describe())
            else:
                barred.add(added.terms[0].joint)
        return best

    def chance_further(
        self, before: Sequence[ResidualForce], after: Sequence[ResidualForce], *, held_out: bool
    ) -> float:
        """How likely chance alone makes one force better than another, some steps ahead."""
        measured = self.problem.measured
        starts = measured.judged(_FURTHER) if held_out else measured.fitted(_FURTHER)
        return p_value_of_losses(*(losses(self.further.residual(forces, starts)) for forces in (before, after)))

    def _added(self, effect: ResidualForce, barred: set[str]) -> SparseForce:
        """The terms, on one degree of freedom, that explain most of what an effect leaves."""
        simulation = self.problem.simulation
        residual = (self.problem.residual((effect,), self.starts) * self.problem.scale_of(self.starts))[:, 0]
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
            if freedom.name not in barred
        ]
        return max(found, key=lambda candidate: candidate.gain, default=SparseForce())

    def _fitted(self, effect: ResidualForce) -> Fit:
        free = tuple(name for name in effect.parameters if not name.startswith("start"))
        return fit(self.problem, (effect,), (free,), self.starts)

    def _pruned(self, best: Fit) -> Fit:
        """Takes out, one by one, the terms that explain least, while the others make up for them."""
        while len(terms := best.effects[0].terms) > 1:
            rest = [ResidualForce(terms[:i] + terms[i + 1 :]) for i in range(len(terms))]
            alone = [losses(self.problem.residual((effect,), self.starts)).mean() for effect in rest]
            candidate = self._fitted(rest[int(np.argmin(alone))])
            if candidate.loss - best.loss > _ADDS * (self.before - best.loss):
                break
            best = candidate
        return best
