"""Thresholds and budgets of the audit, as one documented settings object."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AuditSettings:
    """What counts as a fault of measured data. Shares lie between 0 and 1; a spread is a column's standard deviation.

    The defaults were set with real logs of a wheel-legged robot, a pendulum and a double pendulum, which are sound,
    and with recordings that were damaged on purpose.
    """

    # time
    step_off: float = 0.02
    """Share by which the median time step may differ from the simulator's control step."""
    step_far_off: float = 0.3
    """Share beyond which that difference is severe."""
    late_step: float = 0.2
    """Share of the median time step by which a single step may differ before it counts as irregular."""
    irregular: float = 0.003
    """Share of irregular steps beyond which they are a warning; below they are a note."""
    very_irregular: float = 0.05
    """Share of irregular steps beyond which they are severe."""
    short_runs: float = 50.0
    """Mean number of rows between two splits of a log with time stamps below which a warning is given."""
    very_short_runs: float = 15.0
    """The number below which it is severe."""
    few_rows_per_period: float = 6.0
    """Rows per period of the model's fastest oscillation below which a note is given."""

    step_multiples: tuple[int, ...] = (2, 3, 4, 5, 10)
    """Control steps per row that are tried if the simulator does not lead from row to row."""

    # rows
    examples: int = 5
    """Ranges of rows that a finding lists."""
    repeated: float = 0.001
    """Share of repeated rows, of those in motion, beyond which they are a warning."""
    many_repeated: float = 0.15
    """The share beyond which repeated rows are severe."""
    moving: float = 0.2
    """Velocity, in spreads, beyond which a joint moves: an equal next reading is then no chance."""
    jump: float = 0.5
    """Deviation of a position from the integral of its velocity, in spreads, that may be a jump."""
    jump_noise: float = 8.0
    """Smallest jump, in usual deviations."""
    many_jumps: float = 0.01
    """Share of jumps beyond which they are severe."""
    spike: float = 0.2
    """Part of a jump's size to which a signal returns in the next row if the jump was a single wrong reading."""
    max_suspects: int = 400
    """Rows with a possible jump that are compared with the simulator."""
    broken_runs: float = 0.2
    """Share of rows that do not continue the row before beyond which the order of the rows is lost."""
    frozen_rows: int = 20
    """Shortest stretch of equal readings that counts as frozen."""
    frozen_severe: float = 0.1
    """Share of frozen rows beyond which they are severe."""
    at_end: float = 0.002
    """Share of readings that equal a column's extreme beyond which the column is clipped."""
    mostly_at_end: float = 0.3
    """The share beyond which clipping is severe."""
    quantum_note: float = 0.05
    """Resolution of a column, in spreads, from which a note is given."""
    quantum_warning: float = 0.12
    """Resolution of a column, in spreads, from which a warning is given."""
    duplicate_block: int = 20
    """Shortest stretch of rows that counts as recorded twice."""

    # kinematics
    span: float = 0.3
    """Displacement, in spreads of the position, over which slopes are fitted; longer windows average noise."""
    longest_span: int = 64
    """Rows of the longest such window."""
    related: float = 0.7
    """Correlation of a displacement with the integral of the velocity below which they do not belong together."""
    scale_warning: tuple[float, float] = (0.85, 1.18)
    """Factors between a position's derivative and its velocity that are unsuspicious."""
    scale_severe: tuple[float, float] = (0.6, 1.67)
    """Factors between which a wrong scale is only a warning."""
    fine: float = 0.7
    """Correlation of successive velocities below which rows are too far apart for a small error of scale to show."""
    known_factor: float = 0.15
    """Relative distance to a known factor, such as 57.3 deg/rad, at which it is named."""
    same_factor: float = 0.1
    """Relative spread of the factors of all joints within which the time is wrong, not the units."""
    velocity_lags: tuple[int, int] = (-3, 24)
    """Rows by which a velocity may be early or late."""
    lag_warning: float = 1.5
    """Rows of lateness from which a warning is given; below, from one row, a note."""
    lag_gain: float = 0.7
    """Share of the unexplained variance that must remain at most when the velocity is shifted."""
    noise_warning: float = 0.12
    """Standard deviation of a sensor's noise, in spreads, from which a warning is given."""
    noise_severe: float = 0.6
    """The noise from which it is severe."""
    bias_warning: float = 0.3
    """Constant error of a velocity, in spreads of the velocity, from which a warning is given."""

    quaternion_norm: float = 0.05
    """Distance of a quaternion's norm from 1 from which it is none."""
    lost_norm: float = 0.5
    """The same distance in few rows: a tracker that has lost the body writes zeros."""
    lost_quaternions: float = 0.001
    """Share of rows with other numbers from which they are named; severe beyond ``many_repeated``."""
    turned: float = 0.2
    """Share of a body's rotations or displacements that its velocities leave unexplained, from which they are wrong."""
    better_orientation: float = 0.5
    """Share of this misfit that another meaning of the columns must leave at most."""

    # model and actions
    windows: int = 300
    """Windows that are simulated."""
    regression_steps: int = 300_000
    """Largest number of physics steps of all regressions for reversed joints and angles in the world; robots with too
    many joints are not checked for them."""
    hypothesis_windows: int = 200
    """Windows on which a hypothesis such as exchanged joints is simulated."""
    hypothesis_steps: int = 1_000
    """Largest number of physics steps of one hypothesis."""
    physics_steps: int = 3_000
    """Largest number of physics steps of one pass over the windows."""
    longest_steps: int = 200
    """Physics steps of a window up to which ``min_windows`` are simulated in any case."""
    min_windows: int = 60
    """Windows below which the model is not consulted."""
    longest_window: float = 0.1
    """Longest window, in s."""
    signal_to_noise: float = 4.0
    """Change of the velocities within a window, in standard deviations of their noise, that windows are chosen for."""
    drowned: float = 0.6
    """Noise of a change, in usual changes of the velocities, above which a bad fit is no evidence against the data."""
    settling_steps: int = 12
    """Control steps from which unobserved coordinates are simulated."""
    nudge: float = 0.02
    """Step of derivatives, in ranges or spreads of the action, or spreads of the observation."""
    zero_nudge: float = 0.02
    """Step of derivatives by the zero of a position, in rad or m."""
    robust: float = 3.0
    """Usual deviations beyond which a window loses weight in fits."""
    rotors: tuple[float, ...] = (1.0, 3.0, 10.0, 30.0, 100.0)
    """Inertias of rotors that are tried, in inertias of their joint in the model."""
    rotors_leave: float = 0.65
    """Share of the accelerations that may stay unexplained with rotors, any gains and friction; above it, these are not
    what is missing."""
    misfit: float = 0.3
    """Share of the change of the velocities that the simulator leaves unexplained, above which causes are sought."""
    better: float = 0.6
    """Share of this misfit that a cause must leave at most."""
    action_matters: float = 0.15
    """Share of the explained change that must be due to actions before conclusions about them are drawn."""
    action_shows: float = 0.3
    """Square of what the actions do in the simulator and friction would not, over that of what stays unexplained, from
    which conclusions about them are drawn."""
    unrelated: float = 0.05
    """Share of the variance beyond friction that actions explain at their best lag, below which they may belong to
    another run."""
    action_lags: tuple[int, int] = (-5, 40)
    """Rows by which actions may act early or late."""
    clear_lag: int = 4
    """Rows of a lag of sudden changes from which it is reported, even if the whole motion does not show it."""
    lag_significance: float = 10.0
    """Logarithm of the likelihood ratio that such a lag must have against no lag."""
    lag_share: float = 0.85
    """Share of the unexplained variance that must remain at most at another lag."""
    ordinary_lag: float = 0.03
    """Lateness of actuators, in s, that is an ordinary property of drives."""
    ordinary_lag_rows: float = 3.5
    """Rows of lateness up to which an ordinary lag is only a note."""
    severe_lag: float = 0.1
    """Lateness, in s, from which it is severe: no drive is so late."""
    significance: float = 6.0
    """Standard errors that a fitted value must have."""
    gain_severe: tuple[float, float] = (0.04, 25.0)
    """Gains outside these are a wrong unit."""
    gain_warning: tuple[float, float] = (0.4, 2.5)
    """Gains outside these are a warning."""
    zero_warning: float = 0.1
    """Error of an angle's zero, in rad, from which a warning is given."""
    zero_severe: float = 0.5
    """Error of an angle's zero, in rad, from which it is severe, and sought in parts of the log as well."""
    zero_change: float = 5.0
    """Sum over windows of the unexplained shares by which a change of a zero within a run must lower them."""
    zero_gain: float = 0.03
    """Unexplained share of a window that a large shift must explain at least, so that shifts without effect are 0."""
    zero_explained: float = 0.5
    """Share of the accelerations that may stay unexplained in the whole log with a large shift, any gains and friction;
    above it, something else is wrong as well, and no zero is blamed."""
    zero_better: float = 0.8
    """Share of the misfit that a corrected zero must leave at most."""
    force_left: float = 0.6
    """Share of what friction leaves of the force missing at a joint without actuators that a corrected zero must leave
    at most."""
    foreign: float = 0.85
    """Misfit that the best gains, friction and zeros leave, above which the log belongs to another robot."""
    cancelled: float = 0.5
    """Share of the actions' simulated effect. If friction explains all but less than this share, gains are not
    judged."""
    saturated: float = 0.2
    """Share of actions at their extreme from which a note is given."""
    mostly_saturated: float = 0.9
    """The share from which a warning is given."""

    # excitation
    alike: float = 0.9
    """Cosine of the angle between two effects' sensitivities from which they look alike."""
    combined: float = 0.92
    """Multiple correlation with the other effects of a joint from which an effect looks like their combination."""
    negligible: float = 0.02
    """Size of a trial effect's response, in usual changes of the velocities, below which it is not excited."""


AUDIT_SETTINGS = AuditSettings()
