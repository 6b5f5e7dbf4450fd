"""Thresholds and budgets of the held-out errors, the lists of the report, and the verdict.

A share lies between 0 and 1; a spread is the standard deviation of an observed dimension over the data.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class JudgeSettings:
    """The held-out errors, the floor, the two-sample test, and the lists of the report."""

    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Control steps ahead at which errors are reported."""
    headline_seconds: tuple[float, ...] = (0.1, 0.2, 0.5, 1.0)
    """Times ahead, in s, from which that of the report's sentence is chosen."""
    headline_windows: int = 8
    """Smallest number of held-out windows for such a time."""
    headline_least: float = 1.5
    """Median error over that by noise alone from which a quantity may be the sentence's."""
    headline_stands_out: float = 3.0
    """Median error over the median error by sensor noise at which the sentence's time is chosen."""
    noise_windows: int = 100
    """Largest number of windows by which this is decided."""
    shown_seconds: float = 0.1
    """Time ahead, in s, of the windows that the report shows."""
    shown_steps: int = 5
    """Smallest number of control steps in these windows."""
    shown_quantities: int = 4
    """Largest number of quantities shown of a window, those with the largest errors."""
    max_runs: int = 200
    """Largest number of runs whose errors are listed."""
    max_rejected: int = 30
    """Largest number of rejected effects in the report."""
    rounding: float = 1e-5
    """Residual, in spreads of the one-step change, below which no autocorrelation is computed."""
    rounding_unobserved: float = 1e-3
    """The same if some coordinates are unobserved, because the errors of their estimates last for several steps."""
    classifier_updates: int = 600
    """Updates of the discriminators in the two-sample test."""
    classifier_batch: int = 256
    """Batch size of these updates."""
    classifier_cells: tuple[int, ...] = (64, 64)
    """Hidden layers of the discriminators."""
    floor_width: int = 64
    """Width of the two hidden layers of the network that estimates the floor."""
    floor_batch: int = 128
    """Batch size of the floor network's updates."""
    floor_epochs: int = 60
    """Epochs of the floor network's training."""
    floor_patience: int = 12
    """Epochs without a new lowest loss after which the floor network's training stops."""
    floor_blocks: int = 20
    """Blocks of neighbouring rows; every fifth block is used for early stopping of the floor network."""
    floor_clip: float = 5.0
    """Standard deviations at which the floor network's inputs and targets are clipped."""
    separation_share: float = 0.05
    """Share of the transitions, those with the largest differences of the predictions, that are described."""
    separation_negligible: float = 1e-6
    """Difference of predictions, in spreads, below which they count as equal."""
    separation_factor: float = 1.5
    """Factor by which a coordinate must differ from its usual size to be named in the description."""


@dataclass(frozen=True)
class VerdictSettings:
    """The tests of whether something is missing, and of whether an explanation should be used."""

    auc: float = 0.65
    """Held-out AUC above which a classifier tells measured from simulated; noise and contacts alone give up to 0.56."""
    autocorrelation: float = 0.2
    """Rank correlation of successive residuals above which they are not noise."""
    far_windows: int = 8
    """Smallest number of windows by which the error far ahead is judged."""
    far_ratio: float = 2.0
    """Median error far ahead, in multiples of the median error by sensor noise, above which something is missing."""
    far_negligible: float = 0.01
    """Median error far ahead, in spreads, that is negligible without sensor noise."""
    small_rest: float = 0.02
    """Share of the error ahead below which the remaining error is not reported as a missing effect."""
    level: float = 0.01
    """Significance level of a change of the error on the report's data."""
    worse: float = 1.1
    """Factor on the median error of a quantity above which the effects make it worse."""
    worse_negligible: float = 0.001
    """Median error, in spreads, below which a rise does not count."""
    better_than_guess: float = 0.8
    """Median error ahead up to which effects explain the motion, in errors of the guess of constant velocities."""
    more_force: float = 1.5
    """Factor by which effects may raise the force that a joint's measured motion needs beyond the simulator's."""
    more_force_if_stands: float = 3.0
    """The same for effects that predict the motion, beyond a regression's proposal that takes their place."""
    force_left_if_stands: float = 0.05
    """Share of each missing force that effects may leave and keep their place, if they predict the motion."""
    own_force: float = 1.2
    """Factor by which effects on a joint may raise its missing force and still count as explaining the forces."""
    less_force: float = 0.5
    """Factor on the product of the missing forces below which effects explain them, whatever the motion shows."""
    auc_near_one: float = 0.95
    """AUC with the effects above which an explanation is not recommended, unless it lowers the error much."""
    raised: float = 1.1
    """Factor by which effects may raise the error in the report's sentence; beyond it they are not recommended."""
    much_lower: float = 0.5
    """Share of the error ahead below which an explanation counts in spite of such an AUC."""
    lowers_much: float = 0.8
    """Share of the held-out error that an effect which was not put in must leave at most to be named all the same."""
    noise_beside_friction: float = 0.8
    """Share of a dry friction from which noise of the actions at its joint makes its value doubtful."""
    far_from_model: float = 2.0
    """Factor on a mass or a motor's gain from which the report says that only ratios show in the motion."""
    extreme_factor: float = 20.0
    """Factor on a property of the model beyond which the value is reported as implausible."""
    blocks: int = 10
    """Blocks of the report's data in which the largest residual is looked for."""
