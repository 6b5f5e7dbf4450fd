"""The settings of closing the loop: one frozen dataclass of thresholds and budgets for each stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchrl_h2o.residuals.judge.settings import JudgeSettings, VerdictSettings
from torchrl_h2o.residuals.measured.settings import MeasuredSettings, OutsideSettings, ResidualSettings
from torchrl_h2o.residuals.noise.settings import NoiseSettings
from torchrl_h2o.residuals.trace.settings import (
    FitSettings,
    HorizonSettings,
    InverseDynamicsSettings,
    LongerWindowsSettings,
    SignificanceSettings,
    TraceSettings,
)
from torchrl_h2o.residuals.undeclared.settings import RegressionSettings, UndeclaredSettings


@dataclass(frozen=True)
class LoopSettings:
    """The settings of :func:`close_the_loop`, stage by stage.

    Examples:
        >>> from dataclasses import replace
        >>> strict = LoopSettings(trace=TraceSettings(min_gain=0.01))
        >>> replace(strict, judge=JudgeSettings(horizons=(1, 10))).judge.horizons
        (1, 10)
    """

    measured: MeasuredSettings = field(default_factory=MeasuredSettings)
    """Reading and sampling of the data, states and sensor noise."""
    outside: OutsideSettings = field(default_factory=OutsideSettings)
    """Disturbances from outside."""
    residual: ResidualSettings = field(default_factory=ResidualSettings)
    """Scaling of residuals, in every fit."""
    significance: SignificanceSettings = field(default_factory=SignificanceSettings)
    """Paired tests, in every search."""
    fit: FitSettings = field(default_factory=FitSettings)
    """Least-squares fits, in every search."""
    horizon: HorizonSettings = field(default_factory=HorizonSettings)
    """Choice of the window length."""
    trace: TraceSettings = field(default_factory=TraceSettings)
    """Search over the catalogue."""
    longer_windows: LongerWindowsSettings = field(default_factory=LongerWindowsSettings)
    inverse_dynamics: InverseDynamicsSettings = field(default_factory=InverseDynamicsSettings)
    """Regression of missing forces."""
    undeclared: UndeclaredSettings = field(default_factory=UndeclaredSettings)
    """Search for a force outside the catalogue."""
    regression: RegressionSettings = field(default_factory=RegressionSettings)
    """Terms of that force."""
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    """Action noise."""
    judge: JudgeSettings = field(default_factory=JudgeSettings)
    """Held-out errors and the report."""
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    """The verdict."""


DEFAULTS = LoopSettings()
