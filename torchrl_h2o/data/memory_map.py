"""Open a memory-mapped TensorDict only after its files have been looked at.

torch maps a file that is too short by growing it with zeros: the source would change, and nobody
would be told. And tensordict keeps what is not a tensor in a pickle.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_h2o.data.error import DataError
from torchrl_h2o.data.file_kind import is_pickle


def load_memory_map(folder: str | Path) -> TensorDict:
    """Map what ``TensorDict.memmap`` has written; writing to the result changes the files.

    Args:
        folder: the folder that holds ``meta.json``.

    Raises:
        DataError: no such folder, a pickle in it, a missing or cut-off file.

    Example:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.data.memory_map import load_memory_map
        >>> folder = tempfile.mkdtemp()
        >>> _ = TensorDict({"a": torch.arange(3)}, [3]).memmap(folder)
        >>> load_memory_map(folder)["a"].tolist()
        [0, 1, 2]
    """
    folder = Path(folder).expanduser()
    if not (folder / "meta.json").is_file():
        raise DataError("there is no meta.json here", "give a folder written by write_ted", source=folder)
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".memmap" and is_pickle(path):
            raise DataError(
                "this is a pickle, and reading it could run any code",
                "write the data again with write_ted, which keeps tensors only",
                source=path,
            )
    _require_whole_files(folder)
    try:
        return TensorDict.load_memmap(folder, allow_pickle=False)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise DataError(f"unreadable: {error}", "write it again", source=folder) from error


def _require_whole_files(folder: Path) -> None:
    try:
        meta = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
        sizes = {
            folder / f"{key}.memmap": int(np.prod(entry["shape"], dtype=np.int64))
            * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
            for key, entry in meta.items()
            if isinstance(entry, dict) and "dtype" in entry
        }
        inner = [key for key, entry in meta.items() if isinstance(entry, dict) and "type" in entry]
    except (ValueError, AttributeError, KeyError, TypeError, OSError) as error:
        raise DataError(
            f"the description cannot be read: {error}",
            "copy or write the folder again",
            source=folder / "meta.json",
        ) from error
    for path, size in sizes.items():
        found = path.stat().st_size if path.is_file() else 0
        if found != size:
            raise DataError(
                f"the file has {found} bytes, meta.json promises {size}",
                "it is cut off or not its own: copy or write the folder again",
                source=path,
            )
    for key in inner:
        _require_whole_files(folder / key)
