"""Thresholds and budgets of the search over the catalogue: tests, fits, window length, the search itself.

A share lies between 0 and 1; a spread is the standard deviation of an observed dimension over the data.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SignificanceSettings:
    """The paired tests on held-out losses."""

    level: float = 0.01
    """Significance level of a whole search; a search over a catalogue divides it by the number of entries."""
    blocks: int = 30
    """Blocks of neighbouring windows that are treated as independent."""
    max_ratio: float = 100.0
    """Largest factor that a single block may contribute to the third test's likelihood ratio."""
    loss_floor: float = 1e-6
    """Smallest typical loss of a block, as a share of the mean loss."""


@dataclass(frozen=True)
class FitSettings:
    """The bounded least-squares fit."""

    origin: float = 10.0
    """Start value of every scaled variable; it makes relative steps proportional to the parameter's typical size."""
    max_move: float = 50.0
    """Largest change of a parameter in one fit, in multiples of its typical size."""
    difference_step: float = 1e-5
    """Relative step of the finite differences: 1e-4 of a parameter's typical size."""
    coarse_step: float = 1e-3
    """Relative step in a second fit, where the first one gained little: 1e-2 of a parameter's typical size."""
    loss_tolerance: float = 1e-5
    """Relative change of the loss at which the optimiser stops."""
    variable_tolerance: float = 1e-7
    """Relative change of the variables at which the optimiser stops."""
    max_evaluations: int = 25
    """Evaluations of the residual in a full fit, finite differences not counted."""


@dataclass(frozen=True)
class HorizonSettings:
    """The choice of the window length for the search."""

    seconds: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    """Window lengths to choose from, in s, ascending; one control step is always among them."""
    windows: int = 100
    """Largest number of windows by which a length is judged."""
    min_fitted: int = 20
    """Smallest number of windows for fits that a length must leave."""
    min_selected: int = 16
    """Smallest number of windows for the selection of effects that a length must leave. With fewer windows, no gain is
    significant after the level is divided by the number of effects tried."""
    stands_out: float = 10.0
    """Median error over the median error that sensor noise alone causes, beyond which no longer windows are tried."""
    least_ratio: float = 1.5
    """Smallest such ratio of windows longer than one step; a smaller one is chance."""
    longer_gain: float = 1.2
    """Factor by which this ratio must grow to justify longer windows, which cost more and amplify contact errors."""


@dataclass(frozen=True)
class TraceSettings:
    """The search for effects of the catalogue."""

    min_gain: float = 0.002
    """Share of the held-out loss that an addition must explain."""
    min_gain_under_noise: float = 0.02
    """The same share with noisy sensors, because noise in the start states may imitate an effect."""
    min_share: float = 0.003
    """Share of the whole reduction of the loss that each added effect must contribute."""
    min_share_unobserved: float = 0.005
    """The same share if some coordinates are unobserved: an effect may also make up for errors of their estimates."""
    much_lower: float = 0.5
    """Share of the present loss below which an addition counts, however small its part of the whole reduction is."""
    much_finer: float = 0.2
    """Ratio of the residuals' scales, after and before an addition, below which the effects are fitted once more."""
    beyond_noise: float = 4.0
    """Required multiple of the gain of the same addition in synthetic data with sensor noise only."""
    surely_beyond_noise: float = 0.5
    """Share of the held-out loss; an addition that explains more passes without a test against synthetic noise."""
    max_effects: int = 6
    """Largest number of effects in one explanation; the same effect on each of several joints counts as one."""
    rounds: int = 3
    """Largest number of rounds of growing and simplifying."""
    screened_steps: int = 400
    """Control steps, over all windows, on which entries are screened."""
    min_screened: int = 60
    """Smallest number of windows on which entries are screened."""
    fitted_steps: int = 1200
    """Control steps, over all windows, in a fit during the search."""
    min_fitted: int = 120
    """Smallest number of windows in a fit during the search."""
    noise_free_loss: float = 0.5
    """Share of the loss to which a refit or one more effect must lower it, or the sensors are taken to be noisy."""
    noise_free_fits: int = 4
    """Largest number of such fits, each with residuals scaled anew, that may leave only rounding."""
    leads_combined: int = 60
    """Number of most promising leads from which sets are formed."""
    set_sizes: tuple[tuple[int, int], ...] = ((1, 16), (2, 4), (3, 4))
    """Pairs (size of a set, number of sets of this size that are sketched); larger sets if no smaller one helps."""
    finalists: int = 3
    """Number of sketched sets of one size that are fitted on all windows of the search, at least."""
    close_sketch: float = 0.4
    """Share of the gain of the best sketch of one size from which further sets are fitted."""
    beam_width: int = 3
    """Largest number of lists of effects that the search grows side by side."""
    beam_loss: float = 1.25
    """Multiple of the lowest loss up to which another list is grown as well."""
    same_change: float = 0.999
    """Cosine of the angle between two entries' changes of the residual beyond which only the first one is sketched."""
    same_fit: float = 1e-3
    """Relative difference up to which two losses count as equal."""
    clearly_needed: float = 1.5
    """Multiple of the loss that a sketch without an effect must exceed for the effect to be kept without a full fit."""
    sketch_evaluations: int = 6
    """Evaluations of the residual in a sketch (quick fit) of an addition."""
    rival_evaluations: int = 20
    """Evaluations of the residual in a sketch of an alternative; the other parameters may change much."""
    nearest_rivals: int = 12
    """Number of alternatives tried in an effect's place because their promise was closest to its own."""
    top_rivals: int = 6
    """Number of alternatives tried in an effect's place because their promise was highest."""
    rival_min_first: float = 0.25
    """Share of an effect's gain that an alternative must reach in ``sketch_evaluations``; else it is given up."""
    rival_min_sketch: float = 0.5
    """Share of an effect's gain that an alternative must reach in its sketch to be fitted."""
    rival_min_exact: float = 0.9
    """Value in the place of ``rival_min_sketch`` if the effects found explain the data up to rounding."""
    rival_set_size: int = 3
    """Largest number of effects in another set that may explain the data as well."""
    rival_sets: int = 8
    """Number of such sets of each size that get a quick fit."""
    rival_finalists: int = 3
    """Number of such sets of each size that are fitted on all windows of the search."""
    same_loss: float = 1e-6
    """Loss difference between alternatives, as a share of the effect's gain, that counts as rounding."""
    alike_loss: float = 0.1
    """Loss difference, as a share of the effect's gain, beyond which an alternative is ruled out."""


@dataclass(frozen=True)
class LongerWindowsSettings:
    """Longer windows where sensors are noisy: a second search, and the last fit."""

    fits: int = 3
    """Fits, each with states estimated with the values of the one before."""
    steps: int = 10
    """Smallest number of control steps per window."""
    seconds: float = 0.1
    """Smallest length of a window, in s."""
    longest: float = 0.2
    """Largest length of a window, in s; it may have fewer control steps then."""


@dataclass(frozen=True)
class InverseDynamicsSettings:
    """The forces that a simulator lacks along the measured motion, and a regression of them."""

    half_width: float = 0.025
    """Half the length, in s, of the windows over which accelerations and forces are averaged."""
    rows: int = 1500
    """Largest number of rows in the regression."""
    parts_of_window: int = 10
    """Parts of a window, in the middle of each of which the simulator's force is computed; their mean counts."""
    resting: float = 0.1
    """Share of a joint's usual speed below which it counts as resting."""
    least_moving: int = 50
    """Smallest number of windows in which a joint moves in one direction for the others to be left out."""
    rounds: int = 3
    """Repetitions of the regression around the values found, because dry friction is soft in MuJoCo."""
    same_value: float = 0.01
    """Change of all values, as a share, up to which the regression is not repeated any more."""
    blocks: int = 20
    """Blocks of neighbouring windows by which intervals are computed."""
    least_rows: int = 200
    """Smallest number of rows."""
    more_left: float = 1.2
    """Multiple of the mean loss with all entries up to which entries are left out."""
    more_left_of_one: float = 1.5
    """The same for the force at each coordinate alone."""
    window: float = 0.1
    """Length of the windows with which the search begins anew, in s, if the data hold enough of them."""
