"""Reads the measured data of ``close-the-loop``: transitions and, for a log, the description of its columns."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import cast

import hydra
import mujoco
import torch
from omegaconf import DictConfig, ListConfig
from tensordict import TensorDictBase

from torchrl_h2o.commands.other_simulator import is_model, record_simulator
from torchrl_h2o.data import LogColumns, load, sources_of
from torchrl_h2o.data.audit.log import find_turning
from torchrl_h2o.data.readers.observed import EstimatedVelocity, estimated_velocities
from torchrl_h2o.data.readers.quaternion_signs import continuous_quaternions
from torchrl_h2o.data.readers.sources import One, Source, is_log, names_of, unique, words_of
from torchrl_h2o.data.readers.units import to_si
from torchrl_h2o.residuals.measured.transitions import HELD_OUT
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.training.real_data import RECORDED
from torchrl_h2o.training.task import Task


@dataclass(frozen=True)
class Recording:
    """Measured transitions and their origin.

    Args:
        transitions: TED, batch size (T,), with ``log`` (T,), int64: the index of each transition's log in ``logs``. The
            last transition of each log is done. Logs that are held out by name come last.
        source: name of the data and the range of the selected rows.
        columns: description of the log's columns; None if the data are not a log.
        logs: names of the logs, or of the data set.
        held_out: what neither a fit nor a choice uses: a share of the transitions, from the end, or the names of logs.
    """

    transitions: TensorDictBase
    source: str
    columns: LogColumns | None = None
    logs: tuple[str, ...] = ()
    held_out: float | tuple[str, ...] = HELD_OUT

    @property
    def reported_on(self) -> float | tuple[int, ...]:
        """What errors are reported on: a share of the transitions, from the end, or the indices of logs."""
        if not isinstance(self.held_out, tuple):
            return self.held_out
        return tuple(self.logs.index(name) for name in self.held_out)

    @property
    def estimated(self) -> tuple[EstimatedVelocity, ...]:
        """Observed velocities that were not measured but estimated from positions."""
        return () if self.columns is None else estimated_velocities(self.transitions, self.columns)

    @property
    def action_units(self) -> tuple[str, ...]:
        """Units of the actions in the data, SI; empty if the data are not a log."""
        if self.columns is None:
            return ()
        units = {column.name: to_si(column.unit)[0] for column in self.columns.columns}
        return tuple(units[name] for name in self.columns.action)

    def for_simulation(self, simulation: Simulation) -> Recording:
        """Returns the recording as a simulation has it.

        A free motion gets the model's actuators at zero. Quaternions get a continuous sign, which is the same rotation.
        """
        model, transitions = simulation.model, self.transitions.clone(recurse=False)
        if self.columns is not None and self.columns.free_motion:
            transitions["action"] = torch.zeros(len(transitions), model.nu)
        if transitions["observation"].shape[-1] == len(simulation.state_map.names):
            for body in find_turning(simulation.state_map, model):
                transitions = continuous_quaternions(transitions, body.quaternion)
        return replace(self, transitions=transitions)

    def coordinates(self, chosen: Mapping[str, str] | Sequence[str] | None) -> Mapping[str, str] | list[str]:
        """Maps each observed column, in the data's order, to a coordinate of the model.

        Args:
            chosen: ``simulator.coordinates``: a list of coordinates; a mapping from column to coordinate, for those
                that the description of the columns does not tell; or None.

        Returns:
            The list itself, or a mapping from columns to coordinates.

        Raises:
            ValueError: if the mapping contains a column that the log does not observe, or the columns have no names.
        """
        if isinstance(chosen, Sequence | ListConfig):
            return list(chosen)
        if self.columns is None:
            raise ValueError(
                f"{self.source} does not name its columns; list the model coordinate of each column, such as "
                "simulator.coordinates=[hip,hip_velocity]"
            )
        names, found = self.columns.observation, self.columns.coordinates
        for key, coordinate in (chosen or {}).items():
            if str(key) not in names:
                raise ValueError(f"simulator.coordinates names {key!r}, but the log observes {', '.join(names)}")
            found[str(key)] = coordinate
        return found

    def control_step(self) -> float:
        """Time between two rows, in s, from the description of the columns or from the time stamps.

        Raises:
            ValueError: if neither is available.
        """
        if self.columns is not None and (step := self.columns.resample or self.columns.dt) is not None:
            return step
        if "time" in self.transitions.keys():
            return float(torch.diff(self.transitions["time"].flatten()).median())
        raise ValueError(f"{self.source} has no time stamps; give simulator.control_step, in s")

    def check_actuators(self, model: mujoco.MjModel) -> None:
        """Checks that the log's actions are in the order of the model's actuators, if both have the same names.

        Raises:
            ValueError: if the order differs.
        """
        actions = [] if self.columns is None else list(self.columns.action)
        actuators = [model.actuator(i).name for i in range(model.nu)]
        if sorted(actions) == sorted(actuators) and actions != actuators:
            raise ValueError(
                f"the log's actions are {', '.join(actions)}, but the model's actuators are {', '.join(actuators)}; "
                f"write action: [{', '.join(actuators)}] in the YAML file of the columns"
            )


def read_recording(cfg: DictConfig) -> Recording:
    """Reads the data given in the configuration and selects rows, of each log separately.

    Args:
        cfg: configuration with ``data``, ``columns``, ``simulator``, ``held_out``, ``first_row`` and ``transitions``.

    Raises:
        ValueError: if no row of a log is selected, a log to hold out is not there, all logs are held out, or
            data=recorded is given for a simulator without a recording controller.
        torchrl_h2o.data.DataError: if the data cannot be read.
    """
    columns, held_out = None, cfg.held_out
    if cfg.data == RECORDED:
        if cfg.simulator.get("recorded") is None:
            raise ValueError("data=recorded requires the wheel-legged robot; name a data set, or a log and its columns")
        if not isinstance(held_out, float | int):
            raise ValueError(f"held_out={words_of(held_out)}: data=recorded is one run; give a share, such as 0.3")
        recorded = hydra.compose("recorded", [f"env={cfg.simulator.recorded}"])
        transitions, logs = Task.from_config(recorded.env).read_real_data(RECORDED), (RECORDED,)
    elif is_model(cfg.data):
        if "path" not in cfg.simulator or not isinstance(held_out, float | int):
            raise ValueError(
                f"data={cfg.data} is a second simulator: give simulator=robot.xml, and a share to hold out"
            )
        transitions, columns = record_simulator(cfg.data, cfg.simulator.path, cfg.simulator.control_step, cfg.seed)
        logs = (Path(cfg.data).name,)
    else:
        sources, held_out = split_by_name(cfg.data, held_out)
        logs = names_of(sources)
        name = cfg.columns or (cfg.simulator.get("columns") if is_log(sources) else None)
        columns = None if name is None else LogColumns.load(name)
        transitions = load(sources, columns=columns, task=cfg.simulator.get("task"))
    if "log" not in transitions.keys():
        transitions["log"] = torch.zeros(len(transitions), dtype=torch.int64)
    count = len(transitions)
    transitions, (first, last) = _selected(transitions, logs, cfg)
    if len(transitions) == count:
        rows = f"all {count} rows"
    elif len(logs) == 1:
        rows = f"rows {first} to {last - 1} of {count}"
    else:
        rows = f"{len(transitions)} of {count} rows, from row {first} of each"
    if columns is not None and columns.resample is not None:
        rows = f"{rows}, resampled to steps of {columns.resample:g} s"
    if isinstance(held_out, tuple):
        rows = f"{rows}; held out: {', '.join(held_out)}"
    return Recording(transitions, f"{words_of(cfg.data)}, {rows}", columns, logs, held_out)


def split_by_name(
    data: Source, held_out: float | str | Sequence[str]
) -> tuple[tuple[One, ...], float | tuple[str, ...]]:
    """Finds the logs of a recording, those held out at the end.

    Args:
        data: the sources of the data, see :func:`torchrl_h2o.data.sources_of`.
        held_out: a share of the rows, or sources; these may be among the data, by name or path, or further ones.

    Returns:
        All sources, and the share or the names of the sources that are held out, as in ``Recording.logs``.

    Raises:
        ValueError: for a source to hold out that is not there, or if nothing is left for the fit.
    """
    sources = list(sources_of(data))
    if isinstance(held_out, float | int):
        return tuple(sources), held_out
    chosen: list[One] = []
    for name in [held_out] if isinstance(held_out, str) else held_out:
        among = [one for one in sources if str(name) == str(one) or fnmatchcase(Path(one).name, str(name))]
        if not among and not Path(name).exists() and not any(sign in str(name) for sign in "*?["):
            logs = ", ".join(names_of(sources))
            raise ValueError(f"held_out={name}: there is no such file, and the data are {logs}")
        chosen += among or sources_of(name)
    apart = {os.path.abspath(one) for one in chosen}
    fitted = [one for one in sources if os.path.abspath(one) not in apart]
    if not fitted:
        raise ValueError(f"held_out={words_of(held_out)} leaves no log for the fit; name fewer")
    together = (*fitted, *unique(chosen))
    return together, names_of(together)[len(fitted) :]


def _selected(
    transitions: TensorDictBase, logs: Sequence[str], cfg: DictConfig
) -> tuple[TensorDictBase, tuple[int, int]]:
    """Selects ``transitions`` consecutive rows of each log from ``first_row`` on; also returns the largest range."""
    first, parts, most = cfg.first_row, [], 0
    for index, log in enumerate(logs):
        rows = cast("TensorDictBase", transitions[transitions["log"] == index])
        last = len(rows) if cfg.transitions is None else min(len(rows), first + cfg.transitions)
        if not 0 <= first < last:
            raise ValueError(
                f"first_row={first} transitions={cfg.transitions} select none of the {len(rows)} rows of {log}"
            )
        part, most = cast("TensorDictBase", rows[first:last]), max(most, last)
        following = cast("TensorDictBase", part["next"])
        following["truncated"][-1] |= ~following["terminated"][-1]
        following["done"][-1] = True
        parts.append(part)
    return cast("TensorDictBase", torch.cat(parts)), (first, most)
