"""Zeros of the angles of joints that no actuator moves, such as the pole of a cart-pole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.regression import SIGNIFICANCE, percent, robust_fit
from torchrl_h2o.data.audit.response import ZERO_NUDGE, Response
from torchrl_h2o.data.audit.zeros import ZERO_BETTER, ZERO_WARNING

CHECK = "model"
FORCE_LEFT = 0.6  # share of the force missing beside friction that a corrected zero must leave at most
_STEP = np.pi / 6.0  # rad between the shifts from which the best one is sought
_STARTS = _STEP * np.arange(-5, 7)
_ROUNDS = 3  # of Newton's method
_PARTS = 3  # of the log, in all of which a shift must explain the force: a sensor that slips is not meant here


def check_undriven_zeros(response: Response) -> list[Finding]:
    """Shifted zeros of angles whose joint no actuator moves.

    Whatever the simulator lacks at the other joints, the measured motion of all of them shows which force is missing at
    this one. So friction of a cart does not hide that the angle of its pole is counted from elsewhere. Dry and viscous
    friction are fitted beside the shifts, of all such joints together. A constant force and a spring must not explain
    the force as well as a shift does.

    Args:
        response: simulated windows.

    Returns:
        A warning for each such angle; severe beyond a quarter of a turn, which no load explains.
    """
    from torchrl_h2o.effects.selection import driven_dofs

    pairs, model = response.log.pairs, response.simulation.model
    if response.simulation.state_map.hidden or len(pairs) != model.nv:
        return []
    driven = driven_dofs(model)
    free = [index for index, pair in enumerate(pairs) if pair.angle and pair.dof not in driven]
    return _Undriven(response, free).findings() if free else []


class _Undriven:
    """The forces that are missing at joints without actuators.

    Args:
        response: simulated windows.
        free: indices of the pairs of these joints, K of them.
    """

    def __init__(self, response: Response, free: list[int]):
        self.response, self.free = response, free
        velocity = (response.before + 0.5 * response.change)[:, free]
        self.friction = np.stack([velocity, np.sign(velocity)], -1)  # (W, K, 2)
        positions = [response.log.pairs[index].coordinate for index in free]
        self.position = response.states[:, positions]  # (W, K)
        self.usual = _usual(self._missing(np.zeros(len(free))))

    def findings(self) -> list[Finding]:
        shifts, errors = self._shifts()
        if shifts is None:
            return []
        nothing = np.zeros(len(self.free))
        plain, left = self._left(nothing), self._left(shifts)
        line = np.stack([np.ones_like(self.position), self.position], -1)
        rival = np.nanmedian(self._left(nothing, np.concatenate([self.friction, line], -1)), axis=0)
        found = []
        for place, index in enumerate(self.free):
            shift, remains = float(shifts[place]), float(np.nanmedian(left[:, place]))
            if abs(shift) < max(ZERO_WARNING, SIGNIFICANCE * errors[place]) or remains > rival[place]:
                continue
            if self._lowers(plain[:, place], left[:, place]):
                share = percent(remains / float(np.nanmedian(plain[:, place])))
                either = remains > ZERO_BETTER * rival[place]
                found.append(self._finding(self.response.log.pairs[index].name, shift, share, either))
        return found

    def _finding(self, name: str, shift: float, share: str, either: bool) -> Finding:
        words = f"no actuator moves {name}, and beside friction, {share} of the force that the simulator lacks there "
        words += (
            f"remains if the zero of {name} is shifted by {-shift:.2f} rad: an offset, a tilted model, or a centre "
        )
        words += f"of mass beside the joint's axis{'; or a constant force or a spring there' if either else ''}"
        severity = "severe" if abs(shift) > 0.5 * np.pi else "warning"
        remedy = f"measure the angle's zero, for example at rest; if it is wrong, add offset: {shift:.3g} to its column"
        return Finding(CHECK, severity, words, None, remedy)

    def _lowers(self, plain: np.ndarray, left: np.ndarray) -> bool:
        """Whether a shift lowers the missing force (W,) of its joint in all parts of the log."""
        parts = np.array_split(np.arange(len(plain)), _PARTS)
        return all(np.nanmedian(left[p]) < FORCE_LEFT * np.nanmedian(plain[p]) for p in parts)

    def _shifts(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Shifts, (K,), that lower the missing forces most, and their standard errors; None if there are none."""
        nothing = together = np.zeros(len(self.free))
        starts = [nothing]
        for each in np.eye(len(self.free)):
            starts.append(min((start * each for start in _STARTS), key=self._size))
            together = min((together + start * each for start in _STARTS), key=self._size)
        found = [self._from(start) for start in (*starts, together)]
        converged = [(shifts, errors) for shifts, errors in found if shifts is not None]
        return min(converged, key=lambda one: self._size(one[0]), default=(None, nothing))

    def _from(self, shifts: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """The shifts that Newton's method reaches, and their standard errors; None if it does not settle nearby."""
        errors = np.zeros(len(self.free))
        for _ in range(_ROUNDS):
            change, errors = self._newton(shifts)
            shifts = shifts + change
            if not np.isfinite(errors).all() or (np.abs(change) > _STEP).any():
                return None, errors
        return np.angle(np.exp(1j * shifts)), errors

    def _size(self, shifts: np.ndarray) -> float:
        """What is missing with shifts, in the usual sizes of what is missing without."""
        return float((np.nanmedian(self._left(shifts), axis=0) / self.usual).sum())

    def _newton(self, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change of the shifts by one fit of the missing forces, beside friction, and its standard errors, (K,)."""
        count, step = len(self.free), ZERO_NUDGE
        missing = self._missing(shifts)
        moved = np.stack([self._missing(shifts + step * each) for each in np.eye(count)], -1)
        explained = np.concatenate([-(moved - missing[..., None]) / step, self._own(self.friction)], -1)
        found = robust_fit(missing, explained, _usual(missing))
        return found.values[:count], found.errors[:count]

    def _left(self, shifts: np.ndarray, explained: np.ndarray | None = None) -> np.ndarray:
        """Sizes of the missing forces, (W, K), beside what explains each of them, (W, K, P), by default friction."""
        missing, own = self._missing(shifts), self._own(self.friction if explained is None else explained)
        found = robust_fit(missing, own, _usual(missing))
        return np.abs(missing - own @ found.values)

    @staticmethod
    def _own(explained: np.ndarray) -> np.ndarray:
        """Columns that explain each force alone, (W, K, P), as columns of a fit of all, (W, K, K P)."""
        count = explained.shape[1]
        own = explained[:, :, None, :] * np.eye(count)[:, :, None]
        return own.reshape(len(explained), count, -1)

    def _missing(self, shifts: np.ndarray) -> np.ndarray:
        """Constant forces with which each window ends as measured, at the joints without actuators, (W, K)."""
        states = self.response.states.copy()
        states[:, [self.response.log.pairs[index].coordinate for index in self.free]] += shifts
        shifted = replace(self.response, states=states)
        error = shifted.change - shifted.simulated_with(shifted.limited[shifted.rows])
        by_force, missing = shifted.by_force, np.full(error.shape, np.nan)
        known = np.isfinite(error).all(1) & np.isfinite(by_force).all((1, 2))
        missing[known] = (np.linalg.pinv(by_force[known]) @ error[known, :, None])[..., 0]
        return missing[:, self.free]


def _usual(force: np.ndarray) -> np.ndarray:
    return np.maximum(np.nanmedian(np.abs(force), axis=0), 1e-12)
