"""Fits the values of a set of effects by the score, with the simulator itself: robust Gauss-Newton steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import t as student

from torchrl_h2o.effects import CatalogueEntry, Effect, Parameter
from torchrl_h2o.likelihood import TAIL, log_density
from torchrl_h2o.residuals.model_bounds import lowest_value
from torchrl_h2o.residuals.score import Predictions, fitted_scales, scores

STEP = 0.02  # step of the finite differences, in typical sizes of a parameter
SMALLEST_GAIN = 1e-2  # gain of the score, in nats a block, below which a fit has converged
FARTHEST = 3.0  # largest move of a parameter in one step of the fit, in typical sizes
FARTHEST_FACTOR = 60.0  # largest logarithm of a factor, to base 2, beyond which any value is at its bound
RIDGE = 1e-6  # share of a parameter's curvature that is added, so that what the data do not show stays where it is
LEVERAGE = 9.0  # squared derivative, in squared medians, at which a row has half its weight
REWEIGHTED = 8  # solutions of the weighted equations in one step
CONFIDENCE = 1.96  # standard errors from a value to the end of its 95 % interval

Whitened = tuple[np.ndarray, np.ndarray, np.ndarray]
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
        slopes: derivatives of the errors by the values, (N, p) for each part.
        score: mean score of the blocks, in nats.
    """

    effects: tuple[Effect, ...]
    half_widths: tuple[dict[str, float], ...]
    scatter: tuple[dict[str, float], ...]
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
    if intervals and variables:
        slopes = slopes_of(parts, effects, variables, errors)
        weighted = [whitened(*each) for each in zip(parts, errors, scales, strict=True)]
        for variable, half, between in zip(variables, *_half_widths(parts, weighted, slopes), strict=True):
            widths[variable.effect][variable.name] = half * abs(variable.slope(0.0))
            scatter[variable.effect][variable.name] = between * abs(variable.slope(0.0))
    return SetFit(effects, widths, scatter, slopes, float(by_block.mean()))


def _profiled(parts: Sequence[Predictions], errors) -> tuple[list, np.ndarray]:
    """Scales fitted to the errors of each part, and the scores of all blocks with them."""
    scales = [fitted_scales(part, error) for part, error in zip(parts, errors, strict=True)]
    found = [scores(*each) for each in zip(parts, errors, scales, strict=True)]
    return scales, np.concatenate(found)


def flat(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Errors of all windows in one vector."""
    return np.concatenate([one.ravel() for one in arrays])


def whitened(part: Predictions, errors: Sequence[np.ndarray], scales: Sequence[np.ndarray]) -> Whitened:
    """Whitened errors, the inverse of their scale, and their shares in the score, each (N)."""
    roots = [1.0 / np.sqrt(variance + scale) for variance, scale in zip(part.variances, scales, strict=True)]
    shares = [np.broadcast_to(share[:, None], one.shape) for share, one in zip(part.shares, errors, strict=True)]
    inverse = flat(roots)
    return flat(errors) * inverse, inverse, flat(shares)


def weights(white: np.ndarray) -> np.ndarray:
    """Weights with which half the sum of squares of whitened errors has the gradient of the log density."""
    return (TAIL + 1.0) / (TAIL - 2.0 + white**2)


def block_of(part: Predictions) -> np.ndarray:
    """Index of the block of each error of :func:`flat`, (N)."""
    n = part.record.num_readings
    return np.concatenate([np.repeat(w.block, len(w.horizons) * n) for w in part.blocks.windows])


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


def _half_widths(
    parts: Sequence[Predictions], found: Sequence[Whitened], slopes: Slopes
) -> tuple[np.ndarray, np.ndarray]:
    """Half-widths of the variables' 95 % intervals, a sandwich estimate with each block as one observation, (p,).

    Of several logs also, in quadrature, what the scatter between them adds for the value in another log; else 0.
    """
    count, logs, blocks, rows = 0, [], [], []
    for part, (white, inverse, share), slope in zip(parts, found, slopes, strict=True):
        block, log = block_of(part), part.record.measured.log
        logs.append(np.zeros(len(part.blocks), int) if log is None else log[part.blocks.first])
        blocks.append(count + block)
        weight = share * weights(white)
        rows.append((slope * inverse[:, None], weight, weight * white))
        count += len(part.blocks)
    log_of, block = np.concatenate(logs), np.concatenate(blocks)
    scaled, weight, pull = (np.concatenate(one) for one in zip(*rows, strict=True))

    def solved(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The move to the best values of some blocks alone, if the errors are linear, and its squared errors."""
        own = chosen[block]
        pulls = np.zeros((count, scaled.shape[1]))
        np.add.at(pulls, block[own], scaled[own] * pull[own, None])
        bread = np.linalg.pinv(scaled[own].T @ (weight[own, None] * scaled[own]))
        spare = chosen.sum() / max(1, chosen.sum() - len(bread))
        return -bread @ pulls.sum(0), np.maximum(np.diag(bread @ pulls.T @ pulls @ bread) * spare, 0.0)

    half = CONFIDENCE * np.sqrt(solved(np.ones(count, bool))[1])
    every = [solved(log_of == log) for log in np.unique(log_of)]
    if len(every) == 1:
        return half, np.zeros(len(half))
    between = scatter_between(*map(np.stack, zip(*every, strict=True)))
    return half, student.ppf(0.975, len(every) - 1) * np.sqrt(between * (1.0 + 1.0 / len(every)))


def scatter_between(values: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Variance between logs of values that are known with errors, (p,).

    R. DerSimonian and N. Laird, *Meta-analysis in clinical trials*, Controlled Clinical Trials 7 (1986), 177-188.

    Args:
        values: the values in each log, (logs, p).
        variances: squared standard errors of these, (logs, p).

    Examples:
        >>> import numpy as np
        >>> errors = np.full((3, 2), 0.01)
        >>> scatter_between(np.array([[1.0, 0.0], [2.0, 0.1], [3.0, -0.1]]), errors).round(2).tolist()
        [0.99, 0.0]
    """
    weight = 1.0 / np.maximum(variances, 1e-300)
    total = weight.sum(0)
    mean = (weight * values).sum(0) / total
    excess = (weight * (values - mean) ** 2).sum(0) - (len(values) - 1)
    return np.maximum(excess / np.maximum(total - (weight**2).sum(0) / total, 1e-300), 0.0)


def interval(parameter: Parameter, half_width: float) -> tuple[float, float]:
    """95 % interval of a fitted parameter, within its bounds."""
    low, high = parameter.bounds
    return float(max(low, parameter.value - half_width)), float(min(high, parameter.value + half_width))
