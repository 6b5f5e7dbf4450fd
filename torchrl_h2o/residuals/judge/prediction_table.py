"""One table of how well the held-out motion is predicted: by the simulator as it is, mended, and by two rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from scipy.stats import t as student

from torchrl_h2o.effects import Effect, selection
from torchrl_h2o.likelihood import BLOCKS, ENOUGH, Difference
from torchrl_h2o.residuals.estimated_states import estimate_states, sensor_noise
from torchrl_h2o.residuals.judge.headline import HEADLINE_WINDOWS
from torchrl_h2o.residuals.judge.network import learned
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.residual import residuals, start_states, undelayed_following
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.errors import HeadlineError, PredictedRow, Prediction, PredictionTable
from torchrl_h2o.residuals.report.sentence import effects_in_words, headline_words
from torchrl_h2o.residuals.report.words import duration, number
from torchrl_h2o.residuals.simulation.simulation import Simulation

LEARNT = 0.8  # share of the error that a network may leave at most for something learnable to be missing
FARTHEST = 10.0  # largest error of a reading that counts, in its spreads
BETTER_THAN_GUESS = 0.8  # share of the guess's error up to which effects explain the motion
CLEARLY = 0.3  # motion that the guess misses, in the noise of the readings, from which it is told from noise
NEGLIGIBLE = 0.002  # errors below this, in spreads of the readings, do not count
LITTLE = 0.02  # neither does what a network learns of an error below this share of the error without effects
WORSE = 1.1  # factor on the error of a reading above which the effects make it worse
OF_ABSOLUTE = math.sqrt(2.0 / math.pi)  # mean absolute value of normal noise, in its standard deviation
TOTAL = "total"
_COMPARED = ("mended", "velocities_stay")


@dataclass(frozen=True, eq=False)
class Predicted:
    """Errors of each held-out window, by predictor, in all quantities and in those of each joint.

    Args:
        names: ``"total"`` and the joints, (R).
        seconds: time ahead, in s.
        losses: for each predictor, mean absolute error in spreads of the readings, (R, W).
        readings: name, unit and spread of each reading.
        by_reading: for the simulator as it is and mended, absolute errors in these spreads, (n, W).
        one_step: for both, mean absolute error of all readings one step ahead, (V).
        noise: mean absolute noise of the readings, in their spreads, (R).
    """

    names: tuple[str, ...]
    seconds: float
    losses: dict[str, np.ndarray]
    readings: tuple[tuple[str, str, float], ...]
    by_reading: tuple[np.ndarray, np.ndarray]
    one_step: tuple[np.ndarray, np.ndarray]
    noise: np.ndarray

    @cached_property
    def table(self) -> PredictionTable:
        """The mean errors with their 95 % intervals, from the scatter between blocks of neighbouring windows."""
        rows = []
        for index, name in enumerate(self.names):
            cells = {which: _with_interval(loss[index]) for which, loss in self.losses.items()}
            rows.append(PredictedRow(name, **cells))
        return PredictionTable(self.seconds, tuple(rows))

    @cached_property
    def learnt(self) -> tuple[str, ...]:
        """Says so if a small network predicts what the simulator leaves of the motion: then something is missing."""
        mended, learned = self.losses["mended"], self.losses["mended_and_network"]
        shares = learned.mean(1) / np.maximum(mended.mean(1), 1e-12)
        least = np.maximum(NEGLIGIBLE, LITTLE * self.losses["as_it_is"].mean(1))
        needed = ENOUGH + math.log(len(self.names))
        telling = [
            row
            for row in np.flatnonzero((shares < LEARNT) & (mended.mean(1) > least))
            if Difference.of_losses(mended[row], learned[row]).evidence > needed
        ]
        if not telling:
            return ()
        best = min(telling, key=lambda row: shares[row])
        where = "the motion" if self.names[best] == TOTAL else f"the motion of {self.names[best]}"
        ahead = f"{duration(self.seconds)} ahead"
        return (f"a small network removes {1.0 - shares[best]:.0%} of the error that is left in {where} {ahead}",)

    @property
    def is_better(self) -> bool:
        """Whether the mended simulator predicts better than the simulator as it is, one step or some steps ahead.

        Noise of measured torques moves the simulator and not the machine, and can hide an effect some steps ahead.
        """
        ahead = self.losses["as_it_is"][0], self.losses["mended"][0]
        return any(Difference.of_losses(*pair).evidence > ENOUGH for pair in (ahead, self.one_step))

    @cached_property
    def made_worse(self) -> tuple[str, ...]:
        """Names the reading whose error the effects raise most, as evidence that one of them is wrong.

        A fit lowers the sum over all readings. A wrong effect can lower it, if what one reading gains exceeds what
        another one loses; a right one lowers all errors, or leaves them as they are.
        """
        before, after = (np.median(error, axis=1) for error in self.by_reading)
        rise = after / np.maximum(before, NEGLIGIBLE)
        needed = ENOUGH + math.log(len(self.readings))
        telling = [
            index
            for index, (better, worse) in enumerate(zip(*self.by_reading, strict=True))
            if rise[index] > WORSE and Difference.of_losses(worse, better).evidence > needed
        ]
        if not telling:
            return ()
        worst = max(telling, key=lambda index: rise[index])
        name, unit, spread = self.readings[worst]
        rose = HeadlineError(name, unit, self.seconds, float(spread * before[worst]), float(spread * after[worst]))
        return (f"at least one of these effects is wrong: they raise the error of {headline_words(rose)}",)

    @cached_property
    def shares_of_guess(self) -> np.ndarray:
        """Error of the mended simulator, as a share of that of the guess that every velocity stays as it is, (R).

        The noise of the readings, which nothing predicts, is taken from both where the guess misses by clearly more.
        """
        mended, stays = (self.losses[which].mean(1) for which in _COMPARED)
        motion = np.sqrt(np.maximum(stays**2 - self.noise**2, 0.0))
        above = np.sqrt(np.maximum(mended**2 - self.noise**2, 0.0)) / np.maximum(motion, NEGLIGIBLE)
        is_clear = motion > np.maximum(CLEARLY * self.noise, NEGLIGIBLE)
        return np.where(is_clear, above, mended / np.maximum(stays, NEGLIGIBLE))

    def hardly_better(self, simulation: Simulation, effects: Sequence[Effect]) -> tuple[str, ...]:
        """Says so if effects predict motion hardly better than the guess that every velocity stays as it is.

        Rotors so heavy that no torque moves them lower the error of a model without friction, if the motion is slow.
        Such effects explain nothing: they predict that the velocities do not change.

        Args:
            simulation: the simulator, for the joints that effects act on.
            effects: the effects.

        Returns:
            One clause about all motion, or about the effects on joints that are all predicted so; or nothing.
        """
        if not effects:
            return ()
        mended, stays = (dict(zip(self.names, self.losses[which].mean(1), strict=True)) for which in _COMPARED)
        shares = dict(zip(self.names, self.shares_of_guess, strict=True))
        worst = TOTAL
        subject = "the effects found predict the motion"
        if shares[TOTAL] <= BETTER_THAN_GUESS:
            vain = [
                effect
                for effect in effects
                if (own := _joints_of(simulation, effect)) and min(shares[name] for name in own) > BETTER_THAN_GUESS
            ]
            if not vain:
                return ()
            worst = max((name for effect in vain for name in _joints_of(simulation, effect)), key=shares.__getitem__)
            subject = f"with {effects_in_words(vain, simulation.names)}, the motion of these joints is predicted"
        compared = f"{duration(self.seconds)} ahead, {number(mended[worst], 2)} against {number(stays[worst], 2)} σ"
        return (f"{subject} hardly better than by the guess that every velocity stays as it is ({compared})",)


def predicted(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    steps: int,
    *,
    seed: int,
) -> Predicted | None:
    """Predicts the held-out motion by the simulator as it is and mended, by constant velocities, and with a network.

    The network predicts what the mended simulator leaves; see :func:`~torchrl_h2o.residuals.judge.network.learned`.

    Args:
        simulation: the simulator before effects are put in.
        mended: the simulator with them.
        measured: the data.
        steps: control steps ahead.
        seed: seed of the network.

    Returns:
        The errors; None if the data hold too few held-out windows.
    """
    judged, fitted = (
        in_motion(measured, which(steps), steps, HEADLINE_WINDOWS) for which in (measured.reported_on, measured.fitted)
    )
    if len(judged) < HEADLINE_WINDOWS:
        return None
    spread = np.maximum(measured.observation.std(0), 1e-12)
    rows, sensors = measured.reported_on(), sensor_noise(mended, measured)
    every = np.unique(np.concatenate([judged, fitted, rows]))
    states = {
        which: (start_states if sensors is None else estimate_states)(which, measured, every)
        for which in (simulation, mended)
    }

    def errors(which: Simulation, starts: np.ndarray, steps: int = steps) -> np.ndarray:
        return residuals(which, measured, starts, steps, states=states[which])[:, -1] / spread

    stays = at_constant_velocity(mended, states[mended][judged], steps)
    stays = undelayed_following(mended, measured)[judged + steps - 1] - stays
    left = errors(mended, judged)
    answer = learned(mended, measured, fitted, judged, errors(mended, fitted), steps, seed)
    names, readings = _rows(mended)
    by_predictor = {
        "as_it_is": errors(simulation, judged),
        "mended": left,
        "velocities_stay": stays / spread,
        "mended_and_network": left - answer,
    }
    known = np.isfinite(stays)  # late sensors leave the readings at the ends of runs unknown
    losses = {name: mean_errors(error, known, readings) for name, error in by_predictor.items()}
    single = [[index] for index in range(len(spread))]
    before, after = (mean_errors(by_predictor[name], known, single) for name in ("as_it_is", "mended"))
    next_known = np.isfinite(undelayed_following(mended, measured)[rows])
    nearest = [mean_errors(errors(which, rows, 1), next_known, readings[:1])[0] for which in (simulation, mended)]
    one_step = nearest[0], nearest[1]
    described = tuple(zip(simulation.state_map.names, simulation.state_map.units, spread.tolist(), strict=True))
    scatter = OF_ABSOLUTE * (np.zeros(len(spread)) if sensors is None else sensors) / spread
    noise = np.array([scatter[own].mean() for own in readings])
    return Predicted(names, steps * simulation.control_step, losses, described, (before, after), one_step, noise)


def at_constant_velocity(simulation: Simulation, states: np.ndarray, steps: int) -> np.ndarray:
    """Observations, (W, n), some control steps after states (W, nq + nv), if the velocities stay as they are."""
    model, seconds = simulation.model, steps * simulation.control_step
    position, velocity = states[:, : model.nq].copy(), states[:, model.nq :]
    for qpos, qvel in zip(position, velocity, strict=True):
        mujoco.mj_integratePos(model, qpos, qvel, seconds)
    return simulation.observed(np.hstack([position, velocity])[:, None])[:, 0]


def _rows(simulation: Simulation) -> tuple[tuple[str, ...], list[list[int]]]:
    """Names of the rows of the table, and the readings of each: all, and those of each joint."""
    model, names, readings = simulation.model, [TOTAL], [list(range(len(simulation.state_map.names)))]
    for joint in range(model.njnt):
        if own := readings_of_joint(simulation, joint):
            names.append(_name_of(model, joint))
            readings.append(own)
    return tuple(names), readings


def _joints_of(simulation: Simulation, effect: Effect) -> list[str]:
    """Names of the observed joints that an effect acts on; empty for an effect that does not act on joints."""
    if (chosen := getattr(effect, "joints", None)) is None:
        return []
    model = simulation.model
    joints = {int(model.dof_jntid[dof]) for dof in selection.joint_dofs(model, chosen)}
    return [_name_of(model, joint) for joint in sorted(joints) if readings_of_joint(simulation, joint)]


def _name_of(model: mujoco.MjModel, joint: int) -> str:
    return model.joint(joint).name or f"joint {joint}"


def readings_of_joint(simulation: Simulation, joint: int) -> list[int]:
    """Indices of the readings that depend on the position or the velocity of a joint."""
    model, observe = simulation.model, simulation.state_map.observe
    positions, dofs = (
        np.arange(first[joint], np.append(first, size)[joint + 1])
        for first, size in ((model.jnt_qposadr, model.nq), (model.jnt_dofadr, model.nv))
    )
    return np.flatnonzero((observe[:, [*positions, *(model.nq + dofs)]] != 0.0).any(1)).tolist()


def mean_errors(error: np.ndarray, known: np.ndarray, readings: list[list[int]]) -> np.ndarray:
    """Mean absolute errors of the known readings among some, (R, W), of errors (W, n), each cut at ``FARTHEST``."""
    size = np.where(known, np.fmin(np.nan_to_num(np.abs(error), nan=FARTHEST), FARTHEST), 0.0)
    return np.stack([size[:, own].sum(1) / np.maximum(known[:, own].sum(1), 1) for own in readings])


def _with_interval(loss: np.ndarray) -> Prediction:
    """Mean of the losses (W) and its 95 % interval."""
    means = np.array([part.mean() for part in np.array_split(loss, min(BLOCKS, len(loss)))])
    half = student.ppf(0.975, len(means) - 1) * means.std(ddof=1) / np.sqrt(len(means))
    return Prediction(float(loss.mean()), float(max(0.0, loss.mean() - half)), float(loss.mean() + half))
