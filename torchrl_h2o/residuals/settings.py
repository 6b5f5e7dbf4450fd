"""Thresholds and budgets of closing the loop: one frozen dataclass per stage, all held by :class:`LoopSettings`.

Shares lie between 0 and 1; a spread is the standard deviation of an observed dimension over the data.
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
    max_windows: int = 3500
    """Largest number of windows in a fit or a judgement; more are slower and hardly more precise."""
    max_diverged: float = 0.1
    """Largest share of transitions at which the simulator may diverge in one step, for example at falls."""
    settling_steps: int = 12
    """Control steps after which the observed coordinates determine the unobserved ones."""
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
    noise_draws: int = 4
    """Number of draws of sensor noise for the estimate of its effect on each window."""


@dataclass(frozen=True)
class SignificanceSettings:
    """The paired tests on held-out losses."""

    level: float = 0.01
    """Significance level of a whole search; a search over a catalogue divides it by the number of entries."""
    blocks: int = 30
    """Blocks of neighbouring windows that are treated as independent."""
    max_odds: float = 100.0
    """Largest factor that a single block may contribute to the payoff of the bet."""
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
    much_lower: float = 0.5
    """Share of the present loss below which an addition counts, however small its part of the whole reduction is."""
    beyond_noise: float = 4.0
    """Required multiple of the gain of the same addition in synthetic data with sensor noise only."""
    max_effects: int = 6
    """Largest number of effects in one explanation."""
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
    """Share of the loss to which a quick fit without sensor noise must lower it; else the sensors have noise."""
    noise_free_fits: int = 4
    """Largest number of such fits, each with residuals scaled anew, that may leave only rounding."""
    leads_combined: int = 60
    """Number of most promising leads from which sets are formed."""
    set_sizes: tuple[tuple[int, int], ...] = ((1, 12), (2, 4), (3, 4))
    """Pairs (size of a set, number of sets of this size that are sketched); larger sets if no smaller one helps."""
    finalists: int = 3
    """Number of sketched sets of one size that are fitted on all windows of the search, at least."""
    close_sketch: float = 0.4
    """Share of the gain of the best sketch of one size from which further sets are fitted."""
    beam_width: int = 3
    """Largest number of lists of effects that the search grows side by side."""
    beam_loss: float = 1.25
    """Multiple of the lowest loss up to which another list is grown as well."""
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
class UndeclaredSettings:
    """The search for a force outside the catalogue, and its comparison with the catalogue's effects."""

    min_gain: float = 0.01
    """Share of the held-out loss that all terms of the force must explain."""
    min_term_gain: float = 0.002
    """Share of the loss that a round must explain, and by which removing a term may raise the loss."""
    rounds: int = 6
    """Largest number of rounds of adding terms."""
    further_steps: int = 5
    """Control steps ahead at which the force must also lower the loss; a fit to sensor noise does not."""
    max_terms: int = 6
    """Largest number of terms of the whole force."""
    negligible: float = 1e-6
    """Residual, in spreads, that counts as rounding."""
    min_gain_over_catalogue: float = 0.05
    """Share of the held-out loss that a force must explain beside or instead of the catalogue's effects."""
    min_share: float = 0.01
    """Share of the whole reduction of the loss that the force must contribute."""
    beyond_noise: float = 2.0
    """Required multiple of the gain of a force found in synthetic data with sensor noise only."""


@dataclass(frozen=True)
class RegressionSettings:
    """The sparse regression of a force on a library of terms."""

    tails: float = 4.0
    """Degrees of freedom of the residuals' t-distribution; contacts and outliers make its tails heavy."""
    scatter_iterations: int = 15
    """Iterations of the scatter estimate."""
    shrinkage: float = 0.01
    """Shrinkage of the scatter towards its diagonal, so that it can be inverted without noise."""
    force_nudge: float = 0.1
    """Step of the finite differences by the force, as a share of the typical force."""
    max_terms: int = 3
    """Largest number of terms on one degree of freedom per round."""
    blocks: int = 10
    """Blocks of neighbouring rows that are held back together."""
    folds: int = 5
    """Folds of the cross-validation."""
    level: float = 1e-4
    """Significance level of the F-test of a term, for a whole library."""
    min_gain: float = 0.01
    """Share of the unexplained sum of squares that a term must explain."""
    negligible: float = 1e-9
    """Relative spread or norm at which a coordinate or column counts as constant."""
    max_waves: float = 15.0
    """Largest number of periods over the range of a position; faster waves cannot be distinguished from noise."""
    max_harmonic: float = 30.0
    """Largest number of periods per turn of a hinge, such as the torque ripple of a motor with many poles."""
    scan_spacing: float = 0.8
    """Spacing of scanned frequencies, in rad over the range."""
    max_scanned: int = 1500
    """Largest number of scanned frequencies."""
    scanned_values: int = 5000
    """Number of positions on which frequencies are scanned; the best one is then refined on all positions."""
    min_periods: float = 1.5
    """Smallest number of periods of a wave in time; fewer cannot be distinguished from a trend."""
    min_step_share: float = 0.03
    """Smallest share of the rows on either side of a step in time."""


@dataclass(frozen=True)
class NoiseSettings:
    """The estimate of action noise from the scatter of the residuals."""

    blocks: int = 10
    """Blocks of the data that are left out in turn for the interval."""
    iterations: int = 8
    """Iterations of the Fisher scoring."""
    nudge: float = 1e-4
    """Step of the finite differences, in spreads or in shares of the largest action."""
    variance_floor: float = 1e-3
    """Variance added to every dimension, as a share of the squared mean residual; allows for inexact derivatives."""
    usual: float = 0.995
    """Quantile of normal residuals beyond which a residual is clipped; contacts cause outliers."""
    tails: float = 4.0
    """Degrees of freedom of the t-distribution in the held-out likelihood; contacts cause outliers."""
    min_share: float = 1e-3
    """Smallest reported standard deviation, as a share of the control range."""
    max_share: float = 2.0
    """Largest plausible standard deviation, in RMS of the actions; larger estimates come from filtered sensors."""
    min_half_widths: float = 3.0
    """Number of half-widths that the estimate must exceed, because the interval omits errors that blocks share."""
    beyond_sensors: float = 3.0
    """Required multiple of the estimate from synthetic data with sensor noise only."""
    min_change: float = 0.1
    """Smallest reported change, as a share of the variance of the simulator's own action noise."""


@dataclass(frozen=True)
class JudgeSettings:
    """The held-out errors, the floor, the two-sample test, and the lists of the report."""

    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Control steps ahead at which errors are reported."""
    headline_seconds: tuple[float, ...] = (0.1, 0.2, 0.5, 1.0)
    """Times ahead, in s, from which that of the report's sentence is chosen."""
    headline_windows: int = 8
    """Smallest number of held-out windows for such a time."""
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
    """Significance level of the decrease of the error on the report's data."""
    auc_near_one: float = 0.95
    """AUC with the effects above which an explanation is not recommended, unless it lowers the error much."""
    much_lower: float = 0.5
    """Share of the error ahead below which an explanation counts in spite of such an AUC."""
    extreme_factor: float = 20.0
    """Factor on a property of the model beyond which the value is reported as implausible."""
    blocks: int = 10
    """Blocks of the report's data in which the largest residual is looked for."""


@dataclass(frozen=True)
class LoopSettings:
    """The settings of :func:`close_the_loop`, stage by stage.

    Examples:
        >>> from dataclasses import replace
        >>> strict = LoopSettings(trace=TraceSettings(min_gain=0.01))
        >>> replace(strict, judge=JudgeSettings(horizons=(1, 10))).judge.horizons
        (1, 10)
    """

    measured: MeasuredSettings = MeasuredSettings()
    """Reading and sampling of the data, states and sensor noise."""
    outside: OutsideSettings = OutsideSettings()
    """Disturbances from outside."""
    residual: ResidualSettings = ResidualSettings()
    """Scaling of residuals, in every fit."""
    significance: SignificanceSettings = SignificanceSettings()
    """Paired tests, in every search."""
    fit: FitSettings = FitSettings()
    """Least-squares fits, in every search."""
    horizon: HorizonSettings = HorizonSettings()
    """Choice of the window length."""
    trace: TraceSettings = TraceSettings()
    """Search over the catalogue."""
    undeclared: UndeclaredSettings = UndeclaredSettings()
    """Search for a force outside the catalogue."""
    regression: RegressionSettings = RegressionSettings()
    """Terms of that force."""
    noise: NoiseSettings = NoiseSettings()
    """Action noise."""
    judge: JudgeSettings = JudgeSettings()
    """Held-out errors and the report."""
    verdict: VerdictSettings = VerdictSettings()
    """The verdict."""


DEFAULTS = LoopSettings()
