"""The settings of closing the loop: confidence, horizons and budgets. Other thresholds are constants in the modules."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LoopSettings:
    """The settings of :func:`close_the_loop`.

    Examples:
        >>> LoopSettings(level=0.001, horizons=(1, 10)).horizons
        (1, 10)
    """

    level: float = 0.01
    """Significance level of a whole search; a search over a catalogue divides it by the number of entries."""
    blocks: int = 30
    """Blocks of neighbouring windows that the paired tests treat as independent."""
    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Control steps ahead at which errors are reported."""
    window_seconds: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    """Window lengths that the search chooses from, in s, ascending; one control step is always among them."""
    max_windows: int = 3500
    """Largest number of windows in a fit or a judgement; more are slower and hardly more precise."""
    screened_steps: int = 400
    """Control steps, over all windows, on which entries of the catalogue are screened."""
    fitted_steps: int = 1200
    """Control steps, over all windows, in a fit during the search."""
    max_evaluations: int = 25
    """Evaluations of the residual in a full fit, finite differences not counted."""
    max_effects: int = 6
    """Largest number of effects in one explanation; the same effect on each of several joints counts as one."""
    rounds: int = 3
    """Largest number of rounds of growing and simplifying."""
    classifier_updates: int = 600
    """Updates of the discriminators in the two-sample test."""


DEFAULTS = LoopSettings()
