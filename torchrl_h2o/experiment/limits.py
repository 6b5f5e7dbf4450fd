"""What a machine may do in an experiment: its commands, joints, velocities and contacts."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_h2o.effects.model.servo import is_servo
from torchrl_h2o.residuals.simulation.simulation import Simulation

BETWEEN_STOPS, MOST_STOPS = 0.04, 2_000  # s between two stops on the way to rest, and stops
AT_REST = 1e-5  # largest move between two stops at rest, in rad or m; friction in MuJoCo lets a joint creep
BEFORE = 0.5  # s for which the first command has been given, so that delays and lags have passed
SCALAR = [int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)]  # joints of one coordinate
RANGE = 0.95  # share of a joint's range, and of an actuator's, that an experiment uses


@dataclass(frozen=True)
class Envelope:
    """What an experiment may use. No data tell it: set what the machine, its mount and the people beside it allow.

    Args:
        seconds: duration, in s.
        within: largest distance of a joint from its position at rest, in rad or m.
        speed: largest velocity of a joint, in rad/s or m/s.
        band: highest frequency of the commands, in Hz.
        contact: whether parts may touch that do not touch at rest.
    """

    seconds: float = 5.0
    within: float = 0.5
    speed: float = 3.0
    band: float = 3.0
    contact: bool = False


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits that every explanation must keep.

    Args:
        command: (nu, 2), lowest and highest command of each actuator.
        position: (nq, 2), lowest and highest coordinate.
        speed: largest velocity of each joint, in rad/s or m/s.
        contact: whether parts may touch that do not touch at rest.
    """

    command: np.ndarray
    position: np.ndarray
    speed: float
    contact: bool = False

    @classmethod
    def around(cls, simulation: Simulation, rest: np.ndarray, commands: np.ndarray, envelope: Envelope) -> Limits:
        """Limits around a pose at rest: of the model, and of the commands of a log where the model has none.

        Args:
            simulation: the simulator.
            rest: state at rest, (nq + nv).
            commands: commands of an earlier log, (T, nu).
            envelope: what the experiment may use.
        """
        model = simulation.model
        limited = model.actuator_ctrllimited.astype(bool)[:, None]
        logged = np.stack([commands.min(0), commands.max(0)], axis=1)
        command = np.where(limited, _shrunk(model.actuator_ctrlrange), logged)
        position = np.full((model.nq, 2), [-np.inf, np.inf])
        for joint in np.flatnonzero(np.isin(model.jnt_type, SCALAR)):
            place = model.jnt_qposadr[joint]
            position[place] = rest[place] + np.array([-envelope.within, envelope.within])
            if model.jnt_limited[joint]:
                low, high = _shrunk(model.jnt_range[joint])
                low, high = min(low, rest[place]), max(high, rest[place])  # a gripper may rest at its stop
                position[place] = np.clip(position[place], low, high)
        for actuator in np.flatnonzero(servos(simulation)):  # a stiffer servo than the model's reaches its target
            if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
                joint, gear = model.actuator_trnid[actuator, 0], model.actuator_gear[actuator, 0]
                ends = np.sort(gear * position[model.jnt_qposadr[joint]])
                command[actuator] = np.clip(command[actuator], *ends)
        return cls(command, position, envelope.speed, envelope.contact)

    def kept(self, states: np.ndarray) -> np.ndarray:
        """Whether each run, (B, T, nq + nv), keeps the limits of positions and velocities, (B)."""
        nq = len(self.position)
        low, high = self.position.T
        position, velocity = states[..., :nq], states[..., nq:]
        good = np.isfinite(states).all((1, 2)) & (np.abs(np.nan_to_num(velocity)) <= self.speed).all((1, 2))
        return good & (np.nan_to_num(position) >= low).all((1, 2)) & (np.nan_to_num(position) <= high).all((1, 2))

    def touches(self, simulation: Simulation, states: np.ndarray) -> bool:
        """Whether parts touch in a run, (T, nq + nv), that do not touch in its first state."""
        if self.contact or not (simulation.model.geom_contype.any() or simulation.model.geom_conaffinity.any()):
            return False
        data, nq = mujoco.MjData(simulation.model), simulation.model.nq
        known: list[set[int]] = []
        for index, state in enumerate(states):
            data.qpos[:], data.qvel[:] = state[:nq], state[nq:]
            mujoco.mj_fwdPosition(simulation.model, data)
            pairs = [{int(contact.geom1), int(contact.geom2)} for contact in data.contact[: data.ncon]]
            if index == 0:
                known = pairs
            elif any(pair not in known for pair in pairs):
                return True
        return False


def _shrunk(ranges: np.ndarray) -> np.ndarray:
    """Ranges (..., 2) about their middle."""
    middle = ranges.mean(-1, keepdims=True)
    return middle + RANGE * (ranges - middle)


def servos(simulation: Simulation) -> np.ndarray:
    """Whether each actuator is a position servo, whose command is a target, (nu)."""
    return np.array([is_servo(actuator) for actuator in simulation.spec().actuators], dtype=bool)


def executed_from_rest(simulation: Simulation, commands: np.ndarray) -> np.ndarray:
    """Executed actions, (T, nu), of commands whose first one has been given for some time."""
    before = round(BEFORE / simulation.control_step)
    return simulation.executed(np.concatenate([np.repeat(commands[:1], before, axis=0), commands]))[before:]


def state_at_rest(simulation: Simulation, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """State of rest under a constant command, (nq + nv): the one that the machine slides to without gaining speed.

    Args:
        simulation: the simulator.
        state: state to begin with, (nq + nv).
        command: the command, (nu).

    Raises:
        ValueError: if the machine has no actuator, or does not come to rest.
    """
    if not len(command):
        raise ValueError("the model has no actuator, so there is nothing to command")
    nq, still = simulation.model.nq, state.copy()
    still[nq:] = 0.0
    steps = max(1, round(BETWEEN_STOPS / simulation.control_step))
    executed = executed_from_rest(simulation, np.broadcast_to(command, (steps, len(command))))
    for _ in range(MOST_STOPS):
        after = simulation.rollout(still[None], executed[None])[0, -1]
        moved = np.abs(after - still)[:nq].max()
        still[:nq] = after[:nq]
        if not np.isfinite(still).all() or moved < AT_REST:
            break
    if not moved < AT_REST:  # also for NaN
        raise ValueError(
            f"under the constant command {np.round(command, 4).tolist()} the machine does not come to rest: an "
            "experiment begins and ends at rest"
        )
    return still
