"""The measured data that ``close_the_loop.py`` reads: transitions, and what a log's columns say of them."""

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
    """Measured transitions as tracing takes them.

    Args:
        transitions: TED, ``[T]``.
        source: where they come from and which rows they are.
        columns: of a log, None for other data.
    """

    transitions: TensorDictBase
    source: str
    columns: LogColumns | None = None

    def coordinates(self, chosen: Mapping[str, str] | Sequence[str] | None) -> Mapping[str, str] | list[str]:
        """The coordinate of the model that each observation is, in the data's order, by the name of its column.

        Args:
            chosen: ``simulator.coordinates``: a list of them, a mapping of those columns that have another name, or
                None.

        Raises:
            ValueError: for a mapping of columns that there are not, or data whose columns have no names.
        """
        if isinstance(chosen, Sequence | ListConfig):
            return list(chosen)
        if self.columns is None:
            raise ValueError(
                f"{self.source} does not name its columns: say which coordinates of the model they are, such as "
                "simulator.coordinates=[hip,hip_velocity]"
            )
        names, other = self.columns.observation, dict(chosen or {})
        unknown = [column for column in other if column not in names]
        if unknown:
            raise ValueError(f"simulator.coordinates names {unknown[0]!r}, the log observes {', '.join(names)}")
        return {name: other.get(name, name) for name in names}

    def control_step(self) -> float:
        """The time between two rows, in s, as the log has it.

        Raises:
            ValueError: if the data do not say.
        """
        if self.columns is not None and self.columns.dt is not None:
            return self.columns.dt
        if "time" in self.transitions.keys():
            return float(torch.diff(self.transitions["time"].flatten()).median())
        raise ValueError(f"{self.source} does not say when its rows were taken: give simulator.control_step, in s")

    def check_actuators(self, model: mujoco.MjModel) -> None:
        """Complains of actions that go by the names of the model's actuators, but in another order.

        Raises:
            ValueError: naming the right order.
        """
        actions = [] if self.columns is None else list(self.columns.action)
        actuators = [model.actuator(i).name for i in range(model.nu)]
        if sorted(actions) == sorted(actuators) and actions != actuators:
            raise ValueError(
                f"the log's actions are {', '.join(actions)}, the model's actuators {', '.join(actuators)}: put "
                f"action: [{', '.join(actuators)}] into the columns' YAML"
            )


def read_recording(cfg: DictConfig) -> Recording:
    """Reads what ``data`` names and takes the rows that are asked for.

    Raises:
        ValueError: for rows that there are not, or data=recorded where there is nobody to record.
        torchrl_h2o.data.DataError: for data that cannot be read.
    """
    columns = None
    if cfg.data == RECORDED:
        if cfg.simulator.get("recorded") is None:
            raise ValueError("data=recorded is for the wheel-legged robot: name a data set, or a log and its columns")
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
            f"first_row={first} transitions={cfg.transitions} take nothing of the {len(transitions)} rows of {cfg.data}"
        )
    whole = last - first == len(transitions)
    rows = f"all {last} rows" if whole else f"rows {first} to {last - 1} of {len(transitions)}"
    return Recording(transitions[first:last], f"{cfg.data}, {rows}", columns)
