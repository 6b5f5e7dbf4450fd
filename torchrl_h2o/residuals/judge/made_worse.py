"""Measured quantities that a simulator predicts worse with the effects found than without them."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.significance import WORST, p_value_of_losses
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.errors import HeadlineError
from torchrl_h2o.residuals.report.sentence import headline_words
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation

FAR_WINDOWS = 8  # smallest number of windows by which the error far ahead is judged
NEGLIGIBLE_ERROR = 0.001  # median error, in spreads, below which a rise does not count
WORSE = 1.1  # factor on the median error of a quantity above which the effects make it worse


def made_worse(
    simulation: Simulation, mended: Simulation, measured: Measured, steps: int, settings: LoopSettings = DEFAULTS
) -> tuple[str, ...]:
    """Names the quantity whose error the effects raise most, as evidence that one of them is wrong.

    A fit lowers the sum over all quantities. A wrong effect can lower it, if what one quantity gains exceeds what
    another one loses; a right one lowers all errors, or leaves them as they are.

    Args:
        simulation: the simulator before effects are put in.
        mended: the simulator with them.
        measured: the data, of which the part for the report is used.
        steps: control steps ahead at which the errors are compared.
        settings: significance level.

    Returns:
        One clause, or nothing if no error rises by enough and significantly.
    """
    starts = in_motion(measured, measured.reported_on(steps), steps, FAR_WINDOWS)
    if len(starts) < FAR_WINDOWS:
        return ()
    names, units = simulation.state_map.names, simulation.state_map.units
    spread = np.maximum(measured.observation.std(0), 1e-12)
    before, after = (
        np.fmin(np.abs(residuals(which, measured, starts, steps)[:, -1]), WORST * spread)
        for which in (simulation, mended)
    )
    medians = np.median(before, axis=0), np.median(after, axis=0)
    rise = medians[1] / np.maximum(medians[0], NEGLIGIBLE_ERROR * spread)
    index = int(rise.argmax())
    p = p_value_of_losses(after[:, index], before[:, index], settings)
    if rise[index] <= WORSE or p >= settings.level / len(names):
        return ()
    old, new = (float(median[index]) for median in medians)
    rose = HeadlineError(names[index], units[index], steps * simulation.control_step, old, new)
    return (f"at least one of these effects is wrong: they raise the error of {headline_words(rose)}",)
