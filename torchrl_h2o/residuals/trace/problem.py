"""What is to be explained: residuals of windows, each weighed by the size that is to be expected of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects import Effect, ObservationEffect
from torchrl_h2o.residuals.measured.chance import sensor_noise
from torchrl_h2o.residuals.measured.initial_states import estimate_states
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.simulation.simulation import Simulation

WORST = 1e3  # of a residual, in scales: where a simulation diverges
_ROUNDING = 2e-7  # of what is measured: data are single precision
_DRAWS = 4  # of sensor noise, for what it makes of each window


@dataclass(frozen=True, eq=False)
class Problem:
    """What a fit sees: a simulation, data, and how its residuals are weighed.

    Args:
        simulation: without the effects to be fitted.
        measured: the data.
        horizon: control steps of the windows that residuals are taken over.
        scale: (T, H, n) or (1, 1, n), the size of residual to be expected of each window, in units.
        states: (T, nq + nv), where windows start from.
        observer: whose sensors the states were read by.
        sensor_std: (n), noise of the readings, in their units; None where it makes no difference.
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
        """The problem at a simulation: states to start from are found and residuals weighed by the size they have.

        Where sensors are noisy, windows start from measured or from estimated states, whichever predict the part of the
        data that fits see better: a filter gains most where motion is smooth, and loses where contacts bend it. What
        noise makes of a residual differs from window to window: near a contact, little noise in a position is a large
        force.

        Args:
            simulation: the simulator.
            measured: the data.
            horizon: control steps of the windows.
            sensor_std: (n), noise of the readings; estimated from the data by default.
        """
        if sensor_std is None:
            sensor_std = sensor_noise(simulation, measured)
        fitted = measured.fitted(horizon)
        states = start_states(simulation, measured, np.concatenate([fitted, measured.judged(horizon)]))
        one = np.ones((1, 1, measured.observation.shape[1]))
        problem = cls(simulation, measured, horizon, one, states, simulation, sensor_std)
        found, rounding = problem._missed((), fitted), problem._rounding(fitted)
        size = np.maximum(np.nanmean(np.abs(found), axis=(0, 1)), rounding)
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
        """Residuals in scales, (W, H, n), with effects put into the simulation; bounded where that diverges.

        Raises:
            ValueError: if the model has nothing that one of the effects could act on.
        """
        return self._bounded(self._missed(effects, starts) / self.scale_of(starts))

    def scale_of(self, starts: np.ndarray) -> np.ndarray:
        """The size of residual to be expected of windows, (W, H, n) or (1, 1, n), in units."""
        return self.scale[starts] if len(self.scale) > 1 else self.scale

    def held_out_loss(self, effects: Sequence[Effect]) -> float:
        """The mean robust loss on held-out windows with effects put in."""
        return float(losses(self.residual(effects, self.measured.judged(self.horizon))).mean())

    @property
    def within_rounding(self) -> bool:
        """Whether nothing is left to explain but that data are single precision."""
        fitted = self.measured.fitted(self.horizon)
        missed = np.nanmean(np.abs(self._missed((), fitted)), axis=(0, 1))
        return bool((missed < 3.0 * self._rounding(fitted)).all())

    def _missed(self, effects: Sequence[Effect], starts: np.ndarray) -> np.ndarray:
        """Residuals in units, (W, H, n), NaN where the simulation diverges."""
        simulation, states = self.simulation.with_effects(*effects), self.states
        if _sensors(simulation) != _sensors(self.observer):
            # other sensors, other states behind what they said
            run_by_run = [self.measured.observation[run] for run in self.measured.runs]
            before, after = (
                np.concatenate([which.true_observations(run) for run in run_by_run])
                for which in (self.observer, simulation)
            )
            states = states + (after - before) @ self.simulation.state_map.restore.T
        return residuals(simulation, self.measured, starts, self.horizon, states=states)

    @staticmethod
    def _bounded(residual: np.ndarray) -> np.ndarray:
        return np.nan_to_num(np.clip(residual, -WORST, WORST), nan=WORST)

    def _moved(self, observation: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """How the residuals of windows, (W, H, n), change when the observations that they start from do, (T, n)."""
        moved = replace(self, states=self.states + observation @ self.simulation.state_map.restore.T)
        return moved._missed((), starts) - self._missed((), starts)

    def _made_by_noise(self) -> np.ndarray:
        """The mean square, (T, H, n), that sensor noise makes of the residual of each window."""
        measured, rng = self.measured, np.random.default_rng(0)
        starts = np.concatenate([measured.fitted(self.horizon), measured.judged(self.horizon)])
        squares = np.zeros((len(measured), self.horizon, len(self.sensor_std)))
        for _ in range(_DRAWS):
            noise = self.sensor_std * rng.standard_normal(measured.observation.shape)
            squares[starts] += np.nan_to_num(self._moved(noise, starts) ** 2, nan=WORST**2) / _DRAWS
        return squares + self.sensor_std**2

    def _rounding(self, starts: np.ndarray) -> np.ndarray:
        """How large a residual, (n), the rounding of single precision in the states that windows start from makes."""
        observation, rng = self.measured.observation, np.random.default_rng(0)
        rounded_by = _ROUNDING * rng.uniform(-1.0, 1.0, observation.shape) * observation
        made = np.nanmean(np.abs(self._moved(rounded_by, starts)), axis=(0, 1))
        return made + _ROUNDING * np.abs(observation).max(0) + 1e-12


def _sensors(simulation: Simulation) -> list[Effect]:
    return [e for e in simulation.effects if isinstance(e, ObservationEffect) and not e.is_neutral]


def matters(nothing: float, without: float, with_them: float, share: float) -> bool:
    """Whether effects take more away from a loss than others do, by a share of all that they take away.

    Args:
        nothing: the loss without any effects.
        without: with the others.
        with_them: with the effects that are asked about.
        share: of ``nothing - with_them``.
    """
    return without - with_them > share * (nothing - with_them)


def losses(residual: np.ndarray) -> np.ndarray:
    """The robust loss (soft L1) of each window, (W), from residuals in scales, (W, H, n)."""
    return 2.0 * (np.sqrt(1.0 + residual**2) - 1.0).mean((1, 2))
