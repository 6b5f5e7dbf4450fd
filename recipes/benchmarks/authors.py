"""The update of the authors' published code, from a checkout of https://github.com/t6-thu/H2Oplus.

Their modules are imported unchanged. Packages that an update does not use (loggers, tables, environments) are replaced
by empty modules; ``ml_collections`` by a dictionary with attributes.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock, patch

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.data import HybridReplayBuffer

UNUSED = ("imp", "distutils.command.config", "certifi", "pandas", "d4rl", "gym", "gym.spaces", "h5py", "ipdb", "utils")


class ConfigDict(dict):
    """Dictionary with attributes: the part of ``ml_collections.ConfigDict`` that the authors' class uses."""

    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__

    def copy_and_resolve_references(self) -> "ConfigDict":
        return ConfigDict(self)


def authors_update(cfg: DictConfig, run: DictConfig, replay: HybridReplayBuffer) -> Callable[[], object]:
    """Build the authors' update with the recipe's sizes.

    Args:
        cfg: the benchmark's options; ``cfg.authors`` is the checkout.
        run: the options of a run.
        replay: transitions of both streams, copied into the authors' buffer.

    Raises:
        FileNotFoundError: if the folder is no checkout of the authors' code.
    """
    checkout = Path(cfg.authors)
    if not (checkout / "SimpleSAC" / "h2oplus.py").is_file():
        raise FileNotFoundError(f"authors={cfg.authors}: there is no SimpleSAC/h2oplus.py; clone t6-thu/H2Oplus")
    with _importable(checkout):
        from h2oplus import H2OPLUS  # pyright: ignore[reportMissingImports]
        from mixed_replay_buffer import MixedReplayBuffer  # pyright: ignore[reportMissingImports]
        from model import (  # pyright: ignore[reportMissingImports]
            FullyConnectedNetwork,
            FullyConnectedQFunction,
            TanhGaussianPolicy,
        )
        from Network.Weight_net import ConcatDiscriminator  # pyright: ignore[reportMissingImports]
    dims, width, device = (cfg.observation_dim, cfg.action_dim), run.num_cells[0], cfg.device
    options = {"arch": "-".join(map(str, run.num_cells))}
    qvalues = [FullyConnectedQFunction(*dims, **options) for _ in range(4)]
    discriminators = [
        ConcatDiscriminator(inputs, width, 2, device).to(device) for inputs in (sum(dims), sum(dims) + dims[0])
    ]
    method = H2OPLUS(
        {"device": device, "target_entropy": -float(cfg.action_dim)},
        TanhGaussianPolicy(*dims, **options),
        *qvalues,
        FullyConnectedNetwork(dims[0], 1, **options),
        _filled(MixedReplayBuffer, replay, device),
        *discriminators,
    )
    method.torch_to_device(device)
    return lambda: method.train(sum(run.batch_size), pretrain_steps=0)


def _filled(buffer_class: type, replay: HybridReplayBuffer, device: str) -> object:
    """Build the authors' buffer with the given transitions; its constructor reads D4RL's files."""

    def rows(transitions: TensorDictBase) -> dict[str, np.ndarray]:
        after = transitions["next"]
        entries = (transitions["observation"], transitions["action"], after["observation"])
        named = dict(zip(("state", "action", "next_state"), entries, strict=True))
        named |= {"reward": after["reward"], "done": after["terminated"].float()}
        return {name: value.cpu().numpy() for name, value in named.items()}

    real, sim = rows(replay.real.storage[:]), rows(replay.storage[:])
    buffer = buffer_class.__new__(buffer_class)
    buffer.device, buffer.scale_state = torch.device(device), False
    buffer.fixed_dataset_size, buffer.size = len(replay.real), len(replay)
    for name in real:  # float64, as in the authors' constructor
        setattr(buffer, name, np.vstack((real[name], sim[name])).astype(np.float64))
    buffer.normalize_states()
    return buffer


@contextmanager
def _importable(checkout: Path) -> Iterator[None]:
    """Make the authors' modules importable; their names (``model``, ``utils``) are free again afterwards."""
    config = ModuleType("ml_collections")
    config.ConfigDict = ConfigDict  # pyright: ignore[reportAttributeAccessIssue]
    stubs = {"ml_collections": config, **{name: MagicMock() for name in UNUSED}}
    folders = [str(checkout / "SimpleSAC"), str(checkout)]
    with patch.dict(sys.modules, stubs), patch.object(sys, "path", [*folders, *sys.path]):
        yield
