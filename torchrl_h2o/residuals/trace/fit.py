"""Fits the parameters of effects to residuals: bounded robust least squares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from os import cpu_count

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from torchrl_h2o.effects import Effect, Parameter
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.trace.model_bounds import lowest_value
from torchrl_h2o.residuals.trace.problem import WORST, Problem, losses

# start value of every scaled variable; it makes relative steps proportional to the parameter's typical size
ORIGIN = 10.0
MAX_MOVE = 50.0  # largest change of a parameter in one fit, in multiples of its typical size
DIFFERENCE_STEP = 1e-5  # relative step of the finite differences: 1e-4 of a parameter's typical size
LOSS_TOLERANCE = 1e-5  # relative change of the loss at which the optimiser stops
VARIABLE_TOLERANCE = 1e-7  # relative change of the variables at which the optimiser stops

Free = tuple[str, ...]  # names of the parameters of one effect that a fit may move


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a joint fit.

    Args:
        effects: effects with their fitted values.
        free: names of each effect's fitted parameters.
        loss: mean robust loss over the fitted windows.
        half_widths: half-width of the 95 % interval of each fitted parameter, by effect and name, in its unit.
    """

    effects: tuple[Effect, ...]
    free: tuple[Free, ...]
    loss: float
    half_widths: tuple[dict[str, float], ...]

    def without(self, index: int) -> Fit:
        """The fit without one effect; the other values and the loss are those of the joint fit."""
        return self.only([i for i in range(len(self.effects)) if i != index])

    def only(self, indices: Sequence[int]) -> Fit:
        """The fit with some of the effects; their values and the loss are those of the joint fit."""
        effects, free, half_widths = (
            tuple(all_of_them[index] for index in indices)
            for all_of_them in (self.effects, self.free, self.half_widths)
        )
        return replace(self, effects=effects, free=free, half_widths=half_widths)

    def ci95(self, index: int) -> dict[str, tuple[float, float]]:
        """95 % intervals (low, high) of one effect's fitted parameters, in their units and within their bounds."""
        intervals = {}
        for name, half in self.half_widths[index].items():
            parameter = self.effects[index].parameters[name]
            ends = np.clip([parameter.value - half, parameter.value + half], *parameter.bounds)
            intervals[name] = (float(ends[0]), float(ends[1]))
        return intervals


def fit(
    problem: Problem,
    effects: Sequence[Effect],
    free: Sequence[Free],
    starts: np.ndarray,
    *,
    max_evaluations: int = DEFAULTS.max_evaluations,
    difference_step: float = DIFFERENCE_STEP,
) -> Fit:
    """Minimises the robust loss over the free parameters of effects, starting from their present values.

    Args:
        problem: simulation, data and scales of the residuals.
        effects: effects in the order of their composition.
        free: names of the parameters to move, for each effect.
        starts: (W), first rows of the windows to fit.
        max_evaluations: evaluations of the residual, not counting finite differences.
        difference_step: relative step of the finite differences.

    Returns:
        The fit.
    """
    allowed = [_allowed(problem, effects, index) for index in range(len(effects))]
    variables = [_Variable(index, name, allowed[index][name]) for index in range(len(effects)) for name in free[index]]

    def residual(z: np.ndarray) -> np.ndarray:
        try:
            return problem.residual(_with_values(effects, variables, z), starts).ravel()
        except ValueError:  # the model rejects these values, for example negative damping
            return np.full(len(starts) * problem.horizon * problem.scale.shape[-1], WORST)

    # rollouts that follow unobserved coordinates step by step are too small for MuJoCo's own threads
    in_threads = bool(problem.simulation.state_map.hidden)
    with ThreadPoolExecutor(cpu_count()) as threads:  # starts threads when they are used
        result = least_squares(
            residual,
            np.full(len(variables), ORIGIN),
            bounds=np.transpose([variable.bounds for variable in variables]),
            loss="soft_l1",
            diff_step=difference_step,
            ftol=LOSS_TOLERANCE,
            xtol=VARIABLE_TOLERANCE,
            max_nfev=max_evaluations,
            workers=threads.map if in_threads else None,
        )
    fitted = _with_values(effects, variables, result.x)
    widths = [{} for _ in effects]
    for variable, position, half in zip(variables, result.x, _half_widths(problem, result), strict=True):
        widths[variable.effect][variable.name] = half * variable.slope(position)
    at_best = problem.residual(fitted, starts)
    return Fit(tuple(fitted), tuple(free), float(losses(at_best).mean()), tuple(widths))


def _allowed(problem: Problem, effects: Sequence[Effect], index: int) -> dict[str, Parameter]:
    """The parameters of one of the effects, with bounds within what the model and the others leave.

    Without them, a fit that wants to take away more than the model has gets stuck where the model rejects its steps.
    """
    effect, others = effects[index], [*effects[:index], *effects[index + 1 :]]
    least = lowest_value(effect, problem.simulation.model, others)
    return {
        name: replace(one, bounds=(min(one.value, max(one.bounds[0], least)), one.bounds[1]))
        for name, one in effect.parameters.items()
    }


def _with_values(effects: Sequence[Effect], variables: Sequence[_Variable], z: np.ndarray) -> list[Effect]:
    """The effects with the parameter values that belong to scaled variables z."""
    values = [{} for _ in effects]
    for variable, position in zip(variables, z, strict=True):
        values[variable.effect][variable.name] = variable.value(position)
    return [effect.with_parameters(new) if new else effect for effect, new in zip(effects, values, strict=True)]


def _half_widths(problem: Problem, result: OptimizeResult) -> np.ndarray:
    """Half-widths of the variables' 95 % intervals, by a sandwich estimate with each window as one observation."""
    jacobian, residual = result.jac, result.fun
    size = problem.horizon * problem.scale.shape[-1]
    curvature = np.linalg.pinv(jacobian.T @ jacobian)
    # scipy scales the Jacobian by (1 + r²)^(-3/4) for the robust loss; the derivative of the loss is r / √(1 + r²)
    pull = (1.0 + residual**2) ** 0.75 * residual / np.sqrt(1.0 + residual**2)
    pulls = (jacobian * pull[:, None]).reshape(-1, size, jacobian.shape[1]).sum(1)
    covariance = curvature @ (pulls.T @ pulls) @ curvature
    return 1.96 * np.sqrt(np.maximum(np.diag(covariance), 0.0))


@dataclass(frozen=True)
class _Variable:
    """A parameter as a scaled variable: it starts at ``ORIGIN``, and a step of 1 is one typical size."""

    effect: int
    name: str
    parameter: Parameter

    @property
    def logarithmic(self) -> bool:
        return self.parameter.neutral == 1.0 and self.parameter.bounds[0] > 0.0

    @property
    def size(self) -> float:
        return typical_size(self.parameter)

    def value(self, z: float) -> float:
        low, high = self.parameter.bounds
        if self.logarithmic:
            return float(np.clip(self.parameter.value * 2.0 ** (z - ORIGIN), low, high))
        return float(np.clip(self.parameter.value + self.size * (z - ORIGIN), low, high))

    def slope(self, z: float) -> float:
        return self.value(z) * math.log(2.0) if self.logarithmic else self.size

    @property
    def bounds(self) -> tuple[float, float]:
        low, high = self.parameter.bounds
        if self.logarithmic:
            ends = np.log2(np.array([low, high]) / self.parameter.value)
        else:
            ends = (np.array([low, high]) - self.parameter.value) / self.size
        return tuple(ORIGIN + np.clip(ends, -MAX_MOVE, MAX_MOVE))


def typical_size(parameter: Parameter) -> float:
    """Typical change of a parameter, from the value at which a fit starts, in the parameter's unit."""
    if not math.isfinite(parameter.neutral):
        return abs(parameter.value) or 1.0
    return abs(parameter.value - parameter.neutral) or max(0.1 * abs(parameter.neutral), 1e-3)
