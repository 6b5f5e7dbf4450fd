"""Torques at joints for many states at once: those of the actuators and that of the weight."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.force.kinematics import com_jacobians
from torchrl_h2o.effects.selection import Names
from torchrl_h2o.effects.states import States

_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_DYNAMICS = (int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))


class JointActuators:
    """The motors and servos that act on single joints, and the torques that they make.

    Their numbers are those that the model has now; it may be changed afterwards.

    Args:
        model: the model.
        indices: the actuators, all by default.

    Attributes:
        indices: the actuators, (k).
        dofs: degree of freedom that each acts on, (k).
        gear: transmission of each to its joint, (k).

    Raises:
        ValueError: if one of them is no motor, servo or filter on a single joint.
    """

    def __init__(self, model: mujoco.MjModel, indices: Iterable[int] | None = None) -> None:
        own = np.arange(model.nu) if indices is None else np.array(list(indices), int)
        for index in own:
            linear = model.actuator_gaintype[index] in _GAINS and model.actuator_biastype[index] in _BIASES
            on_joint = model.actuator_trntype[index] in _ON_JOINT
            if not linear or not on_joint or model.actuator_dyntype[index] not in _DYNAMICS:
                raise ValueError(
                    f"the torque of actuator '{model.actuator(index).name or index}' is no linear function of its "
                    "command, position and velocity; choose motors and servos on hinges or slides"
                )
        joints = model.actuator_trnid[own, 0]
        self.indices, self.dofs, self.gear = own, model.jnt_dofadr[joints], model.actuator_gear[own, 0]
        self._positions, self._activations = model.jnt_qposadr[joints], model.actuator_actadr[own]
        gain, bias = model.actuator_gainprm[own, :3], model.actuator_biasprm[own, :3]
        self._gain = np.where(model.actuator_gaintype[own, None] == _GAINS[1], gain, gain * [1.0, 0.0, 0.0])
        self._bias = np.where(model.actuator_biastype[own, None] == _BIASES[1], bias, 0.0)
        clamps = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        self._commands = _limits(model.actuator_ctrllimited[own] * clamps, model.actuator_ctrlrange[own])
        self._forces = _limits(model.actuator_forcelimited[own], model.actuator_forcerange[own])
        self._moment = np.eye(model.nv)[self.dofs]
        self._on_joints = _limits(model.jnt_actfrclimited, model.jnt_actfrcrange)[:, model.dof_jntid]

    @classmethod
    def on(cls, model: mujoco.MjModel, joints: Names = "*") -> JointActuators:
        """The actuators on matching joints.

        Raises:
            ValueError: if the model has no such joint, or an actuator on one of them is no motor, servo or filter.
        """
        chosen = set(model.dof_jntid[selection.joint_dofs(model, joints)].tolist())
        on_joint = np.isin(model.actuator_trntype, _ON_JOINT)
        return cls(model, (i for i in range(model.nu) if on_joint[i] and model.actuator_trnid[i, 0] in chosen))

    def inputs(self, states: States) -> np.ndarray:
        """The commands within their range, or their filtered values, (B, k)."""
        found, filtered = np.clip(states.ctrl[:, self.indices], *self._commands), self._activations >= 0
        found[:, filtered] = states.act[:, self._activations[filtered]]
        return found

    def lengths(self, states: States) -> np.ndarray:
        """Positions of the joints as the actuators see them, (B, k)."""
        return self.gear * states.qpos[:, self._positions]

    def forces(self, inputs: np.ndarray, states: States) -> np.ndarray:
        """Forces of the actuators for inputs (B, k), within their limits, (B, k)."""
        at = np.stack([np.ones_like(inputs), self.lengths(states), self.gear * states.qvel[:, self.dofs]], axis=-1)
        return np.clip((at * self._gain).sum(-1) * inputs + (at * self._bias).sum(-1), *self._forces)

    def on_joints(self, forces: np.ndarray) -> np.ndarray:
        """Torques on all degrees of freedom, (B, nv), of forces of the actuators, (B, k)."""
        return (self.gear * forces) @ self._moment

    def torques(self, states: States) -> np.ndarray:
        """Torques of the actuators on all degrees of freedom, (B, nv), as in ``mjData.qfrc_actuator``."""
        return np.clip(self.on_joints(self.forces(self.inputs(states), states)), *self._on_joints)


def _limits(limited: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Lower and upper limits, (2, k); infinite where there are none."""
    return np.where(limited.astype(bool)[:, None], ends, [-np.inf, np.inf]).T


class Weight:
    """Torques of the weight of all bodies on the degrees of freedom, computed once for the same states.

    Args:
        model: the model.
    """

    def __init__(self, model: mujoco.MjModel):
        heavy = [body for body in range(1, model.nbody) if model.body_mass[body] > 0.0]
        self._jacobians = com_jacobians(model, heavy)
        carried = model.body_mass[heavy] * (1.0 - model.body_gravcomp[heavy])
        self._forces = carried[:, None] * model.opt.gravity
        self._last: tuple[States | None, np.ndarray] = None, np.empty(0)

    def torques(self, states: States) -> np.ndarray:
        """The torques, (B, nv): at rest, minus ``mjData.qfrc_bias``."""
        seen, torques = self._last
        if seen is not states:
            torques = np.einsum("bicv,ic->bv", self._jacobians(states.qpos), self._forces)
            self._last = states, torques
        return torques
