"""Measured data in, hybrid real and simulated replay out.

Readers return one flat TED TensorDict of float32; :func:`load` picks the reader.
"""

from torchrl_h2o.data.d4rl import read_d4rl
from torchrl_h2o.data.error import DataError
from torchrl_h2o.data.hybrid_replay import HybridReplayBuffer
from torchrl_h2o.data.load import load
from torchrl_h2o.data.log_columns import Column, LogColumns
from torchrl_h2o.data.memory_map import read_ted, write_ted
from torchrl_h2o.data.minari_dataset import read_minari, write_minari
from torchrl_h2o.data.population_replay import PopulationReplay
from torchrl_h2o.data.robot_log import read_robot_log
from torchrl_h2o.data.specs import check_specs
from torchrl_h2o.data.ted import episodes

__all__ = [
    "Column",
    "DataError",
    "HybridReplayBuffer",
    "LogColumns",
    "PopulationReplay",
    "check_specs",
    "episodes",
    "load",
    "read_d4rl",
    "read_minari",
    "read_robot_log",
    "read_ted",
    "write_minari",
    "write_ted",
]
