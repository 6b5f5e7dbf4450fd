"""Activations of actuators whose command passes a filter of first order, such as many servos, from the commands.

A log holds no activations. That of a filter follows from the commands before, so it is computed.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.signal import lfilter

_FILTERS = (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
_RK4 = mujoco.mjtIntegrator.mjINT_RK4


def settled_activations(model: mujoco.MjModel, actions: np.ndarray) -> np.ndarray:
    """Activations after the same actions for a long time.

    Args:
        model: the model.
        actions: executed actions, (..., nu).

    Returns:
        The activations, (..., na).
    """
    settled = np.zeros((*actions.shape[:-1], model.na))
    for actuator, place in _stateful(model):
        settled[..., place] = _bounded(model, actuator, _commands(model, actuator, actions))
    return settled


def activations_along(model: mujoco.MjModel, actions: np.ndarray, physics_steps: int) -> np.ndarray:
    """Activations before each action of one recorded run, which begins settled at its first action.

    Args:
        model: the model.
        actions: executed actions, (T, nu).
        physics_steps: physics steps per action.

    Returns:
        The activations, (T, na).

    Examples:
        >>> servo = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><body><joint name="hinge"/><geom size="1"/>
        ...   </body></worldbody><actuator><position joint="hinge" timeconst="0.1"/></actuator></mujoco>''')
        >>> activations_along(servo, np.array([[0.0], [1.0], [1.0]]), physics_steps=50).round(3).tolist()
        [[0.0], [0.0], [0.632]]
    """
    along = np.zeros((len(actions), model.na))
    if not len(actions):
        return along
    start = settled_activations(model, actions[0])
    for actuator, place in _stateful(model):
        commands = _commands(model, actuator, actions)[:-1]
        along[0, place] = start[place]
        along[1:, place] = _after(model, actuator, commands, start[place], physics_steps)
    return along


def actuators_of_unknown_activation(model: mujoco.MjModel) -> list[str]:
    """Names of the actuators whose activation the commands do not tell: all but filters that act on every command.

    An integrator's activation also depends on its value when the log began.
    """
    return [
        model.actuator(actuator).name or str(actuator)
        for actuator, _ in _stateful(model)
        if _dynamics(model, actuator) not in _FILTERS
        or model.actuator_actnum[actuator] != 1
        or model.actuator_delay[actuator] > 0.0
        or _is_disabled(model, actuator)
    ]


def _is_disabled(model: mujoco.MjModel, actuator: int) -> bool:
    all_of_them = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION
    group = int(model.actuator_group[actuator])
    return bool(all_of_them or (0 <= group < 31 and model.opt.disableactuator >> group & 1))


def _stateful(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Index of each actuator with an activation, and the activation's place."""
    return [(i, int(model.actuator_actadr[i])) for i in range(model.nu) if model.actuator_actadr[i] >= 0]


def _dynamics(model: mujoco.MjModel, actuator: int) -> mujoco.mjtDyn:
    return mujoco.mjtDyn(int(model.actuator_dyntype[actuator]))


def _commands(model: mujoco.MjModel, actuator: int, actions: np.ndarray) -> np.ndarray:
    """An actuator's commands (...), clamped to its control range, as MuJoCo does."""
    commands = actions[..., actuator]
    if not model.actuator_ctrllimited[actuator] or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return commands
    return np.clip(commands, *model.actuator_ctrlrange[actuator])


def _bounded(model: mujoco.MjModel, actuator: int, activation: np.ndarray) -> np.ndarray:
    limited = model.actuator_actlimited[actuator]
    return np.clip(activation, *model.actuator_actrange[actuator]) if limited else activation


def _after(model: mujoco.MjModel, actuator: int, commands: np.ndarray, start: float, physics_steps: int) -> np.ndarray:
    """Activation after each command, (T,): a linear recursion, unless it is cut at its bounds."""
    keeps = (1.0 - _share_of_step(model, actuator)) ** physics_steps
    takes = 1.0 - keeps
    if not model.actuator_actlimited[actuator]:
        return lfilter([takes], [1.0, -keeps], commands, zi=[keeps * start])[0]
    after, activation = np.empty(len(commands)), start
    for row, command in enumerate(commands):
        after[row] = activation = float(_bounded(model, actuator, keeps * activation + takes * command))
    return after


def _share_of_step(model: mujoco.MjModel, actuator: int) -> float:
    """Share of the difference to the command by which an activation comes closer in one physics step."""
    ratio = model.opt.timestep / max(float(model.actuator_dynprm[actuator, 0]), mujoco.mjMINVAL)
    exact = _dynamics(model, actuator) == mujoco.mjtDyn.mjDYN_FILTEREXACT
    share = 1.0 - np.exp(-ratio) if exact else ratio
    if model.opt.integrator == _RK4:  # the rate is a mean over the step
        share *= 1.0 - ratio / 2.0 + ratio**2 / 6.0 - ratio**3 / 24.0
    return float(share)
