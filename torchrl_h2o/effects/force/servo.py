"""What servos do beside their gains: a torque that falls with the speed, and a dead band of the error."""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects.effect import Force, ForceEffect
from torchrl_h2o.effects.gear.loads import JointActuators
from torchrl_h2o.effects.parameter import ANY_AMOUNT, parameter
from torchrl_h2o.effects.selection import Indices
from torchrl_h2o.effects.states import BatchedForce, States


class _OfActuators(ForceEffect):
    """A force by which the torque of actuators on joints differs from the model's."""

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        force = self.batched(model, rng)
        return lambda data: force(States.of(data))[0]


@dataclass(frozen=True)
class TorqueSpeedLine(_OfActuators):
    r"""The largest torque of motors falls with their speed, because the supply's voltage is limited.

    The torque lies between :math:`-\tau_0 (1 + \omega / \omega_0)` and :math:`\tau_0 (1 - \omega / \omega_0)`. A supply
    whose voltage sags under load has a smaller :math:`\tau_0`.

    Args:
        stall: :math:`\tau_0`, the largest torque at rest, in N·m at the joint.
        speed: :math:`\omega_0`, the speed at which no torque is left (no-load speed), in rad/s at the joint.
        actuators: indices of the actuators; all by default.

    Raises:
        ValueError: when put into a model in which one of them is no motor or servo on a single joint.

    Examples:
        >>> TorqueSpeedLine(0.5, 8.0).describe()
        'torque of all actuators at most 0.5 N·m at rest, none at 8 rad/s'
        >>> TorqueSpeedLine().is_neutral
        True

    Source: the motor equation without inductance, :math:`\tau = K_t (V - K_e \omega) / R`; MuJoCo, *DC Motor Model*,
    Eq. (2).
    """

    wording: ClassVar[str] = "torque of {actuators} at most {stall} at rest, none at {speed}"
    stall: float = parameter(unit="N·m", bounds=(0.0, math.inf), neutral=math.inf)
    speed: float = parameter(unit="rad/s", bounds=(1e-3, math.inf), neutral=math.inf)
    actuators: Indices = None

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        motors = JointActuators(model, self.actuators)

        def force(states: States) -> np.ndarray:
            forces = motors.forces(motors.inputs(states), states)
            torques, ratio = motors.gear * forces, states.qvel[:, motors.dofs] / self.speed
            within = np.clip(torques, -self.stall * (1.0 + ratio), self.stall * (1.0 - ratio))
            return motors.on_joints((within - torques) / motors.gear)

        return force


@dataclass(frozen=True)
class ServoDeadBand(_OfActuators):
    """Position servos do not react to small errors: the error is reduced by the width of a band around zero.

    A gear with play behind a servo that measures its motor's angle does the same, as long as the motor is fast.

    Args:
        width: half the width of the band, in the unit of the command.
        actuators: indices of the actuators; all by default.

    Raises:
        ValueError: when put into a model in which one of them is no servo on a single joint.

    Examples:
        >>> ServoDeadBand(0.01).describe({"actuator_units": ["rad"]})
        'dead band of 0.01 rad around the target of all actuators'
    """

    wording: ClassVar[str] = "dead band of {width} around the target of {actuators}"
    of_signal: ClassVar[str | None] = "width"
    width: float = parameter(unit="1", bounds=ANY_AMOUNT, neutral=0.0)
    actuators: Indices = None

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        servos = JointActuators(model, self.actuators)

        def force(states: States) -> np.ndarray:
            inputs = servos.inputs(states)
            reduced = inputs - np.clip(inputs - servos.lengths(states), -self.width, self.width)
            return servos.on_joints(servos.forces(reduced, states) - servos.forces(inputs, states))

        return force
