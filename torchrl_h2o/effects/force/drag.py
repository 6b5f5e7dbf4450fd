"""Constant forces on joints and drag on bodies."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import Force, ForceEffect
from torchrl_h2o.effects.force.kinematics import com_jacobians
from torchrl_h2o.effects.parameter import ANY_AMOUNT, ANY_SIZE, parameter
from torchrl_h2o.effects.selection import Names
from torchrl_h2o.effects.states import BatchedForce, States


@dataclass(frozen=True)
class JointForce(ForceEffect):
    """A constant torque on joints; a force on sliding joints.

    Args:
        torque: torque in N·m, or force in N, on every degree of freedom of the joints.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint.

    Examples:
        >>> JointForce(-0.5, joints="*knee*").describe()
        'constant torque of -0.5 N·m on joints *knee*'
    """

    wording: ClassVar[str] = "constant {load} of {torque} on {joints}"
    torque: float = parameter(unit="N·m", bounds=ANY_SIZE, neutral=0.0)
    joints: Names = "*"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator | None) -> Force:
        force = np.zeros(model.nv)
        force[selection.joint_dofs(model, self.joints)] = self.torque
        return lambda data: force

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        force = self.process(model, rng)(None)
        return lambda states: np.broadcast_to(force, states.qvel.shape)


@dataclass(frozen=True)
class LinearDrag(ForceEffect):
    """Drag on bodies, proportional to the velocity of their centre of mass.

    Args:
        coefficient: force per velocity, in N·s/m.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> LinearDrag(0.4, bodies="torso").describe()
        'drag of 0.4 N·s/m on bodies torso'
    """

    wording: ClassVar[str] = "drag of {coefficient} on {bodies}"
    coefficient: float = parameter(unit="N·s/m", bounds=ANY_AMOUNT, neutral=0.0)
    bodies: Names = "*"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        return _drag(model, self.bodies, lambda speed: self.coefficient)

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        return _batched_drag(model, self.bodies, lambda speed: self.coefficient)


@dataclass(frozen=True)
class QuadraticDrag(ForceEffect):
    """Drag on bodies, -c |v| v for the velocity v of their centre of mass, as in air or water.

    Args:
        coefficient: c, force per velocity squared, in N·s²/m².
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> QuadraticDrag(0.4, bodies="torso").describe()
        'quadratic drag of 0.4 N·s²/m² on bodies torso'
    """

    wording: ClassVar[str] = "quadratic drag of {coefficient} on {bodies}"
    coefficient: float = parameter(unit="N·s²/m²", bounds=ANY_AMOUNT, neutral=0.0)
    bodies: Names = "*"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        return _drag(model, self.bodies, lambda speed: self.coefficient * speed)

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        return _batched_drag(model, self.bodies, lambda speed: self.coefficient * speed)


def _drag(model: mujoco.MjModel, names: Names, resistance: Callable[[Any], Any]) -> Force:
    """Returns the drag on bodies for a resistance in N·s/m that depends on the speed in m/s."""
    bodies = selection.body_ids(model, names)
    jacobian = np.zeros((3, model.nv))

    def drag(data: mujoco.MjData) -> np.ndarray:
        force = np.zeros(model.nv)
        for body in bodies:
            mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
            velocity = jacobian @ data.qvel
            force -= resistance(np.linalg.norm(velocity)) * jacobian.T @ velocity
        return force

    return drag


def _batched_drag(model: mujoco.MjModel, names: Names, resistance: Callable[[Any], Any]) -> BatchedForce:
    """Returns the drag of :func:`_drag` as a function of many states."""
    jacobians_at = com_jacobians(model, selection.body_ids(model, names))

    def drag(states: States) -> np.ndarray:
        jacobians = jacobians_at(states.qpos)
        velocities = (jacobians @ states.qvel[:, None, :, None])[..., 0]
        resisting = resistance(np.linalg.norm(velocities, axis=-1, keepdims=True)) * velocities
        return -(resisting[..., None, :] @ jacobians).sum(1)[:, 0]

    return drag
