"""Fits the values of a set of effects by the score, with the simulator itself: robust Gauss-Newton steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.likelihood import log_density
from torchrl_h2o.residuals.between_logs import InLogs
from torchrl_h2o.residuals.intervals import spreads_of
from torchrl_h2o.residuals.model_bounds import lowest_value
from torchrl_h2o.residuals.score import Predictions, fitted_scales, scores
from torchrl_h2o.residuals.whitened import Whitened, flat, weights, whitened

STEP = 0.02  # step of the finite differences, in typical sizes of a parameter
SMALLEST_GAIN = 1e-2  # gain of the score, in nats a block, below which a fit has converged
FARTHEST = 3.0  # largest move of a parameter in one step of the fit, in typical sizes
FARTHEST_FACTOR = 60.0  # largest logarithm of a factor, to base 2, beyond which any value is at its bound
RIDGE = 1e-6  # share of a parameter's curvature that is added, so that what the data do not show stays where it is
LEVERAGE = 9.0  # squared derivative, in squared medians, at which a row has half its weight
REWEIGHTED = 8  # solutions of the weighted equations in one step

Slopes = Sequence[np.ndarray]


@dataclass(frozen=True)
class Variable:
    """A parameter of one of several effects as a variable of a fit, 0 at the start and in units of its typical size.

    Args:
        effect: index of the effect.
        name: name of the parameter.
        value: value at the start.
        size: typical change, in the parameter's unit; in powers of two for a factor.
        low: lowest value.
        high: highest value.
        is_factor: whether the variable is the logarithm of the parameter.
        neutral: value at which the parameter changes nothing.
    """

    effect: int
    name: str
    value: float
    size: float
    low: float
    high: float
    is_factor: bool
    neutral: float

    def at(self, x: float) -> float:
        """The parameter's value at x."""
        octaves = np.clip(self.size * x, -FARTHEST_FACTOR, FARTHEST_FACTOR)
        value = self.value * 2.0**octaves if self.is_factor else self.value + self.size * x
        return float(np.clip(value, self.low, self.high))

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest x."""
        ends = np.array([self.low, self.high])
        if self.is_factor:
            return tuple(np.log2(np.maximum(ends, 1e-300) / self.value) / self.size)
        return tuple((ends - self.value) / self.size)

    @property
    def to_neutral(self) -> float:
        """The move to the neutral value; not finite for a limit that is never reached."""
        if self.is_factor:
            return math.log2(self.neutral / self.value) / self.size
        return (self.neutral - self.value) / self.size

    def slope(self, x: float) -> float:
        """Derivative of the value by x."""
        return self.at(x) * math.log(2.0) * self.size if self.is_factor else self.size


@dataclass(frozen=True, eq=False)
class SetFit:
    """Fitted values of a set of effects.

    Args:
        effects: the effects with their fitted values.
        half_widths: half-width of the 95 % interval of each fitted parameter, by effect and name, in its unit.
        scatter: half-width, in quadrature beside these, by which the value in another log of the machine may differ.
        in_logs: each value in each of several logs; empty for one log.
        slopes: derivatives of the errors by the values, (N, p) for each part.
        score: mean score of the blocks, in nats.
    """

    effects: tuple[Effect, ...]
    half_widths: tuple[dict[str, float], ...]
    scatter: tuple[dict[str, float], ...]
    in_logs: tuple[dict[str, InLogs], ...]
    slopes: Slopes
    score: float

    @property
    def in_another_log(self) -> tuple[dict[str, float], ...]:
        """Half-widths of the intervals of the values in another log."""
        return tuple(
            {name: math.hypot(half, scatter[name]) for name, half in own.items()}
            for own, scatter in zip(self.half_widths, self.scatter, strict=True)
        )


def variables_of(
    predictions: Predictions, entries: Sequence[CatalogueEntry], effects: Sequence[Effect]
) -> list[Variable]:
    """The variables of a fit of effects, from their present values, with bounds that the model sets."""
    model, found = predictions.record.simulation.model, []
    for index, (entry, effect) in enumerate(zip(entries, effects, strict=True)):
        others = [other for i, other in enumerate(effects) if i != index]
        least = lowest_value(effect, model, others)
        for name in entry.fitted:
            parameter = effect.parameters[name]
            low, high = max(parameter.bounds[0], least), parameter.bounds[1]
            is_factor = parameter.neutral == 1.0 and low > 0.0 and parameter.value > 0.0
            size = 1.0 if is_factor else size_of(entry, name)
            found.append(Variable(index, name, parameter.value, size, low, high, is_factor, parameter.neutral))
    return found


def size_of(entry: CatalogueEntry, name: str) -> float:
    """Typical change of an entry's parameter: the largest move of its trials."""
    neutral = entry.effect.parameters[name].neutral
    trials = [trial[name] for trial in entry.trials]
    moves = [abs(trial - neutral) for trial in trials] if math.isfinite(neutral) else [abs(trial) for trial in trials]
    others = max((abs(v - entry.effect.parameters[k].neutral) for t in entry.trials for k, v in t.items()), default=0.1)
    return max(moves) or (others if math.isfinite(others) else 0.1)


def with_values(effects: Sequence[Effect], variables: Sequence[Variable], x: np.ndarray) -> tuple[Effect, ...]:
    """The effects with the values at x."""
    values: list[dict[str, float]] = [{} for _ in effects]
    for variable, place in zip(variables, x, strict=True):
        values[variable.effect][variable.name] = variable.at(place)
    return tuple(e.with_parameters(new) if new else e for e, new in zip(effects, values, strict=True))


def fit_set(
    parts: Sequence[Predictions],
    entries: Sequence[CatalogueEntry],
    effects: Sequence[Effect],
    *,
    most_steps: int,
    intervals: bool = False,
    slopes: Slopes | None = None,
) -> SetFit:
    """Maximises the score over the values of effects, from their present values.

    Derivatives are computed once and serve for all steps, because each costs a simulation for each value.

    Args:
        parts: predictions of the rows to fit.
        entries: the effects' entries of the catalogue, which name the fitted parameters.
        effects: the effects, in the order of their composition.
        most_steps: largest number of Gauss-Newton steps.
        intervals: whether to compute the intervals.
        slopes: derivatives of the errors by the first values, (N, q) for each part, if they are known.

    Raises:
        ValueError: if the model rejects the effects at the start.
    """
    effects = tuple(effects)
    errors = [part.errors(effects) for part in parts]
    scales, by_block = _profiled(parts, errors)
    variables = variables_of(parts[0], entries, effects)
    slopes = slopes_of(parts, effects, variables, errors, slopes)
    for _ in range(most_steps if variables else 0):
        weighted = [whitened(*each) for each in zip(parts, errors, scales, strict=True)]
        move, gain = _step(weighted, slopes, variables), 0.0
        for share in (1.0, 0.3, 0.1):
            try:
                tried = with_values(effects, variables, share * move)
                new_errors = [part.errors(tried) for part in parts]
            except ValueError:
                continue
            new_scales, new_by_block = _profiled(parts, new_errors)
            gain = float(new_by_block.mean() - by_block.mean())
            if gain > 0.0:
                effects, errors, scales, by_block = tried, new_errors, new_scales, new_by_block
                variables = variables_of(parts[0], entries, effects)
                break
        if gain < SMALLEST_GAIN:
            break
    widths: tuple[dict[str, float], ...] = tuple({} for _ in effects)
    scatter: tuple[dict[str, float], ...] = tuple({} for _ in effects)
    in_logs: tuple[dict[str, InLogs], ...] = tuple({} for _ in effects)
    if intervals and variables:
        slopes = slopes_of(parts, effects, variables, errors)
        weighted = [whitened(*each) for each in zip(parts, errors, scales, strict=True)]

        def white_at(x: np.ndarray) -> np.ndarray:
            moved = [part.errors(with_values(effects, variables, x)) for part in parts]
            return np.concatenate([whitened(*each)[0] for each in zip(parts, moved, scales, strict=True)])

        spreads = spreads_of(parts, weighted, slopes, white_at)
        for index, variable in enumerate(variables):
            slope = variable.slope(0.0)
            widths[variable.effect][variable.name] = spreads.half_widths[index] * abs(slope)
            scatter[variable.effect][variable.name] = spreads.scatter[index] * abs(slope)
            if len(spreads.logs) > 1:
                in_logs[variable.effect][variable.name] = InLogs(
                    spreads.logs,
                    tuple(map(variable.at, spreads.moves[:, index].tolist())),
                    tuple((abs(slope) * spreads.errors[:, index]).tolist()),
                    abs(variable.value - (variable.neutral if math.isfinite(variable.neutral) else 0.0)),
                )
    return SetFit(effects, widths, scatter, in_logs, slopes, float(by_block.mean()))


def _profiled(parts: Sequence[Predictions], errors) -> tuple[list, np.ndarray]:
    """Scales fitted to the errors of each part, and the scores of all blocks with them."""
    scales = [fitted_scales(part, error) for part, error in zip(parts, errors, strict=True)]
    found = [scores(*each) for each in zip(parts, errors, scales, strict=True)]
    return scales, np.concatenate(found)


def slopes_of(
    parts: Sequence[Predictions],
    effects: Sequence[Effect],
    variables: Sequence[Variable],
    errors,
    known: Slopes | None = None,
) -> Slopes:
    """Derivatives of the errors by the variables, (N, p) for each part; those by the first ones may be known."""
    columns: list[list[np.ndarray]] = [list(own.T) for own in known] if known is not None else [[] for _ in parts]
    zero = np.zeros(len(variables))
    for index in range(len(columns[0]), len(variables)):
        low, high = variables[index].bounds
        step = STEP if high > STEP else -STEP
        if low > step:
            step = 0.0
        moved = zero.copy()
        moved[index] = step
        for part, error, found in zip(parts, errors, columns, strict=True):
            before = flat(error)
            try:
                after = flat(part.errors(with_values(effects, variables, moved))) if step else before
            except ValueError:
                after = before
            found.append((after - before) / (step or 1.0))
    return [
        np.stack(found, axis=1) if found else np.zeros((len(flat(error)), 0))
        for found, error in zip(columns, errors, strict=True)
    ]


def _step(parts: Sequence[Whitened], slopes: Slopes, variables: Sequence[Variable]) -> np.ndarray:
    """The move of the variables, within their bounds, that raises the score most if the errors are linear.

    Near a contact a derivative may be arbitrarily large. The move is therefore also computed with less weight for rows
    of unusual derivatives, and the better of the two is taken.
    """
    white, inverse, share = (np.concatenate(each) for each in zip(*parts, strict=True))
    scaled = np.concatenate(slopes) * inverse[:, None]
    low, high = np.transpose([variable.bounds for variable in variables])
    low, high = np.maximum(low, -FARTHEST), np.minimum(high, FARTHEST)
    high = np.maximum(high, low + 1e-9)
    usual = np.array([np.median(np.abs(one[one != 0.0])) if one.any() else 1.0 for one in scaled.T])
    leverage = ((scaled / usual) ** 2).mean(1)
    best, most = np.zeros(len(variables)), log_density(white) @ share
    for first in (1.0, 1.0 / (1.0 + leverage / LEVERAGE)):
        x, weight = np.zeros(len(variables)), share * weights(white) * first
        for _ in range(REWEIGHTED):
            curvature = scaled.T @ (weight[:, None] * scaled)
            curvature = curvature + np.diag(RIDGE * np.diag(curvature) + 1e-12)
            root = np.linalg.cholesky(curvature).T
            pull = -scaled.T @ (weight * white)
            x = lsq_linear(root, np.linalg.solve(root.T, pull), bounds=(low, high)).x
            moved = white + scaled @ x
            weight = share * weights(moved)
        if (score := log_density(moved) @ share) > most:
            best, most = x, score
    return best
