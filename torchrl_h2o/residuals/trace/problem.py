"""Residuals of windows, scaled by their expected size, as a function of the effects put into a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from torchrl_h2o.effects import Effect, ObservationEffect
from torchrl_h2o.residuals.measured.initial_states import estimate_states
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals, start_states
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise
from torchrl_h2o.residuals.measured.settling import settle
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

WORST = 1e3  # bound on a scaled residual, also used where the simulation diverges
ROUNDING = 2e-7  # relative rounding error of the data, which are single precision
MOST_CUT_OFF = 0.05  # share of the residuals that may be cut off at ``worst``; if there are more, they set the scale
# residual where coordinates are unobserved, in spreads of the change in a step, up to which it counts as zero. MuJoCo
# solves contacts up to a tolerance, and begins with the solution of the step before, which is not known
ROUNDING_UNOBSERVED = 2e-4
SETTLED_SHARE = 0.9  # share of the residuals that must be this small
NOISE_DRAWS = 4  # number of draws of sensor noise for the estimate of its effect on each window
MIN_GAIN = 0.002  # share of the held-out loss that an addition must explain
# the same share with noisy sensors, because noise in the start states may imitate an effect
MIN_GAIN_UNDER_NOISE = 0.02


@dataclass(frozen=True, eq=False)
class Problem:
    """A simulation, data, and the scales of its residuals: the objective of a fit.

    Args:
        simulation: the simulator without the effects to be fitted.
        measured: the data.
        horizon: control steps per window.
        scale: (T, H, n) or (1, 1, n), expected size of each window's residual, in units of the observations.
        states: (T, nq + nv), start states of the windows.
        observer: simulation whose observation effects were undone to obtain ``states``.
        sensor_std: (n), standard deviation of the readings' noise, in their units; None where it is negligible.
    """

    simulation: Simulation
    measured: Measured
    horizon: int
    scale: np.ndarray
    states: np.ndarray
    observer: Simulation
    sensor_std: np.ndarray | None = None

    @classmethod
    def pose(
        cls,
        simulation: Simulation,
        measured: Measured,
        horizon: int = 1,
        *,
        sensor_std: np.ndarray | None = None,
    ) -> Problem:
        """Builds the problem of a simulation: chooses start states and scales the residuals by their present size.

        With noisy sensors, windows start from the measured or from the filtered states, whichever predict the fitted
        part of the data better: a filter helps where motion is smooth and harms near contacts. The effect of sensor
        noise on the residual is estimated per window, because near a contact a small error of a position causes
        a large force.

        Args:
            simulation: the simulator.
            measured: the data.
            horizon: control steps per window.
            sensor_std: (n), standard deviation of the readings' noise; estimated from the data by default, zeros for
                sensors without noise.
        """
        if sensor_std is None:
            sensor_std = sensor_noise(simulation, measured)
        elif not sensor_std.any():
            sensor_std = None
        fitted = measured.fitted(horizon)
        states = start_states(simulation, measured, np.concatenate([fitted, measured.selected_on(horizon)]))
        one = np.ones((1, 1, measured.observation.shape[1]))
        problem = cls(simulation, measured, horizon, one, states, simulation, sensor_std)
        found = problem._missed((), fitted)
        rounding = problem._rounding(fitted, found)
        size = _typical_size(np.abs(found), rounding)
        if sensor_std is None:
            return replace(problem, scale=one * size)
        estimated = replace(problem, states=estimate_states(simulation, measured))
        if (
            losses(estimated._bounded(estimated._missed((), fitted) / size)).mean()
            < losses(problem._bounded(found / size)).mean()
        ):
            problem, found = estimated, estimated._missed((), fitted)
        by_noise = problem._made_by_noise()
        trust = 1.0 / (1.0 + by_noise[fitted] / (np.median(by_noise[fitted], axis=0) + 1e-300))
        size = np.nansum(trust * np.abs(found), axis=(0, 1)) / trust.sum((0, 1))
        return replace(problem, scale=np.maximum(np.sqrt(size**2 + by_noise), rounding))

    def residual(self, effects: Sequence[Effect], starts: np.ndarray) -> np.ndarray:
        """Scaled residuals, (W, H, n), with effects put into the simulation; bounded where it diverges.

        Raises:
            ValueError: if the model lacks the element that one of the effects acts on.
        """
        return self._bounded(self._missed(effects, starts) / self.scale_of(starts))

    def scale_of(self, starts: np.ndarray) -> np.ndarray:
        """Expected size of the windows' residuals, (W, H, n) or (1, 1, n), in units of the observations."""
        return self.scale[starts] if len(self.scale) > 1 else self.scale

    def selection_residuals(self, effects: Sequence[Effect]) -> np.ndarray:
        """Scaled residuals of the windows by which effects are chosen, (W, H, n), with effects put in."""
        judged = self.measured.selected_on(self.horizon)
        return self.residual(effects, judged)

    def selection_losses(self, effects: Sequence[Effect]) -> np.ndarray:
        """Robust loss of each window by which effects are chosen, (W), with effects put in."""
        return losses(self.selection_residuals(effects))

    def selection_loss(self, effects: Sequence[Effect]) -> float:
        """Mean of :meth:`selection_losses`."""
        return float(self.selection_losses(effects).mean())

    @property
    def within_rounding(self) -> bool:
        """Whether the residual is within the rounding of single-precision data, or of the unobserved coordinates.

        The mean absolute residual is compared with the rounding or, if coordinates are unobserved, a high quantile that
        leaves out the largest residuals. A wheel's speed, for example, is not known just after the wheel has landed, so
        even the true effects leave large residuals in about 1 % of the rows.
        """
        measured, fitted = self.measured, self.measured.fitted(self.horizon)
        left = self._missed((), fitted)
        size, rounding = np.abs(left), 3.0 * self._rounding(fitted, left)
        if not self.simulation.state_map.hidden:
            return bool((np.nanmean(size, axis=(0, 1)) < rounding).all())
        change = (measured.following - measured.observation)[fitted].std(0)
        rounding = np.maximum(rounding, ROUNDING_UNOBSERVED * change)
        return bool((np.nanquantile(size, SETTLED_SHARE, axis=(0, 1)) < rounding).all())

    def _missed(self, effects: Sequence[Effect], starts: np.ndarray) -> np.ndarray:
        """Residuals in units of the observations, (W, H, n); NaN where the simulation diverges."""
        simulation, states, measured = self.simulation.with_effects(*effects), self.states, self.measured
        if _sensors(simulation) != _sensors(self.observer):
            # with other observation effects, the same readings correspond to other states
            run_by_run = [measured.observation[run] for run in measured.runs]
            before, after = (
                np.concatenate([which.true_observations(run) for run in run_by_run])
                for which in (self.observer, simulation)
            )
            states = states + (after - before) @ simulation.state_map.restore_observed.T
        states = settle(simulation, measured, states, executed_actions(simulation, measured), starts)
        return residuals(simulation, measured, starts, self.horizon, states=states)

    def _bounded(self, residual: np.ndarray) -> np.ndarray:
        worst = WORST
        return np.nan_to_num(np.clip(residual, -worst, worst), nan=worst)

    def _moved(self, observation: np.ndarray, starts: np.ndarray, unmoved: np.ndarray) -> np.ndarray:
        """Change, (W, H, n), of the residuals when ``observation``, (T, n), is added to the start states."""
        moved = replace(self, states=self.states + observation @ self.simulation.state_map.restore_observed.T)
        return moved._missed((), starts) - unmoved

    def _made_by_noise(self) -> np.ndarray:
        """Mean square of the residual that sensor noise causes in each window, (T, H, n)."""
        measured, rng = self.measured, np.random.default_rng(0)
        sensor_std = cast("np.ndarray", self.sensor_std)  # called only with noisy sensors
        starts = np.concatenate([measured.fitted(self.horizon), measured.selected_on(self.horizon)])
        unmoved = self._missed((), starts)
        squares = np.zeros((len(measured), self.horizon, len(sensor_std)))
        for _ in range(NOISE_DRAWS):
            noise = sensor_std * rng.standard_normal(measured.observation.shape)
            moved = np.nan_to_num(self._moved(noise, starts, unmoved) ** 2, nan=WORST**2)
            squares[starts] += moved / NOISE_DRAWS
        return squares + sensor_std**2

    def _rounding(self, starts: np.ndarray, unmoved: np.ndarray) -> np.ndarray:
        """Mean change, (n), of the residuals ``unmoved`` by single-precision rounding of the start states."""
        observation, rng = self.measured.observation, np.random.default_rng(0)
        rounding = ROUNDING
        rounded_by = rounding * rng.uniform(-1.0, 1.0, observation.shape) * observation
        made = np.nanmean(np.abs(self._moved(rounded_by, starts, unmoved)), axis=(0, 1))
        return made + rounding * np.abs(observation).max(0) + 1e-12


def _typical_size(found: np.ndarray, rounding: np.ndarray) -> np.ndarray:
    """Median of absolute residuals (W, H, n) in each dimension, (n), at least the rounding error.

    If fewer than half of the rows show the cause, such as a force that begins late, the median is rounding. If too many
    residuals therefore exceed the bound ``WORST`` in this scale, the median of these larger ones is used.
    """
    typical = np.maximum(np.nanmedian(found, axis=(0, 1)), rounding)
    cut_off = found > WORST * typical
    for dimension in np.flatnonzero(cut_off.mean((0, 1)) > MOST_CUT_OFF):
        typical[dimension] = np.median(found[..., dimension][cut_off[..., dimension]])
    return typical


def _sensors(simulation: Simulation) -> list[Effect]:
    return [e for e in simulation.effects if isinstance(e, ObservationEffect) and not e.is_neutral]


def matters(nothing: float, without: float, with_them: float, share: float) -> bool:
    """Whether additional effects reduce the loss by more than a share of the whole reduction.

    Args:
        nothing: loss without any effects.
        without: loss without the additional effects.
        with_them: loss with all effects.
        share: required share of ``nothing - with_them``.
    """
    return without - with_them > share * (nothing - with_them)


def losses(residual: np.ndarray) -> np.ndarray:
    """Robust loss (soft L1) of each window, (W), from scaled residuals, (W, H, n)."""
    return 2.0 * (np.sqrt(1.0 + residual**2) - 1.0).mean((1, 2))
