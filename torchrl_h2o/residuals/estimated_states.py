"""Start states and sensor noise estimated with the Kalman filter of the score, for predictions from noisy readings."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.blocks import SHORTEST, Blocks, block_steps
from torchrl_h2o.residuals.measured.residual import start_states
from torchrl_h2o.residuals.measured.settling import settle
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.record import Record
from torchrl_h2o.residuals.score import FIT_ROWS
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.start_states import OF_NORMAL, Noise, StartStates, filtered_rows

# sensor noise, in spreads, up to which a reading counts as free of noise
NOISELESS = 1e-4


def estimate_states(simulation: Simulation, measured: Measured, rows: np.ndarray | None = None) -> np.ndarray:
    """Estimates the states of rows from the rows up to and including them; see :class:`StartStates`.

    The noise is estimated from the rows for fits.

    Args:
        simulation: simulator with its sensors, delays and unobserved coordinates.
        measured: the data.
        rows: (W), rows that are needed; all by default. Others may have their measured states.

    Returns:
        (T, nq + nv).

    Examples:
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> from torchrl_h2o.residuals import Measured, Simulation
        >>> data = record(WheelLeggedEnv(), noisy_balance_controller(), 300, seed=0)
        >>> simulation = Simulation.from_env(WheelLeggedEnv())
        >>> estimate_states(simulation, Measured.from_ted(data, simulation)).shape
        (300, 8)
    """
    steps = block_steps(measured, simulation.control_step)
    needed = np.isin(np.arange(len(measured)), np.arange(len(measured)) if rows is None else rows)
    shortest = min((run.stop - run.start for run in measured.runs if needed[run].any()), default=steps)
    while steps > max(SHORTEST, shortest):
        steps //= 2
    first = [row for run in measured.runs for row in _firsts(run, steps) if needed[row : row + steps].any()]
    if not first:
        return start_states(simulation, measured, rows)
    blocks = Blocks(np.array(first), steps)
    both = [filtered_rows(one, measured) for one in (blocks, _blocks_for_fits(simulation, measured))]
    record = Record(simulation, measured, np.concatenate(both))
    starts = StartStates.of(record, blocks, _noise(simulation, measured))
    _, filtered = starts.of_rows
    simulated = np.array(simulation.state_map.hidden, int)[record.settled[len(simulation.state_map.names) :]]
    if len(simulated):
        reached = settle(simulation, measured, filtered, record.executed, np.flatnonzero(needed))
        filtered[:, simulated] = reached[:, simulated]
    return filtered


def _firsts(run: slice, steps: int) -> list[int]:
    """First rows of blocks that cover a run; the last two blocks may share rows."""
    last = run.stop - steps
    return [] if last < run.start else sorted({*range(run.start, last, steps), last})


def sensor_noise(simulation: Simulation, measured: Measured) -> np.ndarray | None:
    """Standard deviation of each sensor's noise, (n), in its unit; None if all of them are negligible.

    That of columns that were estimated from others is the error known of them.
    """
    spread = measured.observation.std(0)
    std = np.zeros(len(spread)) if measured.estimated_std is None else measured.estimated_std.copy()
    seen = Record(simulation, measured).seen
    std[seen] = _noise(simulation, measured).sensor * spread[seen] / OF_NORMAL
    return std if (std > NOISELESS * spread).any() else None


def _blocks_for_fits(simulation: Simulation, measured: Measured) -> Blocks:
    return Blocks.of(measured, Split.FIT, block_steps(measured, simulation.control_step), FIT_ROWS)


def _noise(simulation: Simulation, measured: Measured) -> Noise:
    def compute() -> Noise:
        blocks = _blocks_for_fits(simulation, measured)
        return StartStates.of(Record(simulation, measured, filtered_rows(blocks, measured)), blocks).noise

    return measured.remembered("noise", simulation, compute)
