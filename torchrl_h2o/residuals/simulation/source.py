"""Reads simulators: from a TorchRL env, or from an MJCF or URDF file with the names of its observed coordinates."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from torchrl import torchrl_logger
from torchrl.envs import EnvBase

from torchrl_h2o.effects import Effect
from torchrl_h2o.effects.effect import checked_effects
from torchrl_h2o.envs.backends.gymnasium import GymnasiumBackend
from torchrl_h2o.envs.mujoco_model import find_backend
from torchrl_h2o.residuals.simulation.model_file import read_model, read_spec
from torchrl_h2o.residuals.simulation.state_map import StateMap, coordinate_names, probe_gymnasium

# share of the control step by which a recording's may differ from a multiple of the model's timestep
CLOCK_TOLERANCE = 0.01
# physics steps between two rows of a log above which the control step is in another unit; at 2 ms they take 200 s
MAX_PHYSICS_STEPS = 100_000


class SimulatorSource(NamedTuple):
    """A model, its control step, its observation and its effects, as read from an env or a file.

    Args:
        spec: returns the model's specification, parsed anew at each call.
        frame_skip: physics steps per control step.
        state_map: the map between observations and states, hidden coordinates not yet marked.
        effects: the effects in the simulator, in their order.
        name: the name for reports.
    """

    spec: Callable[[], mujoco.MjSpec]
    frame_skip: int
    state_map: StateMap
    effects: tuple[Effect, ...]
    name: str


def source_of_env(env: EnvBase) -> SimulatorSource:
    """Reads the simulator inside an env, with its dynamics gaps; see :meth:`Simulation.from_env`.

    Args:
        env: a GymEnv of a MuJoCo task, with or without transforms.

    Raises:
        ValueError: if the env is no Gymnasium MuJoCo task or its observation is not linear in the state.
    """
    backend = find_backend(env)
    if not isinstance(backend, GymnasiumBackend):
        raise ValueError(
            f"{env} is no Gymnasium task, so the map from its state to its observation is unknown; use "
            "Simulation.from_mjcf with a StateMap"
        )
    task = backend.owner
    return SimulatorSource(
        spec=backend.spec,
        frame_skip=round(backend.control_step / backend.model.opt.timestep),
        state_map=probe_gymnasium(task, np.random.default_rng(0)),
        effects=tuple(effect for effects in backend.gaps.values() for effect in effects),
        name=task.spec.id if task.spec is not None else type(task).__name__,
    )


def source_of_mjcf(
    path: str | Path,
    state_map: StateMap | Mapping[str, str] | Sequence[str],
    control_step: float,
    effects: Sequence[Effect] = (),
) -> SimulatorSource:
    """Reads the simulator of an MJCF or URDF file; see :meth:`Simulation.from_mjcf`.

    Args:
        path: the file.
        state_map: a map; or the observed coordinates, in the order of the data; or, for data with other
            column names, the coordinate of each column: ``{"theta": "pitch", "theta_dot": "pitch_velocity"}``.
        control_step: the time between two rows of the data, in s.
        effects: effects to put into the simulator.

    Raises:
        TypeError: for effects that are none.
        ValueError: for a file that is not a model with joints, names that the model does not have, no names, or a
            control step that is not a time between two rows.
    """
    path, effects = Path(path), checked_effects(effects)
    model = read_model(path)
    frame_skip, timestep = _steps(control_step, model.opt.timestep, path)

    def spec() -> mujoco.MjSpec:
        parsed = read_spec(path)
        parsed.option.timestep = timestep
        return parsed

    if not isinstance(state_map, StateMap):
        state_map = _map_of(state_map, model, path)
    elif state_map.observe.shape[1] != model.nq + model.nv:
        raise ValueError(
            f"the state map is for {state_map.observe.shape[1]} coordinates, {path} has {model.nq} positions and "
            f"{model.nv} velocities"
        )
    return SimulatorSource(spec, frame_skip, state_map, effects, path.stem)


def _map_of(coordinates: Mapping[str, str] | Sequence[str], model: mujoco.MjModel, path: Path) -> StateMap:
    """Builds the map of the observed coordinates; unobserved ones keep the value of the model's initial pose.

    A column with a name of its own is called by both names, such as ``elbow (pos_meas2)``, in reports and findings.
    """
    names, units = coordinate_names(model)
    if isinstance(coordinates, str) or not len(coordinates):
        raise ValueError(f"{coordinates!r} names no observed coordinates; give a list of some of {', '.join(names)}")
    columns = list(coordinates)
    chosen = [coordinates[column] for column in columns] if isinstance(coordinates, Mapping) else columns
    for coordinate in chosen:
        if coordinate not in names:
            close = get_close_matches(str(coordinate), names, 1)
            like = close[0] if close else names[0]
            raise ValueError(
                f"{path} has no coordinate {coordinate!r}{f', but {close[0]!r}' if close else ''}: it has "
                f"{', '.join(names)}. Map each column with another name to its coordinate: "
                f"{{{coordinate!r}: {like!r}}}, on the command line 'simulator.coordinates={{{coordinate}: {like}}}'"
            )
    twice = {coordinate for coordinate in chosen if chosen.count(coordinate) > 1}
    if twice:
        raise ValueError(f"{', '.join(sorted(twice))} is named twice; name each coordinate once")
    indices = [names.index(coordinate) for coordinate in chosen]
    both = [name if name == column else f"{name} ({column})" for name, column in zip(chosen, columns, strict=True)]
    found = StateMap.of_coordinates(both, [units[i] for i in indices], indices, len(names))
    found.offset[: model.nq] = model.qpos0
    found.offset[indices] = 0.0
    return found


def _steps(control_step: Any, timestep: float, path: Path) -> tuple[int, float]:
    """Physics steps per control step, and the timestep: the file's, or the next smaller one that fits the log."""
    if isinstance(control_step, bool | str) or not 0.0 < control_step < math.inf:
        raise ValueError(
            f"a control step of {control_step!r} is not possible; give the time between two rows in s, such as 0.005"
        )
    if control_step > MAX_PHYSICS_STEPS * timestep:
        raise ValueError(
            f"a control step of {control_step:g} s takes more than {MAX_PHYSICS_STEPS} of {path}'s steps of "
            f"{timestep:g} s; give the time between two rows in s, not in ms or ns"
        )
    frame_skip = round(control_step / timestep)
    if frame_skip >= 1 and abs(frame_skip * timestep - control_step) <= CLOCK_TOLERANCE * control_step:
        return frame_skip, timestep
    frame_skip = math.ceil(control_step / timestep)
    torchrl_logger.info(
        f"{path}: {frame_skip} steps of {control_step / frame_skip:.6g} s between two rows of the log, which are "
        f"{control_step:.6g} s apart, instead of steps of {timestep:g} s"
    )
    return frame_skip, control_step / frame_skip
