"""Reads an MJCF file, the names of its observed coordinates and its control step into a simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import mujoco
from torchrl import torchrl_logger

from torchrl_h2o.effects import Effect, compile_model
from torchrl_h2o.residuals.simulation.settings import SIMULATION_SETTINGS, SimulationSettings
from torchrl_h2o.residuals.simulation.source import SimulatorSource
from torchrl_h2o.residuals.simulation.state_map import StateMap, coordinate_names


def source_of_mjcf(
    path: str | Path,
    state_map: StateMap | Mapping[str, str] | Sequence[str],
    control_step: float,
    effects: Sequence[Effect] = (),
    settings: SimulationSettings = SIMULATION_SETTINGS,
) -> SimulatorSource:
    """Reads the simulator of an MJCF file; see :meth:`Simulation.from_mjcf`.

    Args:
        path: the file.
        state_map: a map; or the observed coordinates, in the order of the data; or, for data with other
            column names, the coordinate of each column: ``{"theta": "pitch", "theta_dot": "pitch_velocity"}``.
        control_step: the time between two rows of the data, in s.
        effects: effects to put into the simulator.
        settings: the tolerance of the control step.

    Raises:
        ValueError: for a file that is not a model, names that the model does not have, or a control step that is not
            positive.
    """
    path = Path(path)
    model = _compiled(path)
    frame_skip, timestep = _steps(control_step, model.opt.timestep, settings.clock_tolerance, path)

    def spec() -> mujoco.MjSpec:
        parsed = mujoco.MjSpec.from_file(str(path))
        parsed.option.timestep = timestep
        return parsed

    if not isinstance(state_map, StateMap):
        state_map = _map_of(state_map, model, path)
    elif state_map.observe.shape[1] != model.nq + model.nv:
        raise ValueError(
            f"the state map is for {state_map.observe.shape[1]} coordinates, {path} has {model.nq} positions and "
            f"{model.nv} velocities"
        )
    return SimulatorSource(spec, frame_skip, state_map, tuple(effects), path.stem)


def _compiled(path: Path) -> mujoco.MjModel:
    if not path.is_file():
        raise ValueError(f"there is no file {path}; give the path of an MJCF file")
    try:
        return compile_model(mujoco.MjSpec.from_file(str(path)))
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot make a model of {path}: {error}") from error


def _map_of(coordinates: Mapping[str, str] | Sequence[str], model: mujoco.MjModel, path: Path) -> StateMap:
    """Builds the map of the observed coordinates; unobserved ones keep the value of the model's initial pose.

    A column with a name of its own is called by both names, such as ``elbow (pos_meas2)``, in reports and findings.
    """
    columns = list(coordinates)
    chosen = [coordinates[column] for column in columns] if isinstance(coordinates, Mapping) else columns
    names, units = coordinate_names(model)
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


def _steps(control_step: float, timestep: float, tolerance: float, path: Path) -> tuple[int, float]:
    """Physics steps per control step, and the timestep: the file's, or the next smaller one that fits the log."""
    if not control_step > 0.0:
        raise ValueError(f"a control step of {control_step:g} s is not possible; give the time between two rows")
    frame_skip = round(control_step / timestep)
    if frame_skip >= 1 and abs(frame_skip * timestep - control_step) <= tolerance * control_step:
        return frame_skip, timestep
    frame_skip = math.ceil(control_step / timestep)
    torchrl_logger.info(
        f"{path}: {frame_skip} steps of {control_step / frame_skip:.6g} s between two rows of the log, which are "
        f"{control_step:.6g} s apart, instead of steps of {timestep:g} s"
    )
    return frame_skip, control_step / frame_skip
