"""Reads checkpoints of TorchRL without unpickling anything: the folder of a run may come from somebody else."""

from __future__ import annotations

import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

from torchrl.checkpoint import Checkpoint

from torchrl_h2o.data import DataError

_PLAIN = {".json", ".memmap"}  # what TorchRL writes for states of tensors and numbers


def load_checkpoint(path: Path, checkpoint: Checkpoint) -> dict[str, Any]:
    """Restores the components of a checkpoint and returns the metadata that were saved with it.

    TorchRL also reads pickles that it finds in a checkpoint, and those can run code.

    Args:
        path: the archive.
        checkpoint: the components to restore.

    Raises:
        torchrl_h2o.data.DataError: if the checkpoint is no archive, or contains a file of another kind than tensors and
            JSON.
        torchrl.checkpoint.CheckpointError: if a component does not fit.
    """
    _require_plain(path)
    checkpoint.load(path)
    return Checkpoint.manifest(path)["metadata"]


def _require_plain(path: Path) -> None:
    remedy = "only checkpoints that this library wrote are read: copy the folder again, or train again"
    try:
        with zipfile.ZipFile(path) as archive:
            names = [member.filename for member in archive.infolist() if not member.is_dir()]
    except (OSError, zipfile.BadZipFile) as error:
        raise DataError(f"this is not the archive of a checkpoint: {error}", remedy, source=path) from error
    for name in names:
        if PurePosixPath(name).suffix not in _PLAIN:
            problem = f"the checkpoint contains {name}, and reading such a file could run code"
            raise DataError(problem, remedy, source=path)
