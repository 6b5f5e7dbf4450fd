"""Reads the measured data of ``close-the-loop``: transitions and, for a log, the description of its columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import hydra
import mujoco
import torch
from omegaconf import DictConfig, ListConfig
from tensordict import TensorDictBase

from torchrl_h2o.data import LogColumns, load
from torchrl_h2o.training.real_data import RECORDED
from torchrl_h2o.training.task import Task


@dataclass(frozen=True)
class Recording:
    """Measured transitions and their origin.

    Args:
        transitions: TED, batch size (T,).
        source: name of the data and the range of the selected rows.
        columns: description of the log's columns; None if the data are not a log.
    """

    transitions: TensorDictBase
    source: str
    columns: LogColumns | None = None

    def coordinates(self, chosen: Mapping[str, str] | Sequence[str] | None) -> Mapping[str, str] | list[str]:
        """Maps each observed column, in the data's order, to a coordinate of the model.

        Args:
            chosen: ``simulator.coordinates``: a list of coordinates; a mapping from column to coordinate, for the
                columns whose name differs from the coordinate's; or None.

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
        names, other = self.columns.observation, dict(chosen or {})
        unknown = [column for column in other if column not in names]
        if unknown:
            raise ValueError(f"simulator.coordinates names {unknown[0]!r}, but the log observes {', '.join(names)}")
        return {name: other.get(name, name) for name in names}

    def control_step(self) -> float:
        """Time between two rows, in s, from the description of the columns or from the time stamps.

        Raises:
            ValueError: if neither is available.
        """
        if self.columns is not None and self.columns.dt is not None:
            return self.columns.dt
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
    """Reads the data given in the configuration and selects rows.

    Args:
        cfg: configuration with ``data``, ``columns``, ``simulator``, ``first_row`` and ``transitions``.

    Raises:
        ValueError: if no row is selected, or data=recorded is given for a simulator without a recording controller.
        torchrl_h2o.data.DataError: if the data cannot be read.
    """
    columns = None
    if cfg.data == RECORDED:
        if cfg.simulator.get("recorded") is None:
            raise ValueError("data=recorded requires the wheel-legged robot; name a data set, or a log and its columns")
        recorded = hydra.compose("recorded", [f"env={cfg.simulator.recorded}"])
        transitions = Task.from_config(recorded.env).read_real_data(RECORDED)
    else:
        is_log = Path(cfg.data).is_file() and Path(cfg.data).suffix not in (".hdf5", ".h5")
        name = cfg.columns or (cfg.simulator.get("columns") if is_log else None)
        columns = None if name is None else LogColumns.load(name)
        transitions = load(cfg.data, columns=columns, task=cfg.simulator.get("task"))
    first, last = cfg.first_row, len(transitions)
    if cfg.transitions is not None:
        last = min(last, first + cfg.transitions)
    if not 0 <= first < last:
        raise ValueError(
            f"first_row={first} transitions={cfg.transitions} select none of the {len(transitions)} rows of {cfg.data}"
        )
    whole = last - first == len(transitions)
    rows = f"all {last} rows" if whole else f"rows {first} to {last - 1} of {len(transitions)}"
    return Recording(transitions[first:last], f"{cfg.data}, {rows}", columns)
