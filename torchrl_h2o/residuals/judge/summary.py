"""From what a search found to the report: errors before and after, on data that no fit has seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.stats import rankdata

from torchrl_h2o.effects import ActionNoise, Effect
from torchrl_h2o.residuals.judge.floor import explainable_floor
from torchrl_h2o.residuals.judge.separation import separated_by
from torchrl_h2o.residuals.judge.two_sample import two_sample_auc
from torchrl_h2o.residuals.measured.chance import sensor_noise
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.outside import OutsideInterval
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.report.report import (
    DataSummary,
    DimensionError,
    ErrorSummary,
    FoundEffect,
    HorizonError,
    IndistinguishableGroup,
    Interval,
    RejectedEffect,
    Report,
    TwoSample,
)
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.words import UNDECLARED, effect_words
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.significance import IN_WORDS
from torchrl_h2o.residuals.undeclared.explanation import Explanation

DISTURBED = "disturbed from outside"
_METRIC = "held-out one-step RMSE, each dimension over the spread of its one-step change"
_HORIZONS = (1, 2, 5, 10, 20, 50)  # control steps
_ROUNDING = 1e-5  # of a dimension's spread: less is no residual
_RANKED = 30  # rejected effects that the report lists


def summarise(
    simulation: Simulation,
    measured: Measured,
    explanation: Explanation,
    *,
    disturbed: Sequence[OutsideInterval] = (),
    seed: int = 0,
    start: float,
) -> Report:
    """The report of an explanation.

    Args:
        simulation: without the effects found.
        measured: the data.
        explanation: what was found.
        disturbed: what was set aside.
        seed: of the classifiers.
        start: of the wall clock, by ``time.perf_counter``.
    """
    effects, trace = explanation.effects, explanation.trace
    mended = simulation.with_effects(*(effect for effect in effects if not _scatters(effect)))
    sensor_std = sensor_noise(mended, measured)
    alike = {attempt.entry.name for group in trace.groups for attempt in group}
    names = {"entries": simulation.state_map.names, "actuators": simulation.actuators}
    in_words = partial(effect_words, names=names)
    return Report(
        simulator=simulation.name,
        data=DataSummary(measured.source, len(measured), int(measured.held_out.sum()), measured.left_out),
        error=error_summary(simulation, mended, measured),
        found=tuple(
            FoundEffect(
                part.effect,
                part.declared,
                part.ci95,
                _error(simulation.with_effects(*(e for e in effects[: index + 1] if not _scatters(e))), measured),
                in_words(part.effect) if part.declared else f"{UNDECLARED}: {in_words(part.effect)}",
            )
            for index, part in enumerate(explanation.parts)
        ),
        rejected=tuple(
            RejectedEffect(
                attempt.effect,
                _error(simulation.with_effects(attempt.effect), measured),
                attempt.p_value,
                "as good as one that was put in"
                if attempt.entry.name in alike
                else "explains less, or no more than chance",
                in_words(attempt.effect),
            )
            for attempt in trace.attempts[:_RANKED]
            if attempt.entry.name not in {entry.name for entry in trace.entries}
        ),
        indistinguishable=tuple(
            _group(simulation, measured, effects, index, part.alike, in_words)
            for index, part in enumerate(explanation.parts)
            if part.alike
        ),
        two_sample=TwoSample(
            two_sample_auc(simulation, measured, sensor_std=sensor_std, seed=seed),
            two_sample_auc(mended, measured, sensor_std=sensor_std, seed=seed),
        ),
        unexplained_intervals=tuple(
            Interval(
                float(measured.time[interval.start]),
                float(measured.time[interval.stop - 1]),
                interval.stop - interval.start,
                interval.size,
                DISTURBED,
            )
            for interval in disturbed
        ),
        stop_test=IN_WORDS,
        wall_s=time.perf_counter() - start,
        trace=_residual_trace(simulation, mended, measured),
    )


def _scatters(effect: Effect) -> bool:
    """Whether an effect is noise that reality has: no single draw of it is closer to what was measured."""
    return isinstance(effect, ActionNoise) and effect.std > 0.0


def error_summary(simulation: Simulation, mended: Simulation, measured: Measured) -> ErrorSummary:
    """The held-out error before and after, over all, by dimension and by horizon."""
    names, units = simulation.state_map.names, simulation.state_map.units
    before, after = (_rmse(which, measured, 1) for which in (simulation, mended))
    floor = explainable_floor(mended, measured)
    horizons = []
    for steps in _HORIZONS:
        if len(measured.judged(steps)) < 2:
            break
        ahead = [
            dict(zip(names, _rmse(which, measured, steps).tolist(), strict=True)) for which in (simulation, mended)
        ]
        horizons.append(HorizonError(steps, steps * simulation.control_step, *ahead))
    return ErrorSummary(
        metric=_METRIC,
        unit="1",
        before=_error(simulation, measured),
        after=_error(mended, measured),
        floor=float(np.sqrt(np.mean((floor / spread(measured)) ** 2))),
        per_dimension=tuple(
            map(
                DimensionError,
                names,
                units,
                *(values.tolist() for values in (before, after, floor, autocorrelation(mended, measured))),
            )
        ),
        horizons=tuple(horizons),
    )


def autocorrelation(simulation: Simulation, measured: Measured) -> np.ndarray:
    """How much the held-out one-step residual of a row says of the next row's, (n): about 0 where it is white.

    Noise of the sensors makes it negative, down to -0.5: what a reading adds to one residual, it takes off the next.
    What is left of the simulator's own errors makes it positive.

    Returns:
        The correlation of neighbours, by ranks (Spearman's), as single contacts would outweigh all else; NaN where no
        more than rounding is left.
    """
    rows = measured.windows(2, held_out=True)
    first, second = (residuals(simulation, measured, rows + later)[:, 0] for later in (0, 1))
    left = np.abs(first).mean(0) > _ROUNDING * spread(measured) if len(rows) > 1 else np.zeros(first.shape[1], bool)
    return np.array(
        [
            np.corrcoef(rankdata(a), rankdata(b))[0, 1] if some else np.nan
            for a, b, some in zip(first.T, second.T, left, strict=True)
        ]
    )


def spread(measured: Measured) -> np.ndarray:
    """The standard deviation of each dimension's one-step change, (n), in the part that fits see."""
    change = (measured.following - measured.observation)[measured.usable & ~measured.held_out]
    return np.maximum(change.std(0), 1e-12)


def _rmse(simulation: Simulation, measured: Measured, horizon: int) -> np.ndarray:
    """Held-out error at the end of windows, (n), in units."""
    starts = measured.judged(horizon)
    # with the simulator's own noise, if it has any: that is an error too
    missed = residuals(simulation, measured, starts, horizon, rng=np.random.default_rng(0))[:, -1]
    return np.sqrt(np.nanmean(missed**2, axis=0))


def _error(simulation: Simulation, measured: Measured) -> float:
    return float(np.sqrt(np.mean((_rmse(simulation, measured, 1) / spread(measured)) ** 2)))


def _group(
    simulation: Simulation,
    measured: Measured,
    effects: tuple[Effect, ...],
    index: int,
    others: tuple[Effect, ...],
    in_words: Callable[[Effect], str],
) -> IndistinguishableGroup:
    alike = (effects[index], *others)
    errors = [
        _error(simulation.with_effects(*effects[:index], other, *effects[index + 1 :]), measured) for other in alike
    ]
    before, behind = (
        [effect for effect in some if not _scatters(effect)] for some in (effects[:index], effects[index + 1 :])
    )
    separation = separated_by(simulation, measured, alike, before, behind)
    return IndistinguishableGroup(alike, tuple(errors), separation, tuple(map(in_words, alike)))


def _residual_trace(simulation: Simulation, mended: Simulation, measured: Measured) -> ResidualTrace:
    rows = measured.windows(1)
    before, after = (residuals(which, measured, rows)[:, 0] for which in (simulation, mended))
    return ResidualTrace(
        time=rows * simulation.control_step,
        names=simulation.state_map.names,
        units=simulation.state_map.units,
        before=before,
        after=after,
        states=measured.observation[rows],
        held_out=measured.held_out[rows],
    )
