"""Zeros of the angles of joints that no actuator moves, such as the pole of a cart-pole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.regression import robust_fit
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings
from torchrl_h2o.data.audit.unexplained import percent

CHECK = "model"
_STEP = np.pi / 6.0  # rad between the shifts from which the best one is sought
_STARTS = _STEP * np.arange(-5, 7)
_ROUNDS = 3  # of Newton's method
_PARTS = 3  # of the log, in all of which a shift must explain the force: a sensor that slips is not meant here


def check_undriven_zeros(response: Response, settings: AuditSettings) -> list[Finding]:
    """Shifted zeros of angles whose joint no actuator moves.

    Whatever the simulator lacks at the other joints, the measured motion of all of them needs no force at this one but
    friction. So friction of a cart does not hide that the angle of its pole is counted from elsewhere.

    Args:
        response: simulated windows.
        settings: thresholds.
    """
    if response.simulation.state_map.hidden or len(response.moving) < 2:
        return []
    from torchrl_h2o.effects.selection import driven_dofs

    driven = driven_dofs(response.simulation.model)
    try:
        found = [
            _finding(response, index, settings)
            for index, pair in enumerate(response.log.pairs)
            if pair.angle and pair.dof not in driven
        ]
    except np.linalg.LinAlgError:  # a joint that no force moves
        return []
    return [finding for finding in found if finding is not None]


def _finding(response: Response, index: int, settings: AuditSettings) -> Finding | None:
    pair, friction = response.log.pairs[index], _friction(response, index)

    def left_at(shift: float) -> np.ndarray:
        return _left(_shifted(response, pair, shift), index, friction, settings)

    total, error = min(_STARTS, key=lambda shift: np.nanmedian(left_at(shift))), np.inf
    for _ in range(_ROUNDS):
        shift, error = _shift(_shifted(response, pair, total), index, settings)
        total += shift
        if not np.isfinite(error) or abs(shift) > _STEP:
            return None
    total = float(np.angle(np.exp(1j * total)))
    if abs(total) < max(settings.zero_warning, settings.significance * error):
        return None
    plain, left = left_at(0.0), left_at(total)
    for part in np.array_split(np.arange(len(plain)), _PARTS):
        if not np.nanmedian(left[part]) < settings.force_left * np.nanmedian(plain[part]):
            return None
    constant = np.nanmedian(_left(response, index, np.column_stack([friction, np.ones(len(friction))]), settings))
    remains = float(np.nanmedian(left))
    if remains > constant:
        return None
    share = percent(remains / float(np.nanmedian(plain)))
    words = f"no actuator moves {pair.name}, and beside friction, {share} of the force that the simulator lacks there "
    words += (
        f"remains if the zero of {pair.name} is shifted by {-total:.2f} rad: an offset, a tilted model, or a centre "
    )
    words += "of mass beside the joint's axis"
    words += "; or a constant force there" if remains > settings.zero_better * constant else ""
    severity = "severe" if abs(total) >= settings.zero_severe else "warning"
    remedy = f"measure the angle's zero, for example at rest; offset: {total:.3g} in its column corrects it"
    return Finding(CHECK, severity, words, None, remedy)


def _shifted(response: Response, pair: Pair, shift: float) -> Response:
    states = response.states.copy()
    states[:, pair.coordinate] += shift
    return replace(response, states=states)


def _missing(response: Response) -> np.ndarray:
    """Constant forces at all pairs with which each window of the simulation ends as measured, (W, pairs)."""
    error = response.change - response.simulated_with(response.limited[response.rows])
    return np.linalg.solve(response.by_force, error[..., None])[..., 0]


def _friction(response: Response, index: int) -> np.ndarray:
    """What friction adds to the missing force of a joint, (W, 2): its velocity and the sign of it."""
    velocity = response.before[:, index] + 0.5 * response.change[:, index]
    return np.stack([velocity, np.sign(velocity)], -1)


def _shift(response: Response, index: int, settings: AuditSettings) -> tuple[float, float]:
    """The shift of an angle that lowers the missing force of its joint most, and its standard error, in rad."""
    pair, size = response.log.pairs[index], settings.zero_nudge
    missing = _missing(response)[:, index]
    change = (_missing(_shifted(response, pair, size))[:, index] - missing) / size
    explained = np.column_stack([-change, _friction(response, index)])
    found = robust_fit(missing[:, None], explained[:, None], _usual(missing), settings.robust)
    return float(found.values[0]), float(found.errors[0])


def _left(response: Response, index: int, explained: np.ndarray, settings: AuditSettings) -> np.ndarray:
    """Size of the force that is missing at a joint beside a fit of what is explained, (W, P), in each window, (W,)."""
    missing = _missing(response)[:, index]
    found = robust_fit(missing[:, None], explained[:, None], _usual(missing), settings.robust)
    return np.abs(missing - explained @ found.values)


def _usual(force: np.ndarray) -> np.ndarray:
    return np.array([max(float(np.nanmedian(np.abs(force))), 1e-12)])
