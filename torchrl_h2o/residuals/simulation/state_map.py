"""Maps between observations and the model's state, used to start simulations from measured rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

if TYPE_CHECKING:
    from gymnasium.envs.mujoco import MujocoEnv

# the random states that probe the observation and the hidden state; coordinates in m, rad, m/s or rad/s
_PROBE_SPREAD = 0.01  # standard deviation
_SPARE_PROBES = 4  # beyond those that determine a linear map; they test its linearity
# largest error of the linear map, in units of the observation; smaller coefficients become zero
_LINEAR_TOLERANCE = 1e-5
_FAR_STATE = 1e3  # coordinates at which the clipping of the observation is read
# the test for hidden state: displacement of an unobserved coordinate, number of states at which it is displaced, and
# the change of the next observation that makes it hidden state
_NUDGE, _NUM_NUDGED, _NUDGE_RESPONSE = 0.05, 8, 1e-6


@dataclass(frozen=True, eq=False)
class StateMap:
    """A linear map between observations and states (qpos, qvel).

    Args:
        names: names of the observations, (n,).
        units: units of the observations, (n,).
        observe: matrix (n, nq + nv); the observation is ``observe @ state``, clipped to ``clip``.
        restore: matrix (nq + nv, n); the state is ``offset + restore @ observation``. For hidden coordinates this is
            the value from which a simulation begins.
        offset: values of the unobserved coordinates, (nq + nv,); zero for observed ones.
        clip: smallest and largest reported value of each observation, (n, 2).
        hidden: indices of the unobserved coordinates that affect later observations. They are estimated by simulating
            the preceding steps.

    Examples:
        >>> import numpy as np
        >>> from torchrl_h2o.residuals import StateMap
        >>> pendulum = StateMap.of_coordinates(("angle", "rate"), ("rad", "rad/s"), (0, 1), num_states=2)
        >>> pendulum.states(np.array([[0.5, -1.0]]))
        array([[ 0.5, -1. ]])
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    observe: np.ndarray
    restore: np.ndarray
    offset: np.ndarray
    clip: np.ndarray
    hidden: tuple[int, ...] = ()

    @classmethod
    def of_coordinates(
        cls, names: Sequence[str], units: Sequence[str], indices: Sequence[int], num_states: int
    ) -> StateMap:
        """Builds the map of observations that each equal one coordinate of the state.

        Args:
            names: names of the observations, (n,).
            units: units of the observations, (n,).
            indices: index of each observation in (qpos, qvel), (n,).
            num_states: nq + nv.
        """
        observe = np.zeros((len(names), num_states))
        observe[np.arange(len(names)), indices] = 1.0
        clip = np.tile([-np.inf, np.inf], (len(names), 1))
        return cls(tuple(names), tuple(units), observe, observe.T.copy(), np.zeros(num_states), clip)

    @cached_property
    def restore_observed(self) -> np.ndarray:
        """The matrix ``restore`` with zeros for hidden coordinates, which a single reading does not change."""
        restore = self.restore.copy()
        restore[list(self.hidden)] = 0.0
        return restore

    def states(self, observations: np.ndarray) -> np.ndarray:
        """Returns the states (..., nq + nv) of observations (..., n)."""
        return self.offset + observations @ self.restore.T

    def observations(self, states: np.ndarray) -> np.ndarray:
        """Returns the observations (..., n) of states (..., nq + nv), without clipping."""
        return states @ self.observe.T

    def clipped(self, observations: np.ndarray) -> np.ndarray:
        """Returns which rows (...) of observations (..., n) contain a clipped value."""
        low, high = self.clip.T
        return ((observations <= low) | (observations >= high)).any(-1)


def coordinate_names(model: mujoco.MjModel) -> tuple[list[str], list[str]]:
    """Returns names and units of every coordinate of (qpos, qvel), derived from the joints.

    A joint's position has the joint's name, its velocity the name with ``_velocity`` appended.
    """
    positions, velocities, position_units, velocity_units = [], [], [], []
    for index in range(model.njnt):
        name, kind = model.joint(index).name or f"joint_{index}", model.jnt_type[index]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            positions += [f"{name}_{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")]
            position_units += ["m"] * 3 + ["1"] * 4
            velocities += [f"{name}_{axis}_velocity" for axis in ("x", "y", "z", "roll", "pitch", "yaw")]
            velocity_units += ["m/s"] * 3 + ["rad/s"] * 3
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            positions += [f"{name}_{axis}" for axis in ("qw", "qx", "qy", "qz")]
            position_units += ["1"] * 4
            velocities += [f"{name}_{axis}_velocity" for axis in ("roll", "pitch", "yaw")]
            velocity_units += ["rad/s"] * 3
        else:
            unit = "rad" if kind == mujoco.mjtJoint.mjJNT_HINGE else "m"
            positions.append(name)
            position_units.append(unit)
            velocities.append(f"{name}_velocity")
            velocity_units.append(f"{unit}/s")
    return positions + velocities, position_units + velocity_units


def probe_gymnasium(task: MujocoEnv, rng: np.random.Generator) -> StateMap:
    """Determines the state map of a Gymnasium MuJoCo task from its observations in random states.

    A task may define an attribute ``hidden_state``, which gives usual values of unobserved velocities as linear
    functions of observed coordinates: ``{joint: {observed coordinate: factor}}``.

    Args:
        task: the task; its state is restored afterwards.
        rng: generator of the random states.

    Returns:
        The map.

    Raises:
        ValueError: if the observation is not linear in the state.
    """
    model = task.model
    num_states = model.nq + model.nv
    before = task.data.qpos.copy(), task.data.qvel.copy()
    states = _PROBE_SPREAD * rng.standard_normal((num_states + 1 + _SPARE_PROBES, num_states))
    observed = np.array([_observation(task, state) for state in states], dtype=np.float64)
    design = np.hstack([states, np.ones((len(states), 1))])
    solution = np.linalg.lstsq(design, observed, rcond=None)[0]
    error = np.abs(design @ solution - observed).max()
    far = _FAR_STATE * np.ones((2, num_states)) * np.array([[-1.0], [1.0]])
    clip = np.array([_observation(task, state) for state in far], dtype=np.float64).T
    task.set_state(*before)
    observe = solution[:-1].T
    observe[np.abs(observe) < _LINEAR_TOLERANCE] = 0.0
    one_each = (np.abs(observe) > 0).sum(1) == 1
    if max(error, np.abs(solution[-1]).max()) > _LINEAR_TOLERANCE or not one_each.all():
        raise ValueError(
            f"the observation of {type(task).__name__} does not consist of single coordinates of qpos and qvel, so it "
            "cannot be converted to a state. Give the simulation a StateMap of your own"
        )
    indices = np.abs(observe).argmax(1)
    names, units = coordinate_names(model)
    found = StateMap.of_coordinates(
        [names[i] for i in indices], [units[i] for i in indices], indices.tolist(), num_states
    )
    offset = np.concatenate([task.init_qpos, np.zeros(model.nv)])
    offset[indices] = 0.0
    restore = found.restore.copy()
    for joint, factors in getattr(task, "hidden_state", {}).items():
        for coordinate, factor in factors.items():
            restore[names.index(joint), found.names.index(coordinate)] = factor
    unclipped = np.sort(far[:, indices].T, axis=1)
    clip = np.where(np.abs(clip) < np.abs(unclipped), clip, unclipped * np.inf)
    return StateMap(found.names, found.units, found.observe, restore, offset, clip)


def _observation(task: Any, state: np.ndarray) -> np.ndarray:
    task.set_state(state[: task.model.nq], state[task.model.nq :])
    return task._get_obs()


def hidden_coordinates(
    state_map: StateMap,
    num_actuators: int,
    rollout: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[int, ...]:
    """Returns the indices of the unobserved coordinates that change the next observation when they are moved.

    For example, the distance that HalfCheetah has run is not observed, and it changes no later observation. The depth
    to which the wheels of a robot sink into the floor is not observed either, but it changes later observations.

    Args:
        state_map: the map between observations and states.
        num_actuators: nu, the size of the action.
        rollout: steps states (B, nq + nv) under actions (B, H, nu) to states (B, H, nq + nv).
    """
    unobserved = np.flatnonzero(~state_map.observe.any(0))
    size = (_NUM_NUDGED, len(state_map.offset))
    states = state_map.offset + _PROBE_SPREAD * np.random.default_rng(0).standard_normal(size)
    still = np.zeros((len(states), 1, num_actuators))

    def observed(moved: np.ndarray) -> np.ndarray:
        return state_map.observations(rollout(moved, still))

    base = observed(states)
    hidden = []
    for index in unobserved:
        moved = states.copy()
        moved[:, index] += _NUDGE
        own = _NUDGE * state_map.observe[:, index]
        if np.abs(observed(moved) - base - own).max() > _NUDGE_RESPONSE:
            hidden.append(int(index))
    return tuple(hidden)
