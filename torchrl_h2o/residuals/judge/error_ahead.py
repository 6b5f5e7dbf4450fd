"""How far a simulation is off some steps ahead, and how far a linear predictor is: a floor to measure it by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.simulation.simulation import Simulation

_RIDGE = 1e-9  # of each regressor's variance, for those that never change


@dataclass(frozen=True, eq=False)
class ErrorAhead:
    """The error at the end of windows of one length.

    Args:
        steps: control steps ahead.
        rmse: (n), root of the mean square, in units of the observations.
        median: (n), of the absolute error, in the same units.
        windows: how many were judged.
        diverged: how many of them the simulation did not reach the end of; they are not in the figures.
    """

    steps: int
    rmse: np.ndarray
    median: np.ndarray
    windows: int
    diverged: int = 0


def horizon_errors(
    simulation: Simulation,
    measured: Measured,
    horizons: Sequence[int],
    *,
    held_out: bool | None = True,
    states: np.ndarray | None = None,
    stride: int = 1,
) -> list[ErrorAhead]:
    """Errors of a simulation at several horizons, each over all windows of usable rows.

    Args:
        simulation: to be judged.
        measured: the data.
        horizons: in control steps.
        held_out: True for windows of held-out rows alone, False for windows without any, None for all.
        states: (T, nq + nv), to start from instead of the measured ones.
        stride: rows from one window to the next.

    Returns:
        One for each horizon. Without any window its figures are NaN.
    """
    errors = []
    for horizon in horizons:
        starts = measured.windows(horizon, stride, held_out=held_out)
        if not len(starts):
            errors.append(_summary(horizon, np.zeros((0, measured.observation.shape[1]))))
            continue
        errors.append(_summary(horizon, residuals(simulation, measured, starts, horizon, states=states)[:, -1]))
    return errors


def linear_floor(measured: Measured, horizon: int, *, recent: int = 0, stride: int = 1) -> ErrorAhead:
    """The error of a direct linear predictor, fitted to the rows that fits may see and judged on the held-out ones.

    It predicts from the observation and the actions up to the horizon. Where the actions come from a controller that
    looks at the sensors, the coming ones tell of what is to come (a push, and the reaction to it), which no simulation
    can know: the floor may lie lower than any simulation gets.

    Args:
        measured: the data.
        horizon: in control steps.
        recent: how many actions before the observation it sees as well.
        stride: rows from one window to the next.

    Returns:
        The error of the held-out windows.

    Raises:
        ValueError: if there are fewer windows to fit to than coefficients.

    Examples:
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> from torchrl_h2o.residuals import Measured, Simulation
        >>> data = record(WheelLeggedEnv(), noisy_balance_controller(), 400, seed=0)
        >>> floor = linear_floor(Measured.from_ted(data, Simulation.from_env(WheelLeggedEnv())), 5)
        >>> bool((floor.rmse < 0.05).all())
        True
    """
    fitted, judged = (_with_past(measured, horizon, recent, stride, held_out) for held_out in (False, True))
    regressors = _regressors(measured, fitted, horizon, recent)
    if regressors.shape[0] < regressors.shape[1]:
        raise ValueError(
            f"{regressors.shape[0]} windows of {horizon} steps cannot tell {regressors.shape[1]} coefficients; take a "
            "shorter horizon or more data"
        )
    centre, size = regressors.mean(0), regressors.std(0) + 1e-12
    target = measured.following[fitted + horizon - 1] - measured.observation[fitted]
    scaled = (regressors - centre) / size
    gram = scaled.T @ scaled + _RIDGE * len(scaled) * np.eye(scaled.shape[1])
    weights = np.linalg.solve(gram, scaled.T @ (target - target.mean(0)))
    predicted = target.mean(0) + (_regressors(measured, judged, horizon, recent) - centre) / size @ weights
    return _summary(horizon, measured.following[judged + horizon - 1] - measured.observation[judged] - predicted)


def _with_past(measured: Measured, horizon: int, recent: int, stride: int, held_out: bool) -> np.ndarray:
    """The first rows of windows with so many rows of the same run before them."""
    starts = measured.windows(horizon, stride, held_out=held_out)
    starts = starts[starts >= recent]
    return starts[measured.run[starts - recent] == measured.run[starts]]


def _regressors(measured: Measured, starts: np.ndarray, horizon: int, recent: int) -> np.ndarray:
    actions = measured.action[starts[:, None] + np.arange(-recent, horizon)]
    return np.hstack([measured.observation[starts], actions.reshape(len(starts), -1)])


def _summary(steps: int, errors: np.ndarray) -> ErrorAhead:
    reached = np.isfinite(errors).all(1)
    good = errors[reached]
    if not len(good):
        nothing = np.full(errors.shape[1], np.nan)
        return ErrorAhead(steps, nothing, nothing, len(errors), int((~reached).sum()))
    rmse, median = np.sqrt((good**2).mean(0)), np.median(np.abs(good), axis=0)
    return ErrorAhead(steps, rmse, median, len(errors), int((~reached).sum()))
