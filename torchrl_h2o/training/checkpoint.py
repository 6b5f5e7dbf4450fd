"""Checkpoints of TorchRL that survive a full disk, and that are read without unpickling anything.

The folder of a run may come from somebody else, and TorchRL reads pickles that it finds in a checkpoint.
"""

from __future__ import annotations

import errno
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointRotation, StateDictCheckpointAdapter

from torchrl_h2o.data import DataError

_PLAIN = {".json", ".memmap"}  # what TorchRL writes for states of tensors and numbers
_ARCHIVE = StateDictCheckpointAdapter.state_archive


def make_checkpoint(**components: Any) -> Checkpoint:
    """Returns a checkpoint of objects with a ``state_dict``, which is written as one file.

    Each state is staged as an archive. TorchRL's default are mapped files, and writing to those on a full disk ends the
    process with a bus error, where an archive raises OSError and leaves the earlier checkpoint.

    Args:
        **components: the objects, by name.

    Examples:
        >>> import torch
        >>> sorted(make_checkpoint(actor=torch.nn.Linear(2, 1)).components)
        ['actor']
    """
    # an archive, because a damaged ZIP raises an error, while a damaged folder of memory maps is read as zeros
    checkpoint = Checkpoint(format="archive")
    for name, component in components.items():
        checkpoint.register(name, component, adapter=StateDictCheckpointAdapter("archive"))
    return checkpoint


def save_checkpoint(
    rotation: CheckpointRotation, checkpoint: Checkpoint, step: int, metadata: Mapping[str, Any] | None = None
) -> None:
    """Saves a checkpoint and removes the earlier one, which stays if the new one cannot be written.

    Args:
        rotation: the folder of the checkpoints.
        checkpoint: the components.
        step: number of the checkpoint, which rises.
        metadata: what :func:`load_checkpoint` returns, in types of JSON.

    Raises:
        OSError: if the disk is full.
    """
    try:
        rotation.save(checkpoint, step=step, metadata=metadata)
    except (OSError, RuntimeError) as error:  # torch raises RuntimeError where a file cannot be made
        if os.strerror(errno.ENOSPC) not in str(error):
            raise
        problem = f"{os.strerror(errno.ENOSPC)} for checkpoint {step}; the earlier one stays: make room, then resume"
        raise OSError(errno.ENOSPC, problem, str(rotation.directory)) from error


def load_checkpoint(path: Path, checkpoint: Checkpoint) -> dict[str, Any]:
    """Restores the components of a checkpoint and returns the metadata that were saved with it.

    Args:
        path: the archive.
        checkpoint: the components to restore.

    Raises:
        torchrl_h2o.data.DataError: if the checkpoint is no archive, or contains a file of another kind than tensors and
            JSON.
        torchrl.checkpoint.CheckpointError: if a component does not fit.
    """
    _require_plain(path)
    checkpoint.load(path, map_location="cpu")  # it may come from a machine with a GPU; each component copies from there
    return Checkpoint.manifest(path)["metadata"]


def _require_plain(path: Path) -> None:
    remedy = "only checkpoints that this library wrote are read: copy the folder again, or train again"
    try:
        with zipfile.ZipFile(path) as archive:
            names = list(_files(archive))
    except (OSError, zipfile.BadZipFile) as error:
        raise DataError(f"this is not the archive of a checkpoint: {error}", remedy, source=path) from error
    for name in names:
        if PurePosixPath(name).suffix not in _PLAIN:
            problem = f"the checkpoint contains {name}, and reading such a file could run code"
            raise DataError(problem, remedy, source=path)


def _files(archive: zipfile.ZipFile) -> Iterator[str]:
    """Yields the names of all files, and instead of the archive of a state those in it."""
    for member in archive.infolist():
        if PurePosixPath(member.filename).name == _ARCHIVE:
            with archive.open(member) as file, zipfile.ZipFile(file) as inner:
                yield from (f"{member.filename}/{name}" for name in _files(inner))
        elif not member.is_dir():
            yield member.filename
