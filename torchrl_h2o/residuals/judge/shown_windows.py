"""Chooses the windows that a report shows, measured against simulated: the worst, the median and the best one."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.windows import ShownWindow, WindowQuantity
from torchrl_h2o.residuals.simulation.simulation import Simulation

SHOWN_SECONDS = 0.1  # time ahead, in s, of the windows that the report shows
SHOWN_STEPS = 5  # smallest number of control steps in these windows
SHOWN_QUANTITIES = 4  # largest number of quantities shown of a window, those with the largest errors


def shown_windows(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    steps: int | None = None,
) -> tuple[ShownWindow, ...]:
    """Returns the worst, the median and the best held-out window by the error with the effects at its end.

    The error is the root mean square over the dimensions, each divided by the standard deviation of its change over
    such a window. A window in which the simulation with the effects diverges is worse than all others.

    Args:
        simulation: the simulator before the effects are put in.
        mended: the simulator with them.
        measured: the data.
        steps: control steps per window; by default as many as cover ``SHOWN_SECONDS``.

    Returns:
        Three windows in this order, each with the quantities whose errors are largest over all windows; fewer, or none,
        if there are fewer windows.

    Examples:
        >>> from torchrl_h2o.effects import Gravity
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> data = record(WheelLeggedEnv(), noisy_balance_controller(), 300, seed=0)
        >>> mended = Simulation.from_env(WheelLeggedEnv())
        >>> windows = shown_windows(mended.with_effects(Gravity(2.0)), mended, Measured.from_ted(data, mended), 10)
        >>> [window.rank for window in windows], len(windows[0].quantities[0].measured)
        (['worst', 'median', 'best'], 11)
    """
    if steps is None:
        steps = max(SHOWN_STEPS, round(SHOWN_SECONDS / simulation.control_step))
    starts = measured.reported_on(steps)
    if not len(starts):
        return ()
    rng = np.random.default_rng
    missed = np.array([residuals(which, measured, starts, steps, rng=rng(0)) for which in (simulation, mended)])
    change = measured.following[starts + steps - 1] - measured.observation[starts]
    scaled = missed[:, :, -1] / np.maximum(change.std(0), 1e-12)
    error = np.sqrt((scaled**2).mean(-1))
    order = np.argsort(np.nan_to_num(error[1], nan=np.inf), kind="stable")
    ranks = {"worst": order[-1], "median": order[len(order) // 2], "best": order[0]}
    finite = np.where(np.isfinite(scaled), scaled, np.nan)
    largest = np.argsort(-np.nan_to_num(np.nanmean(finite**2, axis=1)).max(0), kind="stable")
    quantities = largest[:SHOWN_QUANTITIES]
    chosen = {int(window): rank for rank, window in reversed(ranks.items())}  # of a few windows, some coincide
    return tuple(
        _shown(rank, simulation, measured, int(starts[window]), missed[:, window], scaled[:, window], quantities)
        for window, rank in sorted(chosen.items(), key=lambda item: list(ranks).index(item[1]))
    )


def _shown(
    rank: str,
    simulation: Simulation,
    measured: Measured,
    row: int,
    missed: np.ndarray,
    scaled: np.ndarray,
    quantities: np.ndarray,
) -> ShownWindow:
    """One window.

    Args:
        rank: name of the window.
        simulation: names and units of the quantities, and the control step.
        measured: the data.
        row: first row of the window.
        missed: (2, H, n), residuals before and after.
        scaled: (2, n), the residuals at the end, in spreads.
        quantities: indices of the quantities.
    """
    steps = missed.shape[1]
    values = np.vstack([measured.observation[row], measured.following[row : row + steps]])
    simulated = values - np.concatenate([np.zeros_like(missed[:, :1]), missed], axis=1)
    names, units = simulation.state_map.names, simulation.state_map.units
    before, after = (float(np.sqrt((ends**2).mean())) for ends in scaled)
    return ShownWindow(
        rank=rank,
        run=int(measured.run[row]),
        row=row,
        start=float(measured.time[row]),
        ahead=tuple((np.arange(steps + 1) * simulation.control_step).tolist()),
        before=before,
        after=after,
        quantities=tuple(
            WindowQuantity(names[i], units[i], *(tuple(part[:, i].tolist()) for part in (values, *simulated)))
            for i in quantities
        ),
    )
