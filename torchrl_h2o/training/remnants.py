"""Removes from a run's folder what a killed process was writing: temporary files, and staged checkpoints of TorchRL."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from torchrl_h2o.whole_file import remove_partial

# names of torchrl.checkpoint: the new checkpoint before it is renamed, and the earlier one before it is deleted
_STAGED = re.compile(r"\.(checkpoint-.+)\.(stage|archive|backup|delete)-[0-9a-f]{32}")


def remove_remnants(directory: str | Path) -> None:
    """Removes unfinished files and checkpoints in a run's folder and in those of a population's members.

    Call it only while no other process trains in the folder.

    Args:
        directory: the run's folder.
    """
    remove_partial(directory)
    for path in sorted(Path(directory).glob("**/checkpoints/*/.checkpoint-*")):
        named = _STAGED.fullmatch(path.name)
        if named is None:
            continue
        whole = path.with_name(named[1])
        if named[2] == "backup" and not whole.exists():
            path.rename(whole)  # killed between moving the earlier checkpoint away and renaming the new one
        elif path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
