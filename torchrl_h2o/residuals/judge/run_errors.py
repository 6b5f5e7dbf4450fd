"""One-step error of each run, before and after the effects are put in."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.judge.held_out_error import spread
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.windows import RunError
from torchrl_h2o.residuals.simulation.simulation import Simulation

MAX_RUNS = 200  # largest number of runs whose errors are listed


def run_errors(simulation: Simulation, mended: Simulation, measured: Measured) -> tuple[RunError, ...]:
    """Returns the error of each run: the one-step RMSE over all dimensions, each in units of its spread.

    A run with held-out transitions is judged by these alone, another run by all of its usable transitions.

    Args:
        simulation: the simulator before the effects are put in.
        mended: the simulator with them.
        measured: the data.

    Returns:
        An entry for each run with usable transitions, in the order of the data.
    """
    judged = set(measured.reported_on(1).tolist())
    found: list[tuple[int, np.ndarray, bool]] = []
    usable = measured.windows(1)
    for index, run in enumerate(measured.runs):
        rows = usable[(usable >= run.start) & (usable < run.stop)]
        held_out = np.array([row for row in rows if int(row) in judged], dtype=int)
        if len(rows):
            found.append((index, held_out if len(held_out) else rows, bool(len(held_out))))
    longest = {entry[0] for entry in sorted(found, key=lambda entry: -len(entry[1]))[:MAX_RUNS]}
    listed = [entry for entry in found if entry[0] in longest]
    if not listed:
        return ()
    rows = np.concatenate([entry[1] for entry in listed])
    size, rng = spread(measured), np.random.default_rng
    squared = [(residuals(which, measured, rows, rng=rng(0))[:, 0] / size) ** 2 for which in (simulation, mended)]
    of_run = np.split(np.arange(len(rows)), np.cumsum([len(entry[1]) for entry in listed])[:-1])
    return tuple(
        RunError(
            str(index),
            len(chosen),
            before=_root_mean(squared[0][places]),
            after=_root_mean(squared[1][places]),
            held_out=held_out,
        )
        for (index, chosen, held_out), places in zip(listed, of_run, strict=True)
    )


def _root_mean(squared: np.ndarray) -> float:
    """Root of the mean over the transitions whose simulation does not diverge, (T, n); NaN if there is none."""
    reached = squared[np.isfinite(squared).all(1)]
    return float(np.sqrt(reached.mean())) if len(reached) else float("nan")
