"""Thresholds of the measured data: states, sensor noise, disturbances from outside, residuals.

A share lies between 0 and 1; a spread is the standard deviation of an observed dimension over the data.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeasuredSettings:
    """How measured transitions are checked, sampled, and turned into states and noise levels."""

    min_transitions: int = 200
    """Usable transitions below which no conclusion is drawn: no test could distinguish an effect from chance."""
    selection: float = 0.27
    """Share of the transitions that are not reported on, by which effects are chosen; a fifth of all by default."""
    border_moves: float = 0.1
    """Share of the transitions by which a border between two parts of the data moves to the end of a run."""
    alike: float = 0.3
    """Ratio of an action's ranges (5th to 95th percentile) in two parts of several logs below which the logs differ in
    kind, such as free and driven motion."""
    rest_rows: int = 10
    """Rows by which it is judged whether something moves."""
    rest: float = 2.0
    """Standard deviation of a reading over these rows, in that of its noise, up to which it stands still."""
    least_rest: float = 1e-3
    """The same in spreads, for sensors without noise."""
    most_rest: float = 0.05
    """The same in spreads, for sensors so noisy, or rows so far apart, that their noise cannot be told from motion."""
    max_windows: int = 3500
    """Largest number of windows in a fit or a judgement; more are slower and hardly more precise."""
    max_diverged: float = 0.1
    """Largest share of transitions at which the simulator may diverge in one step, for example at falls."""
    settling_steps: int = 64
    """Control steps after which the observed coordinates determine the unobserved ones."""
    settled_rows: int = 50
    """Largest number of successive rows that share a simulation of the unobserved coordinates."""
    windows_in_block: int = 25
    """Neighbouring windows that are kept together where there are unobserved coordinates, to share a simulation."""
    action_memory: int = 12
    """First control steps of a run in which earlier actions count as unknown."""
    state_nudge: float = 1e-3
    """Step of the finite differences by the observation, in spreads."""
    noise_rows: int = 2000
    """Transitions from which the sensors' noise is estimated."""
    noiseless: float = 1e-4
    """Sensor noise, in spreads, up to which a dimension counts as free of noise; the bias of a fit is negligible."""
    noise_clip: float = 4.0
    """Robust standard deviations at which residuals are clipped before the sensors' noise is estimated."""
    filter_surprise: float = 4.0
    """Normalised squared innovation beyond which the Kalman filter follows the measurement."""
    variance_floor: float = 1e-12
    """Smallest variance in the filter, in squared spreads."""


@dataclass(frozen=True)
class OutsideSettings:
    """What counts as a disturbance from outside, such as a push."""

    horizon: int = 8
    """Control steps of the windows, shorter than the disturbances to find."""
    threshold: float = 12.0
    """Residual, in multiples of the usual one, beyond which a window is surprising."""
    neighbours: int = 6
    """Number of events with a similar start that a surprising window is compared with."""
    events_apart: int = 5
    """Distance between two events, in window lengths; windows closer in time belong to the same event."""
    recurring_quantile: float = 0.8
    """Quantile of the neighbours' residuals that is taken as recurring, because a neighbour may itself be a push."""
    recurring_factor: float = 2.0
    """Multiple of the recurring residual up to which a residual is attributed to the same recurring cause."""
    max_event_rate: float = 0.003
    """Events per window beyond which large residuals are a fault of the simulator, not disturbances."""
    max_share: float = 0.1
    """Share of surprising windows beyond which large residuals are a fault of the simulator, not disturbances."""
    rounding: float = 1e-5
    """Residual, in spreads, up to which it counts as zero."""


@dataclass(frozen=True)
class ResidualSettings:
    """How residuals are scaled before they are fitted."""

    worst: float = 1e3
    """Bound on a scaled residual, also used where the simulation diverges."""
    rounding: float = 2e-7
    """Relative rounding error of the data, which are single precision."""
    most_cut_off: float = 0.05
    """Share of the residuals that may be cut off at ``worst``; if there are more, they set the scale."""
    rounding_unobserved: float = 2e-4
    """Residual where coordinates are unobserved, in spreads of the change in a step, up to which it counts as zero.
    MuJoCo solves contacts up to a tolerance, and begins with the solution of the step before, which is not known."""
    settled_share: float = 0.9
    """Share of the residuals that must be this small."""
    noise_draws: int = 4
    """Number of draws of sensor noise for the estimate of its effect on each window."""
