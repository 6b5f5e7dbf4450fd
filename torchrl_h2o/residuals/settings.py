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
    """Inverse of the likelihood ratio that the rows for selection must show for an effect; level of the other tests."""
    blocks: int = 30
    """Blocks of neighbouring windows that the paired tests treat as independent."""
    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Control steps ahead at which errors are reported."""
    window_seconds: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
    """Times ahead of which the verdict takes the longest that the data allow, in s, ascending."""
    max_windows: int = 3500
    """Largest number of windows in a judgement; more are slower and hardly more precise."""


DEFAULTS = LoopSettings()
