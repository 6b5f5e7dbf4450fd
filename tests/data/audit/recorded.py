"""A motored double pendulum and its recordings for the audit's tests."""

from dataclasses import replace

import mujoco
import numpy as np

from torchrl_h2o.data import audit
from torchrl_h2o.residuals import Measured, Simulation, StateMap

XML = """
<mujoco model="arm">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
</mujoco>
"""
NAMES = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")


def arm(*effects) -> Simulation:
    """A double pendulum that is stepped every 10 ms."""
    state_map = StateMap.of_coordinates(NAMES, ("rad", "rad", "rad/s", "rad/s"), (0, 1, 2, 3), num_states=4)
    return Simulation(lambda: mujoco.MjSpec.from_string(XML), 2, state_map, effects, "arm")


def swinging(*effects, zero: float = 0.0, rows: int = 2000, noise: float = 0.002) -> tuple[Measured, Simulation]:
    """Free motion of the arm without motors, with a wrong zero of the shoulder, and the simulation without either."""
    xml = XML[: XML.index("<actuator>")] + "</mujoco>"
    simulation = replace(arm(), spec=lambda: mujoco.MjSpec.from_string(xml))
    action, rng = np.zeros((rows, 0)), np.random.default_rng(0)
    start = np.array([1.2, -0.6, 0.0, 0.0])
    reached = simulation.with_effects(*effects).rollout(start[None], action[None])[0]
    observed = np.vstack([start, reached]) + np.array([zero, 0.0, 0.0, 0.0])
    observed += noise * observed.std(0) * rng.standard_normal(observed.shape)
    return measured(observed, action), simulation


def recording(*effects, seed: int = 0, rows: int = 2000, noise: float = 0.01) -> Measured:
    """One run of the arm with effects under random torques; noise is a share of each signal's spread."""
    rng, reality = np.random.default_rng(seed), arm(*effects)
    action = np.zeros((rows, 2))
    for row in range(1, rows):
        action[row] = 0.9 * action[row - 1] + np.array([0.5, 0.12]) * rng.standard_normal(2)
    executed = reality.executed(action, np.random.default_rng(seed))
    reached = reality.rollout(np.zeros((1, 4)), executed[None])[0]
    observed = np.vstack([np.zeros(4), reached])
    return measured(observed + noise * observed.std(0) * rng.standard_normal(observed.shape), action)


def holding(rows: int = 2000, noise: float = 0.01) -> Measured:
    """One run of the arm, held away from its rest by a controller with small random torques."""
    rng, reality, place = np.random.default_rng(0), arm(), np.array([1.2, 0.8])
    data, random = mujoco.MjData(reality.model), np.zeros(2)
    observed, action = [np.hstack([place, 0.0, 0.0])], []
    for _ in range(rows):
        position, velocity = np.split(observed[-1], 2)
        data.qpos[:] = position
        mujoco.mj_inverse(reality.model, data)  # the torque that holds the arm's weight
        random = 0.9 * random + np.array([0.1, 0.03]) * rng.standard_normal(2)
        pull = np.array([8.0, 2.0]) * (place - position) - np.array([1.0, 0.3]) * velocity
        action.append(data.qfrc_inverse + pull + random)
        observed.append(reality.rollout(observed[-1][None], action[-1][None, None])[0, 0])
    rows_seen = np.array(observed)
    return measured(rows_seen + noise * rows_seen.std(0) * rng.standard_normal(rows_seen.shape), np.array(action))


def pumped(*effects, rows: int = 1500, noise: float = 0.1) -> Measured:
    """One run of the arm with effects, swung up by torques that follow its noisy velocities, noise in rad/s."""
    rng, reality, state = np.random.default_rng(0), arm(*effects), np.array([0.3, 0.0, 0.0, 0.0])
    observed, action = [], []
    for _ in range(rows + 1):
        observed.append(state + np.array([0.001, 0.001, noise, noise]) * rng.standard_normal(4))
        action.append(np.clip(np.array([0.25, 0.06]) * observed[-1][2:], -1.0, 1.0))
        state = reality.rollout(state[None], action[-1][None, None])[0, 0]
    return measured(np.array(observed), np.array(action[:-1]))


def measured(observed: np.ndarray, action: np.ndarray, time: np.ndarray | None = None) -> Measured:
    """Transitions of one run from rows (T + 1, 4) and actions (T, 2)."""
    rows = len(action)
    none = np.zeros(rows, bool)
    stamps = 0.01 * np.arange(rows) if time is None else time
    run = np.zeros(rows, int)
    return Measured(observed[:-1], action, observed[1:], run, stamps, ~none, none, {}, "arm")


def rows_of(data: Measured) -> np.ndarray:
    """Rows (T + 1, 4) of a recording of one run."""
    return np.vstack([data.observation, data.following[-1:]])


def changed(data: Measured, change) -> Measured:
    """The recording with its rows changed."""
    return measured(change(rows_of(data).copy()), data.action, data.time)


def with_action(data: Measured, action: np.ndarray) -> Measured:
    return replace(data, action=action)


def scaled(columns, factor: float):
    """A change that multiplies columns by a factor."""

    def change(rows: np.ndarray) -> np.ndarray:
        rows[:, columns] *= factor
        return rows

    return change


def severe(data, simulation, check: str) -> str:
    """Words of the first severe finding of a check."""
    found = [finding for finding in audit(data, simulation).severe if finding.check == check]
    assert found, audit(data, simulation).words()
    return found[0].words


def warned(data, simulation, check: str) -> str:
    """Words of the first severe finding or warning of a check."""
    found = audit(data, simulation)
    named = [finding for finding in (*found.severe, *found.warnings) if finding.check == check]
    assert named, found.words()
    return named[0].words
