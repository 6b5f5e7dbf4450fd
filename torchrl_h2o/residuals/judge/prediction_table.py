"""One table of how well the held-out motion is predicted: by the simulator as it is, mended, and by two rivals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch
from scipy.stats import t as student
from torch import nn

from torchrl_h2o.effects import Effect, selection
from torchrl_h2o.residuals.estimated_states import estimate_states, sensor_noise
from torchrl_h2o.residuals.judge.headline import HEADLINE_WINDOWS
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.residual import residuals, start_states, undelayed_following
from torchrl_h2o.residuals.measured.significance import p_value_of_losses
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.errors import PredictedRow, Prediction, PredictionTable
from torchrl_h2o.residuals.report.sentence import effects_in_words
from torchrl_h2o.residuals.report.words import duration, number
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation

CELLS, UPDATES, BATCH = 64, 500, 256  # of the network: units of its two hidden layers, updates and windows in each
FEWEST_LEARNT = 60  # windows for fits below which no network is trained
CHECKED = 0.2  # share of these, at their end, that tells how much of the network's answer to trust
TRUST = np.linspace(0.0, 1.0, 5)  # shares of its answer that are tried
FAR = 5.0  # standard deviations at which the network's inputs and targets are cut
LEARNT = 0.8  # share of the error that a network may leave at most for something learnable to be missing
FARTHEST = 10.0  # largest error of a reading that counts, in its spreads
BETTER_THAN_GUESS = 0.8  # share of the guess's error up to which effects explain the motion
NEGLIGIBLE = 0.002  # errors below this, in spreads of the readings, are not reported as a missing effect
LITTLE = 0.02  # neither are errors below this share of the error without effects
TOTAL = "total"
_COMPARED = ("mended", "velocities_stay")


@dataclass(frozen=True, eq=False)
class Predicted:
    """Errors of each held-out window, by predictor, in all quantities and in those of each joint.

    Args:
        names: ``"total"`` and the joints, (R).
        seconds: time ahead, in s.
        losses: for each predictor, mean absolute error in spreads of the readings, (R, W).
        settings: blocks and significance level.
    """

    names: tuple[str, ...]
    seconds: float
    losses: dict[str, np.ndarray]
    settings: LoopSettings

    @cached_property
    def table(self) -> PredictionTable:
        """The mean errors with their 95 % intervals, from the scatter between blocks of neighbouring windows."""
        rows = []
        for index, name in enumerate(self.names):
            cells = {which: _with_interval(loss[index], self.settings.blocks) for which, loss in self.losses.items()}
            rows.append(PredictedRow(name, **cells))
        return PredictionTable(self.seconds, tuple(rows))

    @cached_property
    def learnt(self) -> tuple[str, ...]:
        """Says so if a small network predicts what the simulator leaves of the motion: then something is missing."""
        mended, learned = self.losses["mended"], self.losses["mended_and_network"]
        shares = learned.mean(1) / np.maximum(mended.mean(1), 1e-12)
        least = np.maximum(NEGLIGIBLE, LITTLE * self.losses["as_it_is"].mean(1))
        level = self.settings.level / len(self.names)
        telling = [
            row
            for row in np.flatnonzero((shares < LEARNT) & (mended.mean(1) > least))
            if p_value_of_losses(mended[row], learned[row], self.settings) < level
        ]
        if not telling:
            return ()
        best = min(telling, key=lambda row: shares[row])
        where = "the motion" if self.names[best] == TOTAL else f"the motion of {self.names[best]}"
        ahead = f"{duration(self.seconds)} ahead"
        return (f"a small network removes {1.0 - shares[best]:.0%} of the error that is left in {where} {ahead}",)

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
        shares = {name: mended[name] / max(stays[name], NEGLIGIBLE) for name in self.names}
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
    settings: LoopSettings = DEFAULTS,
) -> Predicted | None:
    """Predicts the held-out motion by the simulator as it is and mended, by constant velocities, and with a network.

    The network predicts what the mended simulator leaves, from the readings at the start of a window and the mean of
    its actions. It is trained on the rows for fits, and as much of its answer is used as helps at their end.

    Args:
        simulation: the simulator before effects are put in.
        mended: the simulator with them.
        measured: the data.
        steps: control steps ahead.
        seed: seed of the network.
        settings: blocks and significance level.

    Returns:
        The errors; None if the data hold too few held-out windows.
    """
    judged, fitted = (
        in_motion(measured, which(steps), steps, HEADLINE_WINDOWS) for which in (measured.reported_on, measured.fitted)
    )
    if len(judged) < HEADLINE_WINDOWS:
        return None
    spread = np.maximum(measured.observation.std(0), 1e-12)
    noisy = sensor_noise(mended, measured) is not None

    def errors(which: Simulation, starts: np.ndarray) -> np.ndarray:
        states = estimate_states(which, measured, starts) if noisy else None
        return residuals(which, measured, starts, steps, states=states)[:, -1] / spread

    states = (estimate_states if noisy else start_states)(mended, measured, judged)[judged]
    stays = undelayed_following(mended, measured)[judged + steps - 1] - at_constant_velocity(mended, states, steps)
    left, learned = errors(mended, judged), np.zeros((len(judged), len(spread)))
    if len(fitted) >= FEWEST_LEARNT:
        inputs = _inputs(measured, fitted, steps), _inputs(measured, judged, steps)
        learned = _learned(*inputs, errors(mended, fitted), seed, mended.check)
    names, readings = _rows(mended)
    by_predictor = {
        "as_it_is": errors(simulation, judged),
        "mended": left,
        "velocities_stay": stays / spread,
        "mended_and_network": left - learned,
    }
    known = np.isfinite(stays)  # late sensors leave the readings at the ends of runs unknown
    losses = {name: mean_errors(error, known, readings) for name, error in by_predictor.items()}
    return Predicted(names, steps * simulation.control_step, losses, settings)


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


def _inputs(measured: Measured, starts: np.ndarray, steps: int) -> np.ndarray:
    """Readings at the start of windows and the mean of their actions, (W, n + nu)."""
    actions = measured.action[starts[:, None] + np.arange(steps)].mean(1)
    return np.concatenate([measured.observation[starts], actions], 1)


def _learned(
    fitted: np.ndarray, judged: np.ndarray, errors: np.ndarray, seed: int, check: Callable[[], object]
) -> np.ndarray:
    """What a network predicts of the errors of the judged windows, (W, n), from those of the fitted ones, (F, n)."""
    mean, std = fitted.mean(0), np.maximum(fitted.std(0), 1e-9)
    errors = np.nan_to_num(errors)
    scale = np.maximum(np.median(np.abs(errors), axis=0) / 0.6745, 1e-9)
    x, ask = (torch.from_numpy(np.clip((each - mean) / std, -FAR, FAR)).float() for each in (fitted, judged))
    y = torch.from_numpy(np.clip(errors / scale, -FAR, FAR)).float()
    known = round((1.0 - CHECKED) * len(x))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = (nn.Linear(x.shape[1], CELLS), nn.SiLU(), nn.Linear(CELLS, CELLS), nn.SiLU())
        network = nn.Sequential(*layers, nn.Linear(CELLS, y.shape[1]))
        optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=0.1)
        for _ in range(UPDATES):
            check()
            batch = torch.randint(known, (BATCH,))
            loss = nn.functional.smooth_l1_loss(network(x[batch]), y[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        answer, seen = network(ask).numpy() * scale, network(x[known:]).numpy() * scale
    left = np.abs(errors[known:, None] - TRUST[:, None] * seen[:, None]).mean(0)
    return TRUST[left.argmin(0)] * answer


def _with_interval(loss: np.ndarray, blocks: int) -> Prediction:
    """Mean of the losses (W) and its 95 % interval."""
    means = np.array([part.mean() for part in np.array_split(loss, min(blocks, len(loss)))])
    half = student.ppf(0.975, len(means) - 1) * means.std(ddof=1) / np.sqrt(len(means))
    return Prediction(float(loss.mean()), float(max(0.0, loss.mean() - half)), float(loss.mean() + half))
