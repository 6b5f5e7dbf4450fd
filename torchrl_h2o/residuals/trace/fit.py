"""Fits the parameters of effects to residuals: bounded least squares with a robust loss, by ``mujoco.sysid``."""

from __future__ import annotations

import contextlib
import io
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mujoco import sysid

from torchrl_h2o.effects import Effect, Parameter
from torchrl_h2o.residuals.trace.problem import WORST, Problem, losses

Free = tuple[str, ...]  # the names of the parameters of one effect that a fit may move

_ORIGIN = 10.0  # a fit's variables start here, so that relative steps are steps of their own size
_FARTHEST = 50.0  # steps of its own size that one fit may move a variable
_STEP = 1e-5  # relative, of finite differences: 1e-4 of a parameter's typical size


@dataclass(frozen=True, eq=False)
class Fit:
    """A list of effects, fitted.

    Args:
        effects: with their values.
        free: the parameters of each that were moved.
        loss: mean robust loss over the windows that were fitted.
        half_widths: of the 95 % interval of each moved parameter, by effect and name.
    """

    effects: tuple[Effect, ...]
    free: tuple[Free, ...]
    loss: float
    half_widths: tuple[dict[str, float], ...]

    def ci95(self, index: int) -> dict[str, tuple[float, float]]:
        """The 95 % intervals of the parameters of one effect."""
        parameters = self.effects[index].parameters
        return {
            name: (float(parameters[name].value - half), float(parameters[name].value + half))
            for name, half in self.half_widths[index].items()
        }


def fit(
    problem: Problem,
    effects: Sequence[Effect],
    free: Sequence[Free],
    starts: np.ndarray,
    *,
    max_evaluations: int = 25,
) -> Fit:
    """Moves the free parameters of effects, from the values that they have, to the least robust loss.

    Args:
        problem: what to explain.
        effects: in the order in which they compose.
        free: the parameters to move, for each effect.
        starts: (W), first rows of the windows to fit.
        max_evaluations: of the residual, not counting finite differences.

    Returns:
        The fit.
    """
    variables = [
        _Variable(index, name, effect.parameters[name]) for index, effect in enumerate(effects) for name in free[index]
    ]

    def put(z: np.ndarray) -> list[Effect]:
        values = [{} for _ in effects]
        for variable, position in zip(variables, z, strict=True):
            values[variable.effect][variable.name] = variable.value(position)
        return [effect.with_parameters(new) if new else effect for effect, new in zip(effects, values, strict=True)]

    def residual(z: np.ndarray, _: sysid.ParameterDict) -> tuple:
        try:
            return [problem.residual(put(z), starts).ravel()], None, None
        except ValueError:  # values that the model cannot have, such as damping below zero
            return [np.full(len(starts) * problem.horizon * problem.scale.shape[-1], WORST)], None, None

    unknown = sysid.ParameterDict(
        {str(i): sysid.Parameter(str(i), _ORIGIN, *variable.bounds) for i, variable in enumerate(variables)}
    )
    with _quiet():
        best, result = sysid.optimize(
            unknown,
            residual,
            "scipy",
            verbose=False,
            max_iters=max_evaluations,
            loss="soft_l1",
            diff_step=_STEP,
            ftol=1e-5,
            xtol=1e-7,
        )
    fitted = put(best.as_vector())
    widths = [{} for _ in effects]
    for variable, position, half in zip(variables, best.as_vector(), _half_widths(problem, result), strict=True):
        widths[variable.effect][variable.name] = half * variable.slope(position)
    at_best = problem.residual(fitted, starts)
    return Fit(tuple(fitted), tuple(free), float(losses(at_best).mean()), tuple(widths))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps ``mujoco.sysid`` quiet: it prints every iteration, whatever it is told, and warns of starts at a bound."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        logger.setLevel(level)


def _half_widths(problem: Problem, result) -> np.ndarray:
    """Half of the 95 % interval of each variable, from the curvature and from how windows differ (a sandwich).

    Residuals of one window belong together, so they count as one observation.
    """
    jacobian, residual = result.jac, result.fun
    size = problem.horizon * problem.scale.shape[-1]
    curvature = np.linalg.pinv(jacobian.T @ jacobian)
    # scipy returns the Jacobian of the robust loss, scaled by (1 + r²)^(-3/4); the pull of a residual is r / √(1 + r²)
    pull = (1.0 + residual**2) ** 0.75 * residual / np.sqrt(1.0 + residual**2)
    pulls = (jacobian * pull[:, None]).reshape(-1, size, jacobian.shape[1]).sum(1)
    covariance = curvature @ (pulls.T @ pulls) @ curvature
    return 1.96 * np.sqrt(np.maximum(np.diag(covariance), 0.0))


@dataclass(frozen=True)
class _Variable:
    """A parameter as the optimiser moves it: about 10, a step of 1 is a step of the parameter's own size."""

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
            return float(np.clip(self.parameter.value * 2.0 ** (z - _ORIGIN), low, high))
        return float(np.clip(self.parameter.value + self.size * (z - _ORIGIN), low, high))

    def slope(self, z: float) -> float:
        return self.value(z) * math.log(2.0) if self.logarithmic else self.size

    @property
    def bounds(self) -> tuple[float, float]:
        low, high = self.parameter.bounds
        if self.logarithmic:
            ends = np.log2(np.array([low, high]) / self.parameter.value)
        else:
            ends = (np.array([low, high]) - self.parameter.value) / self.size
        return tuple(_ORIGIN + np.clip(ends, -_FARTHEST, _FARTHEST))


def typical_size(parameter: Parameter) -> float:
    """How large a change of a parameter is, from the value that a fit starts from."""
    if not math.isfinite(parameter.neutral):
        return abs(parameter.value) or 1.0
    return abs(parameter.value - parameter.neutral) or max(0.1 * abs(parameter.neutral), 1e-3)
