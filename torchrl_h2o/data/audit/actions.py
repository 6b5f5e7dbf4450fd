"""Plain checks of the actions: constant, saturated, and beyond the range of their actuators."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.data.audit.response import Response

CHECK = "actions"
OUTSIDE_RANGE = 0.001  # share of actions outside an actuator's range from which they are named
SATURATED, MOSTLY_SATURATED = 0.2, 0.9  # share of actions at their extreme for a note; for a warning
AGREES = 0.3  # share of the accelerations that a simulator that agrees with a constant action leaves at most


def check_actions(log: Log, response: Response | None) -> list[Finding]:
    """Whether the actions vary within the range of their actuators.

    Args:
        log: the data.
        response: simulated windows; None if the simulator cannot be consulted.
    """
    found = []
    for index, name in enumerate(log.actuators):
        values = log.action[:, index]
        if np.ptp(values) == 0.0:
            found.append(_constant(log, index, response))
            continue
        ends = (values == values.min()) | (values == values.max())
        if ends.mean() > SATURATED:
            severity = "warning" if ends.mean() > MOSTLY_SATURATED else "note"
            words = f"{ends.mean():.0%} of the actions of {name} are at their extremes"
            remedy = "vary the actions within their range: the response to small actions does not show"
            found.append(Finding(CHECK, severity, words, Rows.of(ends), remedy))
    if response is not None:
        found += _beyond_range(log, response)
    return found


def _constant(log: Log, index: int, response: Response | None) -> Finding:
    name, value = log.actuators[index], log.action[0, index]
    explained = response is not None and response.misfit() < AGREES
    words = f"the action of {name} is {value:.4g} in all rows"
    if explained:
        return Finding(CHECK, "note", words + "; the motion agrees with that", None, "record the motor at work as well")
    moved = "" if response is None else ", and the simulator does not move like the log without other actions"
    severity = "warning" if response is None else "severe"
    return Finding(CHECK, severity, words + moved, None, "find the column that holds the action")


def _beyond_range(log: Log, response: Response) -> list[Finding]:
    model, found = response.simulation.model, []
    for index, name in enumerate(log.actuators):
        if not model.actuator_ctrllimited[index]:
            continue
        low, high = model.actuator_ctrlrange[index]
        margin = 1e-3 * (high - low)
        outside = (log.action[:, index] < low - margin) | (log.action[:, index] > high + margin)
        usual = float(np.median(np.abs(log.action[:, index])))
        far = usual > 3.0 * max(abs(low), abs(high))
        if outside.mean() > OUTSIDE_RANGE:
            words = f"{outside.mean():.0%} of the actions of {name} lie outside the range of its actuator, {low:.4g} "
            words += f"to {high:.4g}, up to {np.abs(log.action[:, index]).max():.4g}; the simulator clips them"
            words += ": they look like another unit" if far else ""
            severity = "severe" if far else "warning"
            remedy = "correct the unit of the action, or the actuator's range in the model"
            found.append(Finding(CHECK, severity, words, Rows.of(outside), remedy))
    return found
