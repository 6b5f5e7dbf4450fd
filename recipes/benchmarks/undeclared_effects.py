"""Effects outside the catalogue: forces that the code under test does not define, and another version's inertias."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from math import pi
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import ForceEffect, ModelEffect, Names, parameter, selection
from torchrl_h2o.effects.effect import Force
from torchrl_h2o.effects.model.inertial import edit_inertials
from torchrl_h2o.effects.states import BatchedForce, States

_TORQUE = {"unit": "N·m", "bounds": (-1000.0, 1000.0), "neutral": 0.0}
_SLOW = 0.05  # rad/s; below it dry friction fades to avoid chattering


@dataclass(frozen=True)
class _TorqueOnJoint(ForceEffect):
    """A torque on one joint as a function of its angle, its velocity and the time since the start."""

    torque: float = parameter(**_TORQUE)
    joint: Names = "*"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        force = self.batched(model, rng)
        return lambda data: force(States.of(data))[0]

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        (dof,) = selection.joint_dofs(model, self.joint)
        angle = model.jnt_qposadr[model.dof_jntid[dof]]

        def force(states: States) -> np.ndarray:
            forces = np.zeros_like(states.qvel)
            forces[:, dof] = self.torque_at(states.qpos[:, angle], states.qvel[:, dof], states.time)
            return forces

        return force

    @abstractmethod
    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Torque (B,), N·m, at angles (rad), velocities (rad/s) and times (s), each (B,)."""


@dataclass(frozen=True)
class TorqueRipple(_TorqueOnJoint):
    """Torque ripple of gear teeth or motor poles, proportional to sin(k q)."""

    wording: ClassVar[str] = "ripple of {torque}, sin({waves} q), on {joint}"
    waves: float = parameter(unit="1", bounds=(0.1, 100.0), neutral=1.0)

    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        return self.torque * np.sin(self.waves * q)


@dataclass(frozen=True)
class CubicWind(_TorqueOnJoint):
    """Resistance proportional to the velocity cubed; ``torque`` is its value at ``speed``."""

    wording: ClassVar[str] = "wind of {torque} at {speed}, with v³, on {joint}"
    speed: float = parameter(unit="rad/s", bounds=(0.01, 1000.0), neutral=1.0)

    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        return -self.torque * (v / self.speed) ** 3


@dataclass(frozen=True)
class MovingSpring(_TorqueOnJoint):
    """Spring to an oscillating point; ``torque`` is its value at a distance of ``swing``."""

    wording: ClassVar[str] = "spring of {torque} to a point that swings by {swing} in {period}, on {joint}"
    swing: float = parameter(unit="rad", bounds=(0.01, 10.0), neutral=1.0)
    period: float = parameter(unit="s", bounds=(0.1, 1000.0), neutral=1.0)

    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        point = self.swing * np.sin(2.0 * pi * time / self.period)
        return self.torque * (point - q) / self.swing


@dataclass(frozen=True)
class LateForce(_TorqueOnJoint):
    """Constant torque that starts at a given time, such as a dragging hose."""

    wording: ClassVar[str] = "{torque} from {start} on, on {joint}"
    start: float = parameter(unit="s", bounds=(0.0, 10000.0), neutral=0.0)

    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        return np.where(time >= self.start, self.torque, 0.0)


@dataclass(frozen=True)
class DriftingTorque(_TorqueOnJoint):
    """Torque that grows with time, such as a motor's offset while it warms up; ``torque`` is its value at the end."""

    wording: ClassVar[str] = "drift to {torque} in {duration}, on {joint}"
    duration: float = parameter(unit="s", bounds=(0.1, 10000.0), neutral=1.0)

    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        return self.torque * time / self.duration


@dataclass(frozen=True)
class PlaceFriction(_TorqueOnJoint):
    """Dry friction that depends on the angle, such as a bent axle: largest at one angle, zero at the opposite."""

    wording: ClassVar[str] = "friction of {torque} · (1 + sin({waves} q)) / 2 on {joint}"
    waves: float = parameter(unit="1", bounds=(0.1, 100.0), neutral=1.0)

    def torque_at(self, q: np.ndarray, v: np.ndarray, time: np.ndarray) -> np.ndarray:
        return -0.5 * self.torque * (1.0 + np.sin(self.waves * q)) * np.tanh(v / _SLOW)


@dataclass(frozen=True)
class OtherVersion(ModelEffect):
    """Another version of the simulator: the inertias of all bodies and the dampings of all joints differ a little.

    MuJoCo has changed how it computes the inertia of capsules. The differences, larger or smaller, are drawn at random.
    """

    wording: ClassVar[str] = "inertias and damping as in version {version}"
    version: float = parameter(unit="1", bounds=(0.0, 1e9), neutral=0.0)

    inertia: ClassVar[tuple[float, float]] = (0.02, 0.06)  # smallest and largest relative difference
    damping: ClassVar[tuple[float, float]] = (0.01, 0.03)

    def edit(self, spec: mujoco.MjSpec) -> None:
        rng = np.random.default_rng(int(self.version))
        for body in selection.bodies(spec, "*"):
            factor = self._factor(self.inertia, rng)
            edit_inertials(spec, [body], lambda old, factor=factor: replace(old, inertia=factor * old.inertia))
        for joint in selection.joints(spec, "*"):
            joint.damping[0] *= self._factor(self.damping, rng)

    @staticmethod
    def _factor(differences: tuple[float, float], rng: np.random.Generator) -> float:
        return 1.0 + float(rng.choice([-1, 1]) * rng.uniform(*differences))
