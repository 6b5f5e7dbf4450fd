"""The option ``mend``: a run closes the loop between its real data and its simulator, then trains in the mended one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard, cast

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_h2o.data.readers.sources import Source, words_of
from torchrl_h2o.data.readers.whole_folder import whole_folder
from torchrl_h2o.effects import Effect, effect_to_dict
from torchrl_h2o.options.run import POSTERIOR_WORLDS
from torchrl_h2o.residuals import Report, close_the_loop
from torchrl_h2o.residuals.close_the_loop import FAILURES
from torchrl_h2o.residuals.report.contents import DataSummary
from torchrl_h2o.training.cache import SEARCHES, cache_folder, cached, key_of
from torchrl_h2o.training.task import Task

FOLDER = "mended"
POSTERIOR = "posterior"
MOST_ROWS = 20_000  # a search fits and judges a few thousand windows; more rows cost time and add little precision
BLOCK = 1_000  # rows in sequence, of data that are longer
SEARCH = {"held_out": 0.25, "seed": 0}
READ = (  # by the search, if the data have them
    *("observation", "action", ("next", "observation"), ("next", "done")),
    *("time", "log", "observation_std"),
)


def prepare_mending(cfg: DictConfig) -> None:
    """Sets the numbers of worlds and trials that ``mend=posterior`` needs, and reads the report that ``mend`` names.

    Writes a message if the number changes, or the report does not recommend its effects.

    Raises:
        ValueError: if the report has no effects.
        torchrl_h2o.data.DataError: if it cannot be read.
    """
    if names_report(cfg.mend):
        report = Report.load(cfg.mend)
        if not report.effects:
            raise ValueError(
                f"mend={cfg.mend}: this report contains no effects to add to the simulator; leave mend out"
            )
        if against := report.why_not_recommended():
            tqdm.write(f"mend={cfg.mend}: this report does not recommend its effects for training: {against}")
    if cfg.mend == POSTERIOR and cfg.num_worlds < POSTERIOR_WORLDS:
        tqdm.write(f"mend={POSTERIOR}: num_worlds={POSTERIOR_WORLDS} instead of {cfg.num_worlds}, one draw per world")
        cfg.num_worlds = POSTERIOR_WORLDS
    if cfg.mend == POSTERIOR:
        cfg.trial_episodes = max(cfg.trial_episodes, cfg.num_worlds)


def names_report(mend: bool | str | None) -> TypeGuard[str]:
    """Whether the option ``mend`` names the report of an earlier search."""
    return isinstance(mend, str) and mend != POSTERIOR


def find_missing_effects(
    cfg: DictConfig, task: Task, real: TensorDictBase, directory: Path, known: Sequence[Effect] = ()
) -> dict[str, Any] | None:
    """Closes the loop between the real data and the simulator if ``mend`` is set, and writes ``mended/report.json``.

    A run that is resumed reads the report in its folder. If the data cannot be searched, the run goes on, and the
    report contains the reason and no effects. Effects that the report does not recommend are not used. Where ``mend``
    names an earlier report, its effects are used, without a search.

    Args:
        cfg: the run's configuration.
        task: the task without the effects.
        real: the measured transitions, ``[T]``, in physical units.
        directory: the run's folder.
        known: effects from which the search begins, such as those found in fewer data.

    Returns:
        The effects for :meth:`Task.mended` and the entry ``mended`` of the configuration: ``effects``, and ``worlds``
        for ``mend=posterior``; None if the simulator stays as it is.
    """
    if not cfg.get("mend") or cfg.get("mended") is not None:
        return cfg.get("mended")
    is_given = names_report(cfg.mend)
    if is_given:
        report = Report.load(cfg.mend)
    else:
        report = report_of_run(directory) or _search(task, real, cfg.data, directory / FOLDER, known)
    is_used = report.recommended or is_given
    unchanged = "" if is_used else " The run trains in the unchanged simulator."
    tqdm.write(f"mend={cfg.mend if is_given else str(cfg.mend).lower()}: {report.sentence()}{unchanged}")
    if not is_used:
        return None
    draws = draws_of(report, task, cfg.num_worlds, cfg.seed) if cfg.mend == POSTERIOR else None
    return {"effects": _entries(report.effects), "worlds": draws and [_entries(effects) for effects in draws]}


def report_of_run(directory: Path) -> Report | None:
    """Reads the report in a run's folder; None if the run has none."""
    return Report.load(directory / FOLDER) if (directory / FOLDER).exists() else None


def _search(task: Task, real: TensorDictBase, data: Source, folder: Path, known: Sequence[Effect]) -> Report:
    """Closes the loop, or reads the report of the same search from the cache, and copies its files into a folder."""
    source = Path(data).name if isinstance(data, str) and Path(data).exists() else words_of(data)
    rows, simulator = searched_rows(real), task.make_simulator()
    chosen = f"{len(rows)} of {len(real)} rows" if len(rows) < len(real) else f"all {len(real)} rows"

    def search(cached_folder: Path) -> None:
        tqdm.write(f"mend: searching {chosen} for effects that the simulator lacks; this takes minutes")
        report = close_the_loop(simulator, rows, source=f"{source}, {chosen}", known=known, **SEARCH)
        write_whole(report, cached_folder)

    try:
        found = cached(cache_folder() / "mended" / search_key(task, simulator, rows, known), search)
    except FAILURES as error:  # data that do not fit the simulator, or leave its equations singular
        reason = f"the search failed ({type(error).__name__}: {' '.join(str(error).split())})"
        report = Report(simulator=task.name, data=DataSummary(source, len(real), 0), conclusion=reason)
        write_whole(report, folder)
        return report
    with whole_folder(folder) as partial:
        shutil.copytree(found, partial, dirs_exist_ok=True)
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


def search_key(task: Task, simulator: EnvBase, rows: TensorDictBase, known: Sequence[Effect] = ()) -> str:
    """Identifies a search by the simulator and its effects, those it begins from, the data's values and the code.

    The effects count beside the simulator's model, which does not show those on actions, observations and forces.
    """
    effects = [_entries(task.simulator), _entries(known)]
    data = [
        f"{key} {values.dtype} {tuple(values.shape)}".encode() + values.contiguous().numpy().tobytes()
        for key in READ
        if (values := rows.get(key, None)) is not None
    ]
    return key_of([dict(task.config["make"]), effects, SEARCH], simulator, SEARCHES, data)


def draws_of(report: Report, task: Task, num_worlds: int, seed: int) -> list[tuple[Effect, ...]]:
    """One draw per world. A draw that the model rejects, such as negative damping, is replaced by the best values."""
    return [draw if _fits(task, draw) else report.effects for draw in report.sample(num_worlds, seed=seed)]


def _fits(task: Task, effects: Sequence[Effect]) -> bool:
    try:
        task.mended({"effects": _entries(effects), "worlds": None}).make_simulator()
    except ValueError:
        return False
    return True


def _entries(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    return [effect_to_dict(effect) for effect in effects]


def summary_of_mending(directory: Path) -> dict[str, Any]:
    """The entry ``mended`` of summary.json: what was found, and the simulator's error; empty without ``mend``."""
    report = report_of_run(directory)
    if report is None:
        return {}
    entries = report.to_json()
    error = entries["error"] and {key: entries["error"][key] for key in ("metric", "unit", "before", "after", "floor")}
    effects = [{key: effect[key] for key in ("name", "words", "parameters")} for effect in entries["effects"]]
    kept = {key: entries[key] for key in ("sentence", "conclusion", "data", "wall_s")}
    return {"mended": {**kept, "recommended": report.recommended, "effects": effects, "error": error}}


def lines_of_mending(directories: Sequence[Path]) -> list[str]:
    """Lines for the end of a run: each different result of ``mend`` in the folders, and the file of its report."""
    first: dict[str, Path] = {}  # by sentence: members of a population often have the same result
    for directory in directories:
        if (report := report_of_run(directory)) is not None:
            first.setdefault(report.sentence(), directory)
    return [
        f"\n{sentence}\nreport     {os.path.relpath(directory / FOLDER)}/report.html"
        for sentence, directory in first.items()
    ]
