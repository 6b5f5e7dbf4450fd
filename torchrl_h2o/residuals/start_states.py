"""The state in which each window starts, and how uncertain it is: a Kalman filter along the log.

Sensor noise and the simulator's error one step ahead are estimated from the data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.stats import norm

from torchrl_h2o.likelihood import log_density
from torchrl_h2o.residuals.blocks import LENGTHS, Blocks, Windows
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.record import Record
from torchrl_h2o.residuals.simulation.simulation import Simulation

BEFORE = 16  # largest number of rows before each block on which the filter settles
NUDGE = 1e-3  # step of the finite differences, in spreads
ROUNDING = 1e-6  # rounding of a reading, in spreads: that of single precision, with a margin
OF_NORMAL = 1.175  # standard deviation of the likeliest such distribution for normal noise, in that of the noise
CLIP = 4.0  # robust standard deviations at which one-step errors are clipped
SURPRISE = 4.0  # mean squared whitened innovation beyond which the filter trusts the reading
LINEARISED = 2  # times that the steps of the simulation are linearised, about better states each time
NOISE_BLOCKS = 8  # blocks from which the noise is estimated
USUAL_FACTORS = np.array([0.0, -0.7])
MOST_NOISE = 3.0  # most noise of a sensor, in what third differences show; noise that lasts for some rows shows less
SPACINGS = (2.0, 1.0, 0.5, 0.2, 0.07)  # of the logarithms that are tried, one grid after another
LASTS = 0.95  # correlation of lasting errors of the actions in successive rows
MOST_DOUBT = 100.0  # largest variance of a coordinate, in squared spreads


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of the noise, in spreads.

    Args:
        sensor: (n), of each reading.
        step: (m), of the simulator's error in one control step, for each coordinate.
        action: of the executed actions about the commanded ones, in their unit.
    """

    sensor: np.ndarray
    step: np.ndarray
    action: float = 0.0

    def scaled(self, sensor: float, step: float, action: float = 0.0) -> Noise:
        """Each multiplied by a factor, and at least rounding."""
        least = np.maximum(sensor * self.sensor, ROUNDING), np.maximum(step * self.step, 0.1 * ROUNDING)
        return Noise(*least, action * self.action)


@dataclass(frozen=True, eq=False)
class StartStates:
    """Filtered states of the rows of blocks, in spreads about the measured ones.

    Args:
        record: the log and the simulation.
        blocks: the blocks.
        noise: the noise.
        mean: (B, rows, m).
        covariance: (B, rows, m, m).
        about: (B, rows before the block and in it, m), states about which the steps of the simulation are linearised.
        slope: (B, rows before the block and in it, m, m), derivative of the coordinates one control step later.
        factors: logarithms of the two factors of the fit of the noise.
    """

    record: Record
    blocks: Blocks
    noise: Noise
    mean: np.ndarray
    covariance: np.ndarray
    about: np.ndarray
    slope: np.ndarray
    factors: np.ndarray

    @classmethod
    def of(
        cls, record: Record, blocks: Blocks, noise: Noise | None = None, similar: StartStates | None = None
    ) -> StartStates:
        """Filters the log from some rows before each block to its end.

        The steps are linearised about the measured rows, and then about the filtered ones.

        Args:
            record: the log and the simulation.
            blocks: the blocks.
            noise: the noise; estimated from these blocks by default.
            similar: start states of a similar simulation in these blocks, with the same two factors of the noise, and
                with the same derivatives but for those by coordinates that a simulation reaches. Explanations are
                compared with the same factors, because a change of the noise changes the scores of all blocks alike, as
                a better explanation does.
        """

        def filtered(steps: Steps) -> tuple[Noise, np.ndarray, np.ndarray, np.ndarray]:
            factors = USUAL_FACTORS if noise else steps.fitted_factors() if similar is None else similar.factors
            own = noise or steps.noise(factors)
            (mean,), (covariance,), _ = steps.filtered([own])
            return own, factors, mean, covariance

        steps = Steps.of(record, blocks, *(() if similar is None else (similar.about, similar.slope)))
        own, factors, mean, covariance = filtered(steps)
        for _ in range(LINEARISED - 1 if similar is None else 0):
            steps = Steps.of(record, blocks, mean)
            own, factors, mean, covariance = filtered(steps)
        before = _rows_before(blocks)
        return cls(record, blocks, own, mean[:, before:], covariance[:, before:], steps.about, steps.slope, factors)

    def rough(self, most: int) -> StartStates:
        """Returns the start states of at most ``most`` blocks, evenly spread, without the shortest windows."""
        some = slice(None, None, -(-len(self.blocks) // most))
        blocks = Blocks(self.blocks.first[some], self.blocks.steps, LENGTHS[-1:])
        mean, covariance, about, slope = (part[some] for part in (self.mean, self.covariance, self.about, self.slope))
        return StartStates(self.record, blocks, self.noise, mean, covariance, about, slope, self.factors)

    @property
    def of_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows of all blocks, (W), and the states of the log, (T, nq + nv), filtered in these rows."""
        record, rows = self.record, self.blocks.rows
        states = record.states[0].copy()
        states[rows] += (self.mean * record.spread) @ record.into_state.T
        return rows.ravel(), states

    def spread_ahead(self, windows: Windows) -> np.ndarray:
        """Variance that the uncertain start states give the readings, (W, h, n), in squared spreads."""
        n, doubt, found = self.record.num_readings, self.covariance[windows.block, windows.offset], []
        first = windows.offset + _rows_before(self.blocks)
        for step in range(windows.steps):
            slope = self.slope[windows.block, first + step]
            doubt = slope @ doubt @ slope.transpose(0, 2, 1)
            doubt = _bounded(doubt, 1.0)  # an unknown coordinate is still known within its spread
            if step + 1 in windows.horizons:
                found.append(np.einsum("wii->wi", doubt)[:, :n])
        return np.stack(found, axis=1)

    def at(self, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
        """States, (W, nq + nv), and covariances of the coordinates in spreads, (W, m, m), at the starts of windows."""
        record, place = self.record, (windows.block, windows.offset)
        moved = (self.mean[place] * record.spread) @ record.into_state.T
        return record.states[0][windows.rows] + moved, self.covariance[place]


@dataclass(frozen=True, eq=False)
class Steps:
    """One control step linearised in each row of the blocks: ``next = slope @ deviation + miss``, in spreads.

    Deviations are those from the measured coordinates.

    Args:
        record: the log and the simulation.
        blocks: the blocks.
        rows: (B, L), rows of the log.
        about: (B, L, m), deviations about which it is linearised.
        slope: (B, L, m, m).
        miss: (B, L, m), simulated minus measured coordinates after a step from the measured ones.
        live: (B, L), False before the beginning of a run.
        known: (B, L), False where the simulation diverges.
        jerk: (n), size of the third differences of the readings over that of white noise.
        lasting: number of coordinates that are errors of the actions, which last for some rows.
    """

    record: Record
    blocks: Blocks
    rows: np.ndarray
    about: np.ndarray
    slope: np.ndarray
    miss: np.ndarray
    live: np.ndarray
    known: np.ndarray
    jerk: np.ndarray
    lasting: int = 0

    @classmethod
    def of(
        cls, record: Record, blocks: Blocks, about: np.ndarray | None = None, slope: np.ndarray | None = None
    ) -> Steps:
        measured, m = record.measured, len(record.spread)
        begins = np.empty(len(measured), int)
        for run in measured.runs:
            begins[run] = run.start
        rows = blocks.first[:, None] + np.arange(-_rows_before(blocks), blocks.steps)
        live = rows >= begins[blocks.first][:, None]
        rows = np.maximum(rows, begins[blocks.first][:, None])
        about = np.zeros((*rows.shape, m)) if about is None else np.where(live[..., None], about, 0.0)
        base = _reached(record, record.simulation, rows, about)
        # derivatives by coordinates that a simulation reaches, such as the depth of contacts, are computed for each set
        columns = np.arange(m) if slope is None else np.flatnonzero(record.settled)
        slope = np.empty((*rows.shape, m, m)) if slope is None else slope.copy()
        if len(columns):
            quick = record.simulation.quick
            before = base if quick is record.simulation else _reached(record, quick, rows, about)
            for index in columns:
                slope[..., index] = (_reached(record, quick, rows, about + NUDGE * np.eye(m)[index]) - before) / NUDGE
        after = record.states[1][rows] @ record.from_state.T / record.spread
        miss = base - after - (slope @ about[..., None])[..., 0]
        known = np.asarray(np.isfinite(slope).all((2, 3)) & np.isfinite(miss).all(2))
        slope, miss = np.where(known[..., None, None], slope, np.eye(m)), np.where(known[..., None], miss, 0.0)
        third = np.abs(
            np.diff(record.readings[0][:, record.seen][rows], 3, axis=1) / record.spread[: record.num_readings]
        )
        jerk = np.nan_to_num(np.nanmedian(third[live[:, :-3]], axis=0)) / 0.6745 / math.sqrt(20.0)
        return cls(record, blocks, rows, about, slope, miss, live, known, jerk)

    @property
    def before(self) -> int:
        """Number of rows before each block, which belong to the block before it."""
        return self.rows.shape[1] - self.blocks.steps

    def noise(self, factors: np.ndarray) -> Noise:
        """The noise with given logarithms of its two or three factors on :meth:`_typical_noise`.

        The third is that of the noise of the actions, or of their errors that last. No sensor's noise is larger than
        the third differences of its readings allow, however wrong the simulator is.
        """
        noise = self._typical_noise.scaled(*np.exp(factors))
        most = np.where(self.jerk > 0.0, MOST_NOISE * self.jerk + ROUNDING, math.inf)  # a sensor may rest or be slow
        noise = replace(noise, sensor=np.minimum(noise.sensor, most))
        if not self.lasting:
            return noise
        lasting = np.full(self.lasting, math.exp(factors[2]) * math.sqrt(1.0 - LASTS**2))
        return Noise(noise.sensor, np.append(noise.step[: -self.lasting], lasting))

    def fitted_factors(self, usual: np.ndarray = USUAL_FACTORS) -> np.ndarray:
        """Logarithms of the factors of the noise under which the next readings are most likely.

        Args:
            usual: logarithms from which the search begins: of two factors, or of three with that of the action noise.
        """
        best = usual
        around = np.array(list(product((-1.0, 0.0, 1.0), repeat=len(usual))))
        some = slice(None, None, max(1, len(self.miss) // NOISE_BLOCKS))
        for spacing in SPACINGS:
            tried = best + spacing * around
            densities = self.filtered([self.noise(one) for one in tried], some)[2].sum((1, 2))
            best = tried[densities.argmax()]
        return tried[len(tried) // 2] + spacing * _highest(around, densities)

    @cached_property
    def by_action(self) -> np.ndarray:
        """Derivative of the coordinates one control step later by the executed actions, (B, L, m, nu)."""
        actions = self.record.executed[self.rows]
        before = _reached(self.record, self.record.simulation, self.rows, self.about)
        found = np.zeros((*before.shape, actions.shape[-1]))
        for index in range(actions.shape[-1]):
            # a step towards zero, because the control range may clamp a step outwards
            step = np.zeros_like(actions)
            size = NUDGE * (np.abs(actions[..., index]).max(initial=0.0) + ROUNDING)
            step[..., index] = np.where(actions[..., index] > 0.0, -size, size)
            after = _reached(self.record, self.record.simulation, self.rows, self.about, actions + step)
            found[..., index] = (after - before) / step[..., index, None]
        return np.nan_to_num(found)

    def by_noise(self, std: float, some: slice = slice(None)) -> np.ndarray:
        """Change of the coordinates by one standard deviation of action noise, (B, L, m, nu): the range clamps some."""
        model, actions = self.record.simulation.model, self.record.executed[self.rows[some]]
        limits = np.where(model.actuator_ctrllimited.astype(bool)[:, None], model.actuator_ctrlrange, [-np.inf, np.inf])
        actions = np.clip(actions, *limits.T)
        low, high = (np.clip((limit - actions) / std, -40.0, 40.0) for limit in limits.T)
        # second moment of a normal variable that is clamped to two limits
        inside = norm.cdf(high) - norm.cdf(low) - high * norm.pdf(high) + low * norm.pdf(low)
        left = np.maximum(inside + low**2 * norm.cdf(low) + high**2 * norm.sf(high), 0.0)
        return std * self.by_action[some] * np.sqrt(left)[..., None, :]

    def with_lasting(self, std: float) -> Steps:
        """The same steps, in which errors of the actions last for some rows: further coordinates, in units of std."""
        change, m = self.by_noise(std), self.miss.shape[-1]
        nu = change.shape[-1]
        slope = np.zeros((*self.miss.shape[:2], m + nu, m + nu))
        slope[..., :m, :m], slope[..., :m, m:] = self.slope, change
        slope[..., range(m, m + nu), range(m, m + nu)] = LASTS
        return replace(self, slope=slope, miss=np.pad(self.miss, ((0, 0), (0, 0), (0, nu))), lasting=nu)

    @cached_property
    def _typical_noise(self) -> Noise:
        """Noise of the sensors by the products of successive misses, and the size of the misses.

        Noise of a row enters the step that ends at this row and the step that starts there, with opposite signs. Where
        velocities are not measured, the third differences of the positions tell the noise.
        """
        n, actions = self.record.num_readings, self.record.measured.action
        action = float(np.sqrt((actions**2).mean())) if actions.size else 0.0
        miss = np.where((self.live & self.known)[..., None], self.miss, np.nan)
        size = np.nanmedian(np.abs(miss), axis=(0, 1)) / 0.6745 + 1e-9
        if self.record.positions_of_velocities:
            return Noise(self.jerk, size, action)
        clipped = np.clip(miss / size, -CLIP, CLIP)[..., :n]
        slope = self.slope[:, 1:, :n, :n] * size[:n] / size[:n, None]
        products = clipped[:, 1:, :, None] * clipped[:, :-1, None, :]
        weight = np.isfinite(products) / (1.0 + (slope**2).sum(2, keepdims=True))
        shared = -(weight * slope * np.nan_to_num(products)).sum((0, 1, 2))
        share = np.maximum(shared / np.maximum((weight * slope**2).sum((0, 1, 2)), 1e-12), 0.0)
        return Noise(np.sqrt(share) * size[:n], size, action)

    def filtered(self, noises: Sequence[Noise], some: slice = slice(None)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Filters blocks under each of K noises.

        Returns:
            Means, (K, B, L, m), covariances, (K, B, L, m, m), and log densities of the next readings, (K, B, L).
        """
        n, m = self.record.num_readings, self.miss.shape[-1]
        slope, miss, live, known = (values[some] for values in (self.slope, self.miss, self.live, self.known))
        sensor, step = (
            np.stack([np.diag(value**2) for value in values])[:, None]
            for values in ([noise.sensor for noise in noises], [noise.step for noise in noises])
        )
        begin = np.pad(sensor, ((0, 0), (0, 0), (0, m - n), (0, m - n))) + np.diag(np.arange(m) >= n)
        mean, covariance = np.zeros((len(noises), *live.shape, m)), np.zeros((len(noises), *live.shape, m, m))
        x, doubt = np.zeros((len(noises), len(live), m)), np.repeat(begin, len(live), axis=1)
        density, follows = np.zeros(mean.shape[:-1]), np.append(~self.record.settled, np.zeros(self.lasting, bool))
        most = np.full(m, MOST_DOUBT)
        most[n : m - self.lasting] = 1.0
        changes = [self.by_noise(noise.action, some) if noise.action else None for noise in noises]
        for row in range(live.shape[1]):
            mean[:, :, row], covariance[:, :, row] = x, doubt
            guess = (slope[:, row] @ x[..., None])[..., 0] + miss[:, row]
            doubt = slope[:, row] @ doubt @ slope[:, row].transpose(0, 2, 1) + step
            for one, change in enumerate(changes):
                if change is not None:
                    doubt[one] += change[:, row] @ change[:, row].swapaxes(-1, -2)
            factor = np.linalg.cholesky(doubt[..., :n, :n] + sensor)
            white = np.linalg.solve(factor, -guess[..., :n, None])[..., 0]
            square, valid = (white**2).mean(-1), live[:, row] & known[:, row]
            log_det = np.log(np.einsum("kbii->kbi", factor)).sum(-1)
            density[:, :, row] = np.where(valid, log_density(white).sum(-1) - log_det, 0.0)
            # where the simulator is wrong, such as at an impact, or unknown, the filter follows the readings
            trust = np.where(known[:, row], np.where(square > SURPRISE, square, 1.0), 1.0 / ROUNDING**2)
            inflated = np.where(follows, np.sqrt(trust)[..., None], 1.0)
            doubt = _bounded(doubt * inflated[..., :, None] * inflated[..., None, :], most)
            gain = np.linalg.solve(doubt[..., :n, :n] + sensor, doubt[..., :n, :]).swapaxes(-1, -2)
            x = guess - (gain @ guess[..., :n, None])[..., 0]
            left = np.eye(m) - np.pad(gain, ((0, 0), (0, 0), (0, 0), (0, m - n)))
            doubt = left @ doubt @ left.swapaxes(-1, -2) + gain @ sensor @ gain.swapaxes(-1, -2)
            x[:, ~live[:, row]], doubt[:, ~live[:, row]] = 0.0, begin
        return mean, covariance, density


def _reached(
    record: Record, simulation: Simulation, rows: np.ndarray, moved: np.ndarray, actions: np.ndarray | None = None
) -> np.ndarray:
    """Coordinates one control step after rows (B, L) with deviations (B, L, m), in spreads."""
    flat, executed = rows.ravel(), record.executed[rows] if actions is None else actions
    states = record.states[0][flat] + (moved.reshape(-1, len(record.spread)) * record.spread) @ record.into_state.T
    at = {"time": record.measured.time[flat], "activations": record.activations[flat]}
    reached = simulation.rollout(states, executed.reshape(len(flat), 1, executed.shape[-1]), **at)[:, 0]
    return (reached @ record.from_state.T / record.spread).reshape(moved.shape)


def _highest(around: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Where a quadratic function through values (K) at places ``around`` (K, d) is highest, (d), within this grid."""
    d = around.shape[1]
    i, j = np.triu_indices(d)
    terms = np.hstack([around, around[:, i] * around[:, j], np.ones((len(around), 1))])
    coefficients, *_ = np.linalg.lstsq(terms, values, rcond=None)
    curvature = np.zeros((d, d))
    curvature[i, j] = coefficients[d : d + len(i)]
    curvature = curvature + curvature.T
    if np.linalg.eigvalsh(curvature).max() >= 0.0:  # it has no highest point
        return around[values.argmax()]
    return np.clip(-np.linalg.solve(curvature, coefficients[:d]), -1.0, 1.0)


def _bounded(doubt: np.ndarray, most: np.ndarray | float) -> np.ndarray:
    """Covariances (..., m, m) with variances of at most ``most`` and the same correlations."""
    shrink = np.sqrt(np.minimum(1.0, most / np.maximum(np.einsum("...ii->...i", doubt), 1e-300)))
    return doubt * shrink[..., :, None] * shrink[..., None, :]


def filtered_rows(blocks: Blocks, measured: Measured) -> np.ndarray:
    """Rows of a log that are filtered for the start states in some blocks, and the row after each block."""
    rows = blocks.first[:, None] + np.arange(-_rows_before(blocks), blocks.steps + 1)
    return np.unique(rows.clip(0, len(measured) - 1))


def _rows_before(blocks: Blocks) -> int:
    return min(BEFORE, blocks.steps // 2)
