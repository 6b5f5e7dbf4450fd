"""Readers of measured data, and a replay buffer of real and simulated transitions.

Every reader returns a flat TensorDict in TorchRL's episode data format (TED) with float32 numbers; :func:`load`
selects the reader.
"""

from torchrl_h2o.data.audit import Audit, Finding, audit
from torchrl_h2o.data.hybrid_replay import HybridReplayBuffer
from torchrl_h2o.data.multi_step import with_next_actions
from torchrl_h2o.data.paired_transitions import PairedTransitions
from torchrl_h2o.data.readers.d4rl import read_d4rl
from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.load import load
from torchrl_h2o.data.readers.log_columns import Column, LogColumns
from torchrl_h2o.data.readers.memory_map import read_ted, write_ted
from torchrl_h2o.data.readers.minari_dataset import read_minari, write_minari
from torchrl_h2o.data.readers.robot_log import read_robot_log
from torchrl_h2o.data.readers.sources import sources_of
from torchrl_h2o.data.readers.specs import check_specs
from torchrl_h2o.data.readers.ted import episodes

__all__ = [
    "Audit",
    "Column",
    "DataError",
    "Finding",
    "HybridReplayBuffer",
    "LogColumns",
    "PairedTransitions",
    "audit",
    "check_specs",
    "episodes",
    "load",
    "read_d4rl",
    "read_minari",
    "read_robot_log",
    "read_ted",
    "sources_of",
    "with_next_actions",
    "write_minari",
    "write_ted",
]
