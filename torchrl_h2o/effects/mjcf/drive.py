"""Action effects as part of a MuJoCo actuator: gain, offset and limits of its force.

A sequence of gains, offsets and saturations, followed by the clamping at the control range, has the form
u(a) = clamp(k·a + c, low, high). An actuator without a state, whose force is g·u + b, holds it as the gain g·k, the
bias b + g·c and, where the clamping is active, limits of its force.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from torchrl_h2o.effects.action.play import ActionSaturation
from torchrl_h2o.effects.action.signal import ActionBias, ActionGain
from torchrl_h2o.effects.effect import ActionEffect

_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_NONE, _AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_STATELESS = int(mujoco.mjtDyn.mjDYN_NONE)
_TRUE = mujoco.mjtLimited.mjLIMITED_TRUE


@dataclass(frozen=True)
class Drive:
    """The way of one action to the force of its actuator, with the effects taken up so far.

    Args:
        index: the actuator.
        commands: smallest and largest command; infinite if the actuator's control has no limits.
        gain: g, in N or N·m per unit of the control.
        bias: constant, position and velocity coefficient of the actuator's own force.
        forces: limits of the actuator's force; infinite if there are none.
        slope: k.
        offset: c.
        low: smallest executed control.
        high: largest executed control.
    """

    index: int
    commands: tuple[float, float]
    gain: float
    bias: tuple[float, float, float]
    forces: tuple[float, float]
    slope: float
    offset: float
    low: float
    high: float

    @classmethod
    def of(cls, model: mujoco.MjModel, index: int) -> Drive | None:
        """Returns the drive of an actuator; None if its force is not a linear function of its control."""
        linear = model.actuator_gaintype[index] == _FIXED and model.actuator_biastype[index] in (_NONE, _AFFINE)
        if not linear or model.actuator_dyntype[index] != _STATELESS:
            return None
        clamped = model.actuator_ctrllimited[index] and not (
            model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        )
        commands = _interval(model.actuator_ctrlrange[index] if clamped else None)
        forces = _interval(model.actuator_forcerange[index] if model.actuator_forcelimited[index] else None)
        affine = model.actuator_biastype[index] == _AFFINE
        constant, position, velocity = model.actuator_biasprm[index][:3].tolist() if affine else (0.0, 0.0, 0.0)
        bias = (constant, position, velocity)
        gain = float(model.actuator_gainprm[index][0])
        return cls(index, commands, gain, bias, forces, slope=1.0, offset=0.0, low=commands[0], high=commands[1])

    def after(self, effect: ActionEffect) -> Drive | None:
        """Returns the drive with one more effect at its beginning; None if the actuator cannot hold it."""
        if isinstance(effect, ActionGain):
            drive = replace(self, slope=self.slope * effect.scale)
        elif isinstance(effect, ActionBias):
            drive = replace(self, offset=self.offset + self.slope * effect.bias)
        elif isinstance(effect, ActionSaturation):
            reach = abs(self.slope) * effect.limit if self.slope else 0.0
            ends = np.clip([self.offset - reach, self.offset + reach], self.low, self.high)
            drive = replace(self, low=float(ends[0]), high=float(ends[1]))
        else:
            return None
        return drive if drive._is_possible else None

    def write(self, spec: mujoco.MjSpec) -> None:
        """Writes gain, bias and limits of the force into the actuator of a specification."""
        actuator = spec.actuators[self.index]
        offset = self.offset if self.slope else float(np.clip(self.offset, self.low, self.high))
        actuator.gainprm[0] = self.gain * self.slope
        bias = (self.bias[0] + self.gain * offset, *self.bias[1:])
        if any(bias):
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.biasprm[:3] = bias
        if self._clamps:
            actuator.forcelimited, actuator.forcerange = _TRUE, self._clamped_forces

    @property
    def _clamps(self) -> bool:
        """Whether a command within its limits would be executed at the end of the executed range."""
        if not self.slope:
            return False  # a constant, which is clamped when it is written
        ends = sorted(self.slope * command + self.offset for command in self.commands)
        rounding = 1e-12 * max([1.0, *(abs(end) for end in (self.low, self.high) if math.isfinite(end))])
        return ends[0] < self.low - rounding or ends[1] > self.high + rounding

    @property
    def _clamped_forces(self) -> tuple[float, float]:
        ends = sorted(self.gain * control + self.bias[0] for control in (self.low, self.high))
        low, high = np.clip(ends, *self.forces)
        # MuJoCo wants two finite ends
        return float(np.clip(low, -1e10, 1e10)), float(np.clip(high, -1e10, 1e10))

    @property
    def _is_possible(self) -> bool:
        if not self._clamps:
            return True
        low, high = self._clamped_forces
        return not any(self.bias[1:]) and low < high


def _interval(ends: np.ndarray | None) -> tuple[float, float]:
    return (-math.inf, math.inf) if ends is None else (float(ends[0]), float(ends[1]))
