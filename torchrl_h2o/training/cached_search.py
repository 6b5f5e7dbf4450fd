"""Reports of closing the loop, cached by the data, the simulator, the settings and the code of the search.

A search takes minutes, and the runs of a grid share their data and simulators: the first run searches, the others wait
for its report. The cache is in the folder of the recordings, see :func:`~torchrl_h2o.training.real_data.cache_folder`.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from filelock import FileLock
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_h2o.data.readers.whole_folder import whole_folder
from torchrl_h2o.effects import Effect, effect_to_dict
from torchrl_h2o.residuals import LoopSettings, Report, close_the_loop
from torchrl_h2o.training.cache_key import SEARCHES, begin_key
from torchrl_h2o.training.real_data import cache_folder

MOST_ROWS = 20_000  # a search fits and judges a few thousand windows; more rows cost time and add little precision
BLOCK = 1_000  # rows in sequence, of data that are longer
SEARCH = {"held_out": 0.25, "seed": 0}
READ = (  # by the search, if the data have them
    *("observation", "action", ("next", "observation"), ("next", "done")),
    *("time", "log", "observation_std"),
)


def cached_report(
    simulator: EnvBase,
    effects: tuple[Effect, ...],
    make: Mapping[str, Any],
    real: TensorDictBase,
    source: str,
    folder: Path,
) -> Report:
    """Closes the loop, or reads the report of the same search from the cache, and copies its files into a folder.

    Args:
        simulator: the simulator, with observations in physical units.
        effects: effects of the simulator.
        make: target and arguments of the simulator's env without effects.
        real: the measured transitions, ``[T]``, in physical units.
        source: name of the data in the report.
        folder: folder for ``report.json`` and ``report.html``; must not exist. It appears with all files or not at all.

    Raises:
        DataError: if the data do not fit the simulator.
        ValueError: if the simulator's state cannot be computed from its observations.
    """
    rows = searched_rows(real)
    cached = cache_folder() / "mended" / digest(simulator, effects, make, rows)
    cached.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(cached.with_suffix(".lock")):  # another process may be at the same search; its report is then read
        if cached.exists():
            tqdm.write(f"mend: these data were searched before; the report is in {cached}")
        else:
            chosen = f"{len(rows)} of {len(real)} rows" if len(rows) < len(real) else f"all {len(real)} rows"
            tqdm.write(f"mend: searching {chosen} for effects that the simulator lacks; this takes minutes")
            report = close_the_loop(simulator, rows, source=f"{source}, {chosen}", **SEARCH)
            write_whole(report, cached)
    with whole_folder(folder) as partial:
        shutil.copytree(cached, partial, dirs_exist_ok=True)
    return Report.load(folder)


def write_whole(report: Report, folder: Path) -> None:
    """Writes a report such that the folder appears with all its files or not at all."""
    with whole_folder(folder) as partial:
        report.save(partial)


def searched_rows(real: TensorDictBase) -> TensorDictBase:
    """The transitions that a search uses: all of them, or of longer data evenly spaced blocks of successive rows.

    Returns:
        At most ``MOST_ROWS`` transitions, in their order.
    """
    if len(real) <= MOST_ROWS:
        return real
    starts = np.linspace(0, len(real) - BLOCK, MOST_ROWS // BLOCK).round().astype(int)
    return cast(TensorDictBase, torch.cat([real[start : start + BLOCK] for start in starts]))  # typed as a tensor


def digest(simulator: EnvBase, effects: tuple[Effect, ...], make: Mapping[str, Any], rows: TensorDictBase) -> str:
    """Identifies a search by the simulator, the data's values, the settings and the code.

    Args:
        simulator: the simulator with its effects.
        effects: these effects, because the model does not show those on actions, observations and forces.
        make: target and arguments of the simulator's env without effects.
        rows: the transitions that are searched.
    """
    settings = [dict(make), [*map(effect_to_dict, effects)], asdict(LoopSettings()), SEARCH]
    total = begin_key(settings, simulator, SEARCHES)
    for key in READ:
        if (values := rows.get(key, None)) is not None:
            total.update(f"{key} {values.dtype} {tuple(values.shape)}".encode())
            total.update(values.contiguous().numpy().tobytes())
    return total.hexdigest()[:16]
