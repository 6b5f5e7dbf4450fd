"""Library of the terms that a force may consist of, evaluated on the measured transitions.

Frequencies, phases and start times of terms are scanned over a range and then refined.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.optimize import minimize_scalar

from torchrl_h2o.effects.force.residual_force import DegreeOfFreedom, coordinate
from torchrl_h2o.effects.force.term import Factor, ForceTerm
from torchrl_h2o.residuals.forces.inverse_force import StepPath

NEGLIGIBLE = 1e-9  # relative spread or norm at which a coordinate or column counts as constant
# largest number of periods over the range of a position; faster waves cannot be distinguished from noise
MAX_WAVES = 15.0
# largest number of periods per turn of a hinge, such as the torque ripple of a motor with many poles
MAX_HARMONIC = 30.0
SCAN_SPACING = 0.8  # spacing of scanned frequencies, in rad over the range
MAX_SCANNED = 1500  # largest number of scanned frequencies
# number of positions on which frequencies are scanned; the best one is then refined on all positions
SCANNED_VALUES = 5000
MIN_PERIODS = 1.5  # smallest number of periods of a wave in time; fewer cannot be distinguished from a trend
MIN_STEP_SHARE = 0.03  # smallest share of the rows on either side of a step in time

Factors = tuple[Factor, ...]


@dataclass(frozen=True, eq=False)
class TermLibrary:
    """Terms of a force on one degree of freedom.

    Args:
        freedom: the degree of freedom.
        path: states and controls within the transitions.
        observed: (nq + nv), True for observed coordinates of the state.
        bent: indices of the controls whose powers are left out, because an effect of the simulator imitates them.
    """

    freedom: DegreeOfFreedom
    path: StepPath
    observed: np.ndarray
    bent: Collection[int] = ()

    @property
    def _coordinates(self) -> tuple[bool, bool]:
        """Whether position and velocity are scalar, observed and not constant."""
        still = NEGLIGIBLE
        position, nq = self.freedom.position, self.path.qpos.shape[-1]
        has_q = position is not None and bool(self.observed[position]) and np.ptp(self._values("q")) > still
        return has_q, bool(self.observed[nq + self.freedom.velocity]) and np.ptp(self._values("v")) > still

    def _values(self, name: str) -> np.ndarray:
        path = self.path
        return coordinate(name, self.freedom, path.qpos, path.qvel, path.ctrl, path.time)

    def column(self, factors: Factors) -> np.ndarray:
        """Mean over each control step, (W), of a term with coefficient 1; the residual force is also such a mean."""
        shape = ForceTerm(self.freedom.name, 1.0, factors).shape(self._values)
        return np.broadcast_to(shape, self.path.time.shape).mean(1)

    def fixed(self) -> Iterator[Factors]:
        """Terms without parameters to scan: polynomials, signs and products."""
        has_q, has_v = self._coordinates
        q, v, sign = Factor("power", "q"), Factor("power", "v"), Factor("sign", "v")
        yield ()
        yield (Factor("power", "t"),)
        if has_q:
            yield from ((replace(q, exponent=n),) for n in (1, 2, 3))
        if has_v:
            yield from ((replace(v, exponent=n),) for n in (1, 2, 3))
            yield (Factor("size", "v"), v)
            yield (sign,)
        if has_q and has_v:
            yield from ((moving, replace(q, exponent=n)) for moving in (sign, v) for n in (1, 2))
        for index in range(self.path.ctrl.shape[-1]):
            a = Factor("power", f"a{index}")
            yield from ((replace(a, exponent=n),) for n in (1, 2, 3) if index not in self.bent)
            yield from ((a, other) for other, there in ((q, has_q), (v, has_v)) if there)

    def scanned(self, force: np.ndarray, weight: np.ndarray) -> Iterator[Factors]:
        """Waves and steps that explain most of a force, after regressions on different simple terms.

        Args:
            force: (W), in N or N·m.
            weight: (W), inverse variance of the force.
        """
        has_q, has_v = self._coordinates
        simple = [(Factor("power", name),) for name, there in (("q", has_q), ("v", has_v)) if there]
        signs = [(Factor("sign", "v"),)] if has_v else []
        for beside in ([()], [(), *simple, *signs]):
            rest = without(force, weight, np.stack([self.column(factors) for factors in beside], axis=1))
            if has_q:
                carriers = [(), (Factor("sign", "v"),), (Factor("power", "v"),)] if has_v else [()]
                yield from (self._wave(rest, weight, carrier) for carrier in carriers)
            yield from self._wave_in_time(rest, weight)
            yield from self._step(rest, weight)

    def _wave(self, force: np.ndarray, weight: np.ndarray, carrier: Factors) -> Factors:
        """The best ``carrier · sin(k q + phase)``, from a scan of k and a refinement."""
        q = self._values("q")
        scale = np.broadcast_to(ForceTerm(self.freedom.name, 1.0, carrier).shape(self._values), q.shape)
        span = np.ptp(q)
        most = 2.0 * np.pi * MAX_WAVES / span
        least, most = np.pi / span, most if self.freedom.sliding else max(most, MAX_HARMONIC)
        spacing = max(SCAN_SPACING / span, (most - least) / MAX_SCANNED)
        k, phase = _best_wave(force, weight, q, scale, np.arange(least, most, spacing), SCANNED_VALUES)
        return (*carrier, Factor("sin", "q", numbers=(k, phase)))

    def _wave_in_time(self, force: np.ndarray, weight: np.ndarray) -> Iterator[Factors]:
        """The best ``sin(omega t + phase)``, from the peak of a periodogram and a refinement."""
        time = self.path.time.mean(1)
        span = np.ptp(time)
        step = np.median(cast("np.ndarray", np.diff(np.unique(time))))
        place = np.round((time - time.min()) / step).astype(int)
        if place.max() > 50 * len(place):  # runs recorded on different days: the periodogram would be too long
            return
        power = np.abs(np.fft.rfft(np.bincount(place, weight * force), 4 * (place.max() + 1))) ** 2
        omega = 2.0 * np.pi * np.arange(len(power)) / (4 * (place.max() + 1) * step)
        legal = (omega >= 2.0 * np.pi * MIN_PERIODS / span) & (omega < 0.9 * np.pi / step)
        if not legal.any():
            return
        peak = omega[legal][power[legal].argmax()]
        grid = peak + np.array([-1.0, 0.0, 1.0]) * SCAN_SPACING / span
        moments, values = self.path.time - time.min(), SCANNED_VALUES
        found = _best_wave(force, weight, moments, np.ones_like(moments), grid, values)
        frequency, phase = found[0], found[1] - found[0] * time.min()
        yield (Factor("sin", "t", numbers=(frequency, _wrapped(phase))),)

    def _step(self, force: np.ndarray, weight: np.ndarray) -> Iterator[Factors]:
        """The best ``step(t - start)``: the split in time that explains most."""
        time = self.path.time[:, 0]
        order = np.argsort(time, kind="stable")
        mass, moment = np.cumsum(weight[order]), np.cumsum((weight * force)[order])
        few = max(1, int(MIN_STEP_SHARE * len(order)))
        before, total = mass[few:-few], mass[-1]
        if len(before) == 0 or before[0] <= 0.0 or before[-1] >= total:
            return
        gain = (moment[few:-few] - moment[-1] * before / total) ** 2 / (before * (1.0 - before / total))
        yield (Factor("step", "t", numbers=(float(time[order][few + 1 + gain.argmax()]),)),)


def without(values: np.ndarray, weight: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Residual of a weighted regression of values (W) on columns (W, m)."""
    root = np.sqrt(weight)
    solution = np.linalg.lstsq(root[:, None] * columns, root * values, rcond=None)[0]
    return values - columns @ solution


def _best_wave(
    force: np.ndarray, weight: np.ndarray, x: np.ndarray, scale: np.ndarray, grid: np.ndarray, scanned: int
) -> tuple[float, float]:
    """Frequency and phase of the wave in x (W, S), times a scale (W, S), that explains most of a force (W).

    Args:
        force: (W), in N or N·m.
        weight: (W), inverse variance of the force.
        x: (W, S), position or time within each transition.
        scale: (W, S), factor of the wave.
        grid: frequencies to scan, in rad per unit of x.
        scanned: values of x in the scan; the refinement uses all.
    """

    def fitted(k: float, every: int = 1) -> tuple[float, float]:
        """Explained sum of squares and phase of a wave of frequency k, on every ``every``-th row."""
        angle, size = k * x[::every], scale[::every]
        design = np.stack([(size * np.sin(angle)).mean(1), (size * np.cos(angle)).mean(1)], axis=1)
        weighted = weight[::every, None] * design
        projection = weighted.T @ force[::every]
        amplitudes = np.linalg.lstsq(weighted.T @ design, projection, rcond=1e-10)[0]
        return float(projection @ amplitudes), float(np.arctan2(amplitudes[1], amplitudes[0]))

    few = 1 + x.size // scanned
    gains = [fitted(k, few)[0] for k in grid]
    best = grid[int(np.argmax(gains))]
    width = grid[1] - grid[0]
    refined = minimize_scalar(lambda k: -fitted(k)[0], bounds=(best - width, best + width), method="bounded")
    k = float(refined.x)
    return k, fitted(k)[1]


def _wrapped(phase: float) -> float:
    return float((phase + np.pi) % (2.0 * np.pi) - np.pi)
