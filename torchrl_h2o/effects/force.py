"""Effects that are generalised forces, put on the joints at every physics step."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import Force, ForceEffect, parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class JointForce(ForceEffect):
    """A constant torque (on a sliding joint: a force) on joints.

    Args:
        torque: the torque in N·m, or the force in N, on every degree of freedom.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint.

    Examples:
        >>> JointForce(-0.5, joints="*knee*").describe()
        'constant torque of -0.5 N·m on joints *knee*'
    """

    wording: ClassVar[str] = "constant torque of {torque} on {joints}"
    torque: float = parameter(unit="N·m", bounds=(-1000.0, 1000.0), neutral=0.0)
    joints: Names = "*"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        force = np.zeros(model.nv)
        force[selection.joint_dofs(model, self.joints)] = self.torque
        return lambda data: force


@dataclass(frozen=True)
class LinearDrag(ForceEffect):
    """A force on bodies against the velocity of their centre of mass and proportional to it.

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
    coefficient: float = parameter(unit="N·s/m", bounds=(0.0, 1000.0), neutral=0.0)
    bodies: Names = "*"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        bodies = selection.body_ids(model, self.bodies)
        jacobian = np.zeros((3, model.nv))

        def drag(data: mujoco.MjData) -> np.ndarray:
            force = np.zeros(model.nv)
            for body in bodies:
                mujoco.mj_jacBodyCom(model, data, jacobian, None, body)
                force -= self.coefficient * jacobian.T @ (jacobian @ data.qvel)
            return force

        return drag
