"""Write and read TED TensorDicts as memory maps, with checks of the files before they are opened.

The checks are needed for two reasons: torch fills a file that is too short with zeros without an error, and tensordict
stores entries that are not tensors as pickles.
"""

from __future__ import annotations

import errno
import json
import math
import shutil
from operator import index
from pathlib import Path
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.file_kind import is_pickle
from torchrl_h2o.data.readers.ted import entry_name, require_ted
from torchrl_h2o.data.readers.whole_folder import whole_folder

_BLOCK = 4096  # bytes by which the size of a file is rounded up
_FLOATS = ("observation", "action", ("next", "observation"), ("next", "reward"))


def write_ted(td: TensorDictBase, folder: str | Path) -> Path:
    """Write a flat TED TensorDict as a memory map, atomically: one file per entry and no pickles.

    Args:
        td: transitions of batch size [T], tensors only.
        folder: a folder that does not exist yet.

    Returns:
        The folder.

    Raises:
        DataError: if the folder exists, or if :func:`read_ted` would reject the TensorDict.

    Example:
        >>> import tempfile, torch
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.data import read_ted, write_ted
        >>> recorded = GymEnv("Pendulum-v1").rollout(10)
        >>> folder = write_ted(recorded, tempfile.mkdtemp() + "/pendulum")
        >>> td = read_ted(folder)
        >>> bool((td["observation"] == recorded["observation"]).all())
        True
    """
    require_ted(td, source=folder)
    for key in td.keys(True, True, is_leaf=lambda kind: not issubclass(kind, TensorDictBase)):
        if not isinstance(td.get(key), torch.Tensor):
            raise DataError(
                "the entry is not a tensor and would be pickled",
                "drop it with td.exclude(...)",
                source=folder,
                column=entry_name(key),
            )
    with whole_folder(folder) as partial:
        map_to_files(td.detach().contiguous(), partial)
    return Path(folder)


def map_to_files(td: TensorDictBase, folder: Path) -> None:
    """Write the entries of a TensorDict into a folder, one file each.

    Raises:
        OSError: if the disk is full. Writing to a mapped file would then end the process with a bus error.
    """
    sizes = [leaf.nbytes for leaf in td.values(True, True)]
    needed = sum(sizes) + _BLOCK * (len(sizes) + 2)
    folder.mkdir(exist_ok=True)
    if (free := shutil.disk_usage(folder).free) < needed:
        raise OSError(errno.ENOSPC, f"the disk has {free} bytes left, and the data need {needed}", str(folder))
    td.memmap(cast("str", folder), copy_existing=True)  # annotated for strings; it takes paths as well


def read_ted(folder: str | Path, *, in_memory: bool = True) -> TensorDict:
    """Read a flat TED TensorDict written by :func:`write_ted` or ``TensorDict.memmap``.

    Args:
        folder: the folder with ``meta.json``.
        in_memory: whether to copy the data and convert observation, action and reward to float32 (simulators may
            record float64). Otherwise the tensors stay mapped to the files, for data larger than memory, and must be
            float32 in the files; writing to them changes the files.

    Returns:
        TensorDict of batch size [T] with all entries in the files. An unfinished last episode is marked truncated.

    Raises:
        DataError: for a missing or truncated file, a pickle, a missing entry, NaN or infinity, or mapped data of a
            dtype other than float32.
    """
    td = load_memory_map(folder)
    require_ted(td, source=folder)
    td = _as_float32(td.clone(recurse=in_memory), in_memory, folder)
    ends = td["next", "done"].clone()
    ends[-1] = True
    td["next", "done"] = ends
    td["next", "truncated"] = ends & ~td["next", "terminated"]
    return td


def load_memory_map(folder: str | Path) -> TensorDict:
    """Map the files written by ``TensorDict.memmap``; writing to the result changes the files.

    Args:
        folder: the folder with ``meta.json``.

    Raises:
        DataError: for a missing folder, a pickle in it, or a missing or truncated file.

    Example:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.data.readers.memory_map import load_memory_map
        >>> folder = tempfile.mkdtemp()
        >>> _ = TensorDict({"a": torch.arange(3)}, [3]).memmap(folder)
        >>> load_memory_map(folder)["a"].tolist()
        [0, 1, 2]
    """
    folder = Path(folder).expanduser()
    if not (folder / "meta.json").is_file():
        raise DataError("there is no meta.json in the folder", "give a folder written by write_ted", source=folder)
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".memmap" and is_pickle(path):
            raise DataError(
                "this is a pickle, and reading it could execute arbitrary code",
                "write the data again with write_ted, which stores only tensors",
                source=path,
            )
    with unreadable("unreadable", "write it again", source=folder):
        _require_whole_files(folder)
        return TensorDict.load_memmap(folder, allow_pickle=False)


def _require_whole_files(folder: Path) -> None:
    description = folder / "meta.json"
    with unreadable("the description cannot be read", "copy or write the folder again", source=description):
        meta = json.loads(description.read_text(encoding="utf-8"))
        entries = {key: entry for key, entry in meta.items() if isinstance(entry, dict)}
        sizes = {
            folder / f"{key}.memmap": math.prod(map(index, entry["shape"]))  # not numpy's, which overflows
            * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
            for key, entry in entries.items()
            if "dtype" in entry
        }
        nested = [key for key, entry in entries.items() if entry.get("is_nested")]
    if nested:
        problem = "the entry is a nested tensor, whose rows differ in length"
        raise DataError(problem, "write rows of one length", source=description, column=nested[0])
    for path, size in sizes.items():
        found = path.stat().st_size if path.is_file() else 0
        if found != size:
            raise DataError(
                f"the file has {found} bytes, but meta.json states {size}",
                "the file is truncated or belongs to other data: copy or write the folder again",
                source=path,
            )
    for key in (key for key, entry in entries.items() if "type" in entry):
        _require_whole_files(folder / key)


def _as_float32(td: TensorDict, in_memory: bool, folder: str | Path) -> TensorDict:
    for key in _FLOATS:
        values = td.get(key, None)
        # actions of a discrete task may be integers
        discrete = key == "action" and not values.is_floating_point()
        if values is None or values.dtype == torch.float32 or discrete:
            continue
        if not in_memory:
            raise DataError(
                f"the dtype is {values.dtype}, but mapped data must be torch.float32, because they are not converted",
                "read with in_memory=True, or write the data again as float32",
                source=folder,
                column=entry_name(key),
            )
        td[key] = values.float()
    return td
