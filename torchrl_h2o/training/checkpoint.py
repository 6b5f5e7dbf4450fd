"""Checkpoints: one file of ``torch.save`` for each method of a run, read without running code.

The folder of a run may come from somebody else, and the file may be damaged. Therefore ``torch.load`` reads it with
``weights_only=True``, and what it holds is compared with the networks before it is copied into them.
"""

from __future__ import annotations

import errno
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from torchrl_h2o.data import DataError
from torchrl_h2o.whole_file import whole_file

_REMEDY = "copy the run's folder again, or train again"
_PROGRESS = {"epoch": int, "seconds": float, "update_seconds": float, "rows": list}


def checkpoint_file(directory: str | Path, method: str) -> Path:
    """Returns the file of a method's checkpoint in a run's folder.

    Examples:
        >>> checkpoint_file("run", "SAC in the simulator").as_posix()
        'run/checkpoints/sac_in_the_simulator.pt'
    """
    return Path(directory) / "checkpoints" / f"{method.lower().replace(' ', '_')}.pt"


def save_checkpoint(path: Path, components: Mapping[str, Any], progress: Mapping[str, Any]) -> None:
    """Saves the states of components. The earlier checkpoint stays if the new one cannot be written.

    Args:
        path: the file.
        components: objects with a ``state_dict``, by name.
        progress: the state of the training, in types of JSON.

    Raises:
        OSError: if the disk is full.
    """
    states = {name: _compact(component.state_dict()) for name, component in components.items()}
    try:
        with whole_file(path) as partial:
            torch.save({"progress": dict(progress), "components": states}, partial)
    except (OSError, RuntimeError) as error:  # torch raises RuntimeError where a file cannot be written
        full = os.strerror(errno.ENOSPC)
        if full not in str(error) and "file write failed" not in str(error) and "unexpected pos" not in str(error):
            raise
        raise OSError(
            errno.ENOSPC, f"{full}; the earlier checkpoint stays: make room, then resume", str(path)
        ) from error


def read_checkpoint(path: Path, *, mmap: bool = False) -> dict[str, Any]:
    """Reads ``progress`` and the states of the ``components``.

    Args:
        path: the file.
        mmap: whether tensors stay in the file until they are used.

    Raises:
        FileNotFoundError: if there is no such file.
        torchrl_h2o.data.DataError: if the file is damaged, or no checkpoint of this library.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            packed = [member.filename for member in archive.infolist() if member.compress_type != zipfile.ZIP_STORED]
            if packed:  # torch compresses nothing, and a few bytes could stand for gigabytes
                raise ValueError(f"{packed[0]} is compressed")
            if (damaged := archive.testzip()) is not None:
                raise ValueError(f"{damaged} is damaged")
        saved = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
        progress, states = saved["progress"], saved["components"]
        for name, kind in _PROGRESS.items():
            if not isinstance(progress[name], kind):
                raise ValueError(f"{name} is {progress[name]!r}")
        for tensor in _tensors(states):
            if tensor.layout != torch.strided or tensor.nbytes > tensor.untyped_storage().nbytes():
                raise ValueError(f"a tensor of shape {tuple(tensor.shape)} is larger than its values")
        for state in states.values():
            state.keys()
    except FileNotFoundError:
        raise
    except Exception as error:  # zipfile, pickle and torch raise errors of all kinds for damaged files
        problem = f"this is not a checkpoint that can be read: {error}"
        raise DataError(problem, _REMEDY, source=path) from error
    return saved


def load_checkpoint(path: Path, components: Mapping[str, Any]) -> dict[str, Any]:
    """Restores components from a checkpoint, which may hold more of them.

    Args:
        path: the file.
        components: objects with a ``load_state_dict``, by name.

    Returns:
        The state of the training.

    Raises:
        FileNotFoundError: if there is no such file.
        torchrl_h2o.data.DataError: if the file is damaged, or a component differs in name, shape or type, or has values
            that are not finite.
    """
    saved = read_checkpoint(path)
    for name, component in components.items():
        try:
            if isinstance(component, nn.Module):
                _require_alike(saved["components"][name], component.state_dict())
            component.load_state_dict(saved["components"][name])
            if isinstance(component, torch.optim.Optimizer):
                _require_fitting(component)
        except Exception as error:  # the states of a stranger's file may be anything
            said = "it is missing" if isinstance(error, KeyError) and name not in saved["components"] else str(error)
            raise DataError(f"{name} does not fit this run: {said}", _REMEDY, source=path, column=name) from error
    return saved["progress"]


def require_widths(cfg: DictConfig, path: Path) -> None:
    """Requires the hidden layers of the policy in a checkpoint to be those of a configuration.

    Call it before networks are built, because a configuration from somebody else could name layers of any size.

    Raises:
        torchrl_h2o.data.DataError: if they differ, or the checkpoint cannot be read.
    """
    for name, actor in read_checkpoint(path, mmap=True)["components"].items():
        if name != "actor" and not name.endswith("_actor"):  # of a member of a population
            continue
        weights = [value for key, value in actor.items() if str(key).endswith("weight")]
        widths = [len(value) for value in weights if isinstance(value, Tensor) and value.ndim == 2][:-1]
        if widths != list(cfg.num_cells):
            problem = f"num_cells={list(cfg.num_cells)} in config.yaml, but the policy's layers are {widths}"
            raise DataError(problem, _REMEDY, source=path)


def _compact(state: Any) -> Any:
    """Copies views, because torch would save the whole tensor that they look into."""

    def one(value: Any) -> Any:
        is_view = isinstance(value, Tensor) and value.nbytes < value.untyped_storage().nbytes()
        return value.clone() if is_view else value

    return pytree.tree_map(one, state)


def _tensors(state: Any) -> Iterator[Tensor]:
    return (value for value in pytree.tree_leaves(state) if isinstance(value, Tensor))


def _require_alike(saved: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    if other := sorted(saved.keys() ^ own.keys()):
        raise ValueError(f"{other[0]} is only in one of them")
    for name, value in own.items():
        if not isinstance(value, Tensor):
            continue
        there = saved[name]
        if not isinstance(there, Tensor) or (there.shape, there.dtype) != (value.shape, value.dtype):
            kind = f"{there.dtype} {list(there.shape)}" if isinstance(there, Tensor) else repr(there)
            raise ValueError(f"{name} is {kind}, not {value.dtype} {list(value.shape)}")
        if not (there.isfinite() | ~value.isfinite().cpu()).all():
            raise ValueError(f"{name} has values that are NaN or infinite")


def _require_fitting(optimiser: torch.optim.Optimizer) -> None:
    for parameter, state in optimiser.state.items():
        for name, value in state.items():
            if isinstance(value, Tensor) and value.ndim and value.shape != parameter.shape:
                raise ValueError(f"{name} has the shape {list(value.shape)}, not {list(parameter.shape)}")
