"""Errors of a simulation several steps ahead, and of a linear predictor for comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.simulation.simulation import Simulation

_RIDGE = 1e-9  # share of each regressor's variance; keeps the equations solvable with constant regressors


@dataclass(frozen=True, eq=False)
class ErrorAhead:
    """Errors at the end of windows of one length.

    Args:
        steps: control steps ahead.
        rmse: (n), root mean square error, in units of the observations.
        median: (n), median absolute error, in the same units.
        windows: number of windows.
        diverged: number of windows in which the simulation diverged; they are excluded from the errors.
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
    split: Split | None = Split.REPORT,
    states: np.ndarray | None = None,
    stride: int = 1,
) -> list[ErrorAhead]:
    """Computes the errors of a simulation at several horizons, each over all windows of usable rows.

    Args:
        simulation: the simulator.
        measured: the data.
        horizons: control steps ahead.
        split: windows of this part only, None for all.
        states: (T, nq + nv), start states; the measured ones by default.
        stride: rows from the start of one window to the next.

    Returns:
        One :class:`ErrorAhead` per horizon; its errors are NaN if there is no window.
    """
    errors = []
    for horizon in horizons:
        starts = measured.windows(horizon, stride, split=split)
        if not len(starts):
            errors.append(_summary(horizon, np.zeros((0, measured.observation.shape[1]))))
            continue
        errors.append(_summary(horizon, residuals(simulation, measured, starts, horizon, states=states)[:, -1]))
    return errors


def linear_floor(measured: Measured, horizon: int, *, recent: int = 0, stride: int = 1) -> ErrorAhead:
    """Computes the held-out error of a linear predictor that is fitted to the other rows.

    It predicts from the observation and the actions up to the horizon. If a controller reacts to the sensors, these
    actions carry information about later disturbances, and a simulation does not have this information. The linear
    predictor's error may therefore be lower than that of any simulation.

    Args:
        measured: the data.
        horizon: control steps ahead.
        recent: number of actions before the observation that are additional regressors.
        stride: rows from the start of one window to the next.

    Returns:
        The error of the held-out windows.

    Raises:
        ValueError: if there are fewer windows to fit than coefficients.

    Examples:
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> from torchrl_h2o.residuals import Measured, Simulation
        >>> data = record(WheelLeggedEnv(), noisy_balance_controller(), 400, seed=0)
        >>> floor = linear_floor(Measured.from_ted(data, Simulation.from_env(WheelLeggedEnv())), 5)
        >>> bool((floor.rmse < 0.05).all())
        True
    """
    fitted, judged = (_with_past(measured, horizon, recent, stride, split) for split in (Split.FIT, Split.REPORT))
    regressors = _regressors(measured, fitted, horizon, recent)
    if regressors.shape[0] < regressors.shape[1]:
        raise ValueError(
            f"{regressors.shape[0]} windows of {horizon} steps are too few to fit {regressors.shape[1]} coefficients; "
            "choose a shorter horizon or record more data"
        )
    centre, size = regressors.mean(0), regressors.std(0) + 1e-12
    target = measured.following[fitted + horizon - 1] - measured.observation[fitted]
    scaled = (regressors - centre) / size
    gram = scaled.T @ scaled + _RIDGE * len(scaled) * np.eye(scaled.shape[1])
    weights = np.linalg.solve(gram, scaled.T @ (target - target.mean(0)))
    predicted = target.mean(0) + (_regressors(measured, judged, horizon, recent) - centre) / size @ weights
    return _summary(horizon, measured.following[judged + horizon - 1] - measured.observation[judged] - predicted)


def _with_past(measured: Measured, horizon: int, recent: int, stride: int, split: Split) -> np.ndarray:
    """First rows of the windows that have ``recent`` rows of the same run before them."""
    starts = measured.windows(horizon, stride, split=split)
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
