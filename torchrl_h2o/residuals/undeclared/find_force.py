"""Finds a force outside the catalogue: a sum of terms, regressed on the residual and fitted in the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from torchrl_h2o.effects import ActionBacklash, ActionDeadBand, ActionSaturation, Effect, Pipeline, ResidualForce
from torchrl_h2o.effects.force.residual_force import coordinate, degrees_of_freedom
from torchrl_h2o.effects.force.term import Factor, ForceTerm
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.fit import Fit, fit
from torchrl_h2o.residuals.trace.problem import Problem, losses
from torchrl_h2o.residuals.trace.significance import p_value_of_losses
from torchrl_h2o.residuals.undeclared.inverse_force import StepPath, force_response, residual_forces, step_path
from torchrl_h2o.residuals.undeclared.sparse_force import SparseForce, sparse_force
from torchrl_h2o.residuals.undeclared.terms import TermLibrary

MIN_GAIN = 0.01  # share of the held-out loss that all terms of the force must explain
# share of the loss that a round must explain; removing a term may cost this share of the explained loss
MIN_TERM_GAIN = 0.002
ROUNDS = 6  # largest number of rounds of adding terms
FURTHER_STEPS = 5  # control steps ahead at which the force must also lower the loss; a fit to sensor noise does not
MAX_TERMS = 6  # largest number of terms of the whole force
# largest phase, in rad, that a wave runs through over the measured positions for a line to be tried instead
STRAIGHT = 1.0
NEGLIGIBLE = 1e-6  # residual, in spreads, that counts as rounding


@dataclass(frozen=True, eq=False)
class Undeclared:
    """A force outside the catalogue.

    Args:
        effect: the force.
        ci95: 95 % interval (low, high) of each fitted parameter, in its unit.
        error_before: (n), held-out RMSE of each dimension at the end of a window without the force, in its unit.
        error_after: (n), the same with the force.
        p_value: p-value of the decrease of the held-out loss.
    """

    effect: ResidualForce
    ci95: Mapping[str, tuple[float, float]]
    error_before: np.ndarray
    error_after: np.ndarray
    p_value: float


def find_undeclared(
    simulation: Simulation,
    measured: Measured,
    horizon: int = 1,
    *,
    settings: LoopSettings = DEFAULTS,
) -> Undeclared | None:
    """Finds a force that explains the residual of a simulation with all effects found so far.

    The residual is converted to a force on each degree of freedom and regressed, sparsely, on a library of terms. The
    terms are then fitted in the simulation to the residual itself, and redundant ones are removed. The force must lower
    the held-out loss by a minimum share and significantly, one step ahead and several steps ahead: terms can
    imitate a bias that sensor noise causes one step ahead, but such terms increase the error further ahead.

    Args:
        simulation: the simulator with all effects found so far.
        measured: the data.
        horizon: control steps per window on which the force is fitted and judged. With noisy sensors, a weak force
            shows only in long windows.
        settings: thresholds and budgets.

    Returns:
        The force; None if none passes the tests.
    """
    problem = Problem.pose(simulation, measured)
    if _nothing_to_explain(problem, measured.fitted()):
        return None
    regression = _Regression.of(problem, horizon, settings)
    found = _grown(regression)
    if found is None:
        return None
    objective, judged = regression.objective, measured.selected_on(horizon)
    before, after = objective.residual((), judged), objective.residual(found.effects, judged)
    gain = losses(before) - losses(after)
    p_of_windows = p_value_of_losses(losses(before), losses(after), settings)
    p = max(p_of_windows, _p_value_further(regression, (), found.effects, held_out=True))
    if p > settings.level or gain.mean() < MIN_GAIN * losses(before).mean():
        return None
    size = objective.scale_of(judged)
    error_before, error_after = (np.sqrt(((size * residual)[:, -1] ** 2).mean(0)) for residual in (before, after))
    return Undeclared(_force_of(found), found.ci95(0), error_before, error_after, p)


@dataclass(frozen=True, eq=False)
class _Regression:
    """The data of the regression, on the transitions that may be fitted.

    Args:
        problem: one-step residuals of the simulation, for the regression.
        objective: residuals for the fits and the judgement: one step, or long windows.
        further: residuals several steps ahead.
        starts: (W), the transitions.
        path: states and controls within each transition.
        response: (W, n, nv), derivative of the observation by the generalised forces.
        before: mean robust loss without a force.
        settings: thresholds and budgets.
    """

    problem: Problem
    objective: Problem
    further: Problem
    starts: np.ndarray
    path: StepPath
    response: np.ndarray
    before: float
    settings: LoopSettings

    @classmethod
    def of(cls, problem: Problem, horizon: int, settings: LoopSettings) -> _Regression:
        simulation, measured, states = problem.simulation, problem.measured, problem.states
        starts, std = measured.fitted(), problem.sensor_std
        pose = partial(Problem.pose, simulation, measured, sensor_std=std)
        objective = problem if horizon == 1 else pose(horizon)
        return cls(
            problem,
            objective,
            pose(FURTHER_STEPS),
            starts,
            step_path(simulation, measured, starts, states=states),
            force_response(simulation, measured, starts, states=states),
            losses(objective.residual((), measured.fitted(horizon))).mean(),
            settings,
        )


def _nothing_to_explain(problem: Problem, starts: np.ndarray) -> bool:
    """Whether the residual is within rounding."""
    spread = np.maximum(problem.measured.observation.std(0), 1e-12)
    return bool((problem.scale_of(starts).mean((0, 1)) < NEGLIGIBLE * spread).all())


def _grown(regression: _Regression) -> Fit | None:
    """Adds terms while they lower the loss enough.

    After each addition, all terms are fitted again. Redundant ones are removed, nearly straight waves become lines.
    """
    level = regression.settings.level
    best, left = None, regression.before
    barred = set()  # degrees of freedom on which a new term did not lower the loss enough
    for _ in range(ROUNDS):
        effect = _force_of(best) if best else ResidualForce()
        added = _best_terms(regression, effect, barred)
        exhausted = left < MIN_TERM_GAIN * regression.before
        if exhausted or not added.terms or len(effect.terms) >= MAX_TERMS:
            break
        candidate = _pruned(regression, _fitted(regression, ResidualForce((*effect.terms, *map(str, added.terms)))))
        candidate = _straightened(regression, candidate)
        pays = left - candidate.loss > MIN_TERM_GAIN * regression.before
        if pays and _p_value_further(regression, (effect,), candidate.effects, held_out=False) < level:
            best, left = candidate, candidate.loss
        else:
            barred.add(added.terms[0].joint)
    return best


def _p_value_further(
    regression: _Regression, before: Sequence[Effect], after: Sequence[Effect], *, held_out: bool
) -> float:
    """p-value of the decrease of the loss several steps ahead, from one force to another."""
    measured, steps = regression.problem.measured, FURTHER_STEPS
    starts = measured.selected_on(steps) if held_out else measured.fitted(steps)
    loss_before, loss_after = (losses(regression.further.residual(forces, starts)) for forces in (before, after))
    return p_value_of_losses(loss_before, loss_after, regression.settings)


def _best_terms(regression: _Regression, effect: ResidualForce, barred: set[str]) -> SparseForce:
    """The terms on one degree of freedom that explain most of the residual that remains with a force."""
    problem, starts = regression.problem, regression.starts
    simulation = problem.simulation
    residual = (problem.residual((effect,), starts) * problem.scale_of(starts))[:, 0]
    forces = residual_forces(simulation, problem.measured, starts, residual=residual, response=regression.response)
    observed = cast("np.ndarray", simulation.state_map.restore.any(1))
    bent = _bent_controls(simulation, problem.measured.action[starts])
    found = [
        sparse_force(
            TermLibrary(freedom, regression.path, observed, bent),
            forces.force[:, freedom.velocity],
            forces.weight[:, freedom.velocity],
        )
        for freedom in degrees_of_freedom(simulation.model)
        if freedom.name not in barred
    ]
    return max(found, key=lambda candidate: candidate.gain, default=SparseForce())


def _bent_controls(simulation: Simulation, actions: np.ndarray) -> list[int]:
    """The controls that a saturation, dead band or backlash of the simulator changes for some of the actions (W, nu).

    Powers of such a control imitate the effect; a fit of both would leave the values of both open.
    """
    bending = ActionSaturation | ActionDeadBand | ActionBacklash
    changed = np.zeros(simulation.model.nu, bool)
    for effect in simulation.effects:
        if isinstance(effect, bending):
            executed = Pipeline((effect,)).executed_run(actions, simulation.control_step)
            changed |= (executed != actions).any(0)
    return np.flatnonzero(changed).tolist()


def _force_of(fitted: Fit) -> ResidualForce:
    """Returns the force of a fit that has no other effect."""
    return cast("ResidualForce", fitted.effects[0])


def _fitted(regression: _Regression, effect: ResidualForce) -> Fit:
    """The force fitted in the simulation; start times of steps are not fitted."""
    free = tuple(name for name in effect.parameters if not name.startswith("start"))
    objective = regression.objective
    starts = objective.measured.fitted(objective.horizon)
    return fit(objective, (effect,), (free,), starts, max_evaluations=regression.settings.max_evaluations)


def _pruned(regression: _Regression, best: Fit) -> Fit:
    """Removes the term that explains least, as long as the loss hardly increases."""
    problem = regression.objective
    starts = problem.measured.fitted(problem.horizon)
    while len(terms := _force_of(best).terms) > 1:
        rest = [ResidualForce(terms[:i] + terms[i + 1 :]) for i in range(len(terms))]
        alone = [losses(problem.residual((effect,), starts)).mean() for effect in rest]
        candidate = _fitted(regression, rest[int(np.argmin(alone))])
        cost = candidate.loss - best.loss
        if cost > MIN_TERM_GAIN * (regression.before - best.loss):
            break
        best = candidate
    return best


def _straightened(regression: _Regression, best: Fit) -> Fit:
    """Replaces waves that are nearly straight over the measured positions by lines if these fit as well.

    0.68 · sin(0.12 q) is 0.08 · q for angles of less than a turn, and a reader knows what a spring is.
    """
    terms = [part for term in _force_of(best).parsed for part in _line_of(term, regression)]
    simpler: dict[tuple, ForceTerm] = {}
    for term in terms:
        same = simpler.get((term.joint, term.factors), replace(term, coefficient=0.0))
        simpler[term.joint, term.factors] = replace(term, coefficient=same.coefficient + term.coefficient)
    effect = ResidualForce(tuple(map(str, simpler.values())))
    if effect == _force_of(best):
        return best
    candidate = _pruned(regression, _fitted(regression, effect))
    cost = candidate.loss - best.loss
    if len(_force_of(candidate).terms) > max(len(_force_of(best).terms), MAX_TERMS):
        return best
    return best if cost > MIN_TERM_GAIN * (regression.before - best.loss) else candidate


def _line_of(term: ForceTerm, regression: _Regression) -> tuple[ForceTerm, ...]:
    """A constant and a line in the place of a wave that is nearly straight; any other term as it is."""
    *carrier, last = term.factors or (None,)
    if last is None or last.function != "sin" or last.coordinate != "q":
        return (term,)
    path, freedoms = regression.path, degrees_of_freedom(regression.problem.simulation.model)
    freedom = next(one for one in freedoms if one.name == term.joint)
    position = coordinate("q", freedom, path.qpos, path.qvel, path.ctrl, path.time)
    frequency, phase = last.numbers
    if abs(frequency) * np.ptp(position) > STRAIGHT:
        return (term,)
    constant = replace(term, coefficient=term.coefficient * np.sin(phase), factors=tuple(carrier))
    slope = term.coefficient * frequency * np.cos(phase)
    return constant, replace(term, coefficient=slope, factors=(*carrier, Factor("power", "q")))
