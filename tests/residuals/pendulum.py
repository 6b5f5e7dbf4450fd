"""A motored pendulum with forces outside the catalogue, and data recorded from it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import ForceEffect, parameter
from torchrl_h2o.residuals import Measured, Simulation, Split, StateMap

XML = """
<mujoco model="pendulum">
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor joint="elbow" ctrlrange="-1 1"/></actuator>
</mujoco>
"""

DOUBLE = """
<mujoco model="double pendulum">
  <option timestep="0.005" integrator="RK4"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-0.6 0.6"/><motor joint="elbow" ctrlrange="-0.3 0.3"/></actuator>
</mujoco>
"""

Law = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class UnknownForce(ForceEffect):
    """A torque as an arbitrary function of position, velocity and time."""

    wording: ClassVar[str] = "{size} of what nobody knows"
    size: float = parameter(unit="N·m", bounds=(-10.0, 10.0), neutral=0.0)
    law: Law = lambda q, v, t: 0.0 * q

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Callable:
        return lambda data: self.size * self.law(data.qpos, data.qvel, data.time)

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> Callable:
        return lambda states: self.size * self.law(states.qpos, states.qvel, states.time[:, None])


def three_parts(rows):
    """The split, (T), of one run: half for fits, a fifth for selection, the rest for the report."""
    return np.select(
        [np.arange(rows) < 0.5 * rows, np.arange(rows) < 0.7 * rows], [Split.FIT, Split.SELECTION], Split.REPORT
    )


def pendulum() -> Simulation:
    state_map = StateMap.of_coordinates(("elbow", "elbow_velocity"), ("rad", "rad/s"), (0, 1), num_states=2)
    return Simulation(lambda: mujoco.MjSpec.from_string(XML), 2, state_map, name="pendulum")


def double_pendulum() -> Simulation:
    names = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
    state_map = StateMap.of_coordinates(names, ("rad", "rad", "rad/s", "rad/s"), (0, 1, 2, 3), num_states=4)
    return Simulation(lambda: mujoco.MjSpec.from_string(DOUBLE), 2, state_map, name="double pendulum")


def recorded(
    real: Simulation, transitions: int = 1500, noise: float = 0.0, seed: int = 0, *, smooth: float = 0.9
) -> Measured:
    """One run under random torques, after the action effects; noise is a share of each dimension's spread.

    Each torque keeps the share ``smooth`` of the one before.
    """
    rng = np.random.default_rng(seed)
    motors, states = real.model.nu, real.model.nq + real.model.nv
    action = np.zeros((transitions, motors))
    for t in range(1, transitions):
        action[t] = smooth * action[t - 1] + 0.4 * rng.standard_normal(motors)
    low, high = real.model.actuator_ctrlrange.T
    bounds = (low, high) if (high > low).all() else (-1.0, 1.0)
    action = np.clip(0.8 * action, *bounds)
    executed = real.executed(action, np.random.default_rng([seed, 1]))
    reached = real.rollout(np.zeros((1, states)), executed[None])[0]
    observed = np.vstack([np.zeros(states), reached])
    observed += noise * observed.std(0) * rng.standard_normal(observed.shape)
    rows = np.arange(transitions)
    return Measured(
        observed[:-1],
        action,
        observed[1:],
        run=np.zeros(transitions, int),
        time=rows * real.control_step,
        usable=np.ones(transitions, bool),
        split=three_parts(transitions),
        left_out={},
        source="pendulum",
    )
