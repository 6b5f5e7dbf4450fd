"""Results of a run: evaluations in reality and the simulator, summary.json, learning_curve.png, and a short table."""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.options.train import OFFLINE
from torchrl_h2o.provenance import provenance
from torchrl_h2o.training.environments import preprocessing_of, task_of
from torchrl_h2o.training.learning_curve import Trained, draw_learning_curve
from torchrl_h2o.training.mending import lines_of_mending, summary_of_mending
from torchrl_h2o.training.real_data import behaviour_of, is_cut
from torchrl_h2o.training.returns import Evaluation, evaluate
from torchrl_h2o.whole_file import write_text

DATA = "the data's behaviour"
COLLAPSED = 0.1  # mean weight of simulated rows below which a training hardly uses the simulator


def judge(
    cfg: DictConfig,
    real: TensorDictBase,
    policies: Mapping[str, torch.nn.Module],
    trainings: Mapping[str, Trained],
    directory: Path,
    wall_s: float,
) -> dict[str, Evaluation]:
    """Evaluates the policies and writes summary.json and learning_curve.png.

    If the task names its observations, they are measured in physical units.

    Args:
        cfg: the run's complete configuration.
        real: the measured transitions, ``[T]``.
        policies: by method; the first belongs to the main method, the others to baselines. The first is also evaluated
            in one episode in the simulator.
        trainings: finished trainings, by method.
        directory: folder to write to.
        wall_s: wall time of the run so far, in s.

    Returns:
        The evaluations in reality by method, and the returns of the episodes in the data under :data:`DATA`.
    """
    start = time.perf_counter()
    task, preprocessing = task_of(cfg), preprocessing_of(cfg)
    behaviour, main = behaviour_of(real, cut=is_cut(cfg)), next(iter(policies))
    names = task.config.get("observations")
    physical = None if names is None else partial(preprocessing.physical, size=len(names))
    reality = task.make_reality(cfg.final_episodes, preprocessing)
    in_reality = {name: evaluate(reality, one, cfg.final_episodes, physical=physical) for name, one in policies.items()}
    observed = {} if names is None else {"observed": in_reality[main].observed(names)}
    in_simulator = evaluate(task.make_simulator(1, preprocessing), policies[main], 1)
    draw_learning_curve(directory / "learning_curve.png", trainings, behaviour, task)
    summary = {
        "method": main,
        **run_settings(cfg, real),
        "updates": trainings[main].updates,
        "return_real": in_reality[main].summary() | observed,
        "return_sim": in_simulator.summary(),
        "return_trial": best_trial(trainings[main].rows),
        "return_data": behaviour.summary(),
        "baselines": {name: in_reality[name].summary() for name in policies if name != main},
        "warnings": warnings_of(cfg, in_reality[main], behaviour, trainings[main].rows),
        "updates_per_second": trainings[main].updates_per_second,
        "wall_s": wall_s + time.perf_counter() - start,
    }
    write_summary(directory, summary)
    return in_reality | {DATA: behaviour}


def warnings_of(
    cfg: DictConfig, result: Evaluation, behaviour: Evaluation, rows: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Says that a policy is worse than the data's behaviour, or that its training hardly used the simulator.

    Args:
        cfg: the run's configuration.
        result: the policy's evaluation in reality.
        behaviour: the episodes in the data. The returns of episodes that are longer than the task's limit are scaled to
            that length.
        rows: metrics of the training.

    Returns:
        Sentences with what to do; empty if there is nothing to say.
    """
    found, limit = [], cfg.env.make.get("max_episode_steps") or math.inf
    share = min(1.0, limit / behaviour.mean_length)
    usual, is_mended = share * behaviour.mean, bool(cfg.mend)
    if result.mean < usual - 2.0 * math.hypot(result.error, share * behaviour.error):
        has_simulator = cfg.get("method", "h2o_plus") not in OFFLINE
        options = ["mend=true"] * (has_simulator and not is_mended)
        options += ["warm_start=true"] * (not cfg.warm_start)
        options += ["keep=best_in_simulator"] * (has_simulator and cfg.keep == "last")
        remedy = f"set {' '.join(options)}" if options else "train with another seed, or record more data"
        found.append(
            f"the policy is worse in reality than the data's behaviour, whose return is {usual:.0f}: do not use it; "
            f"{remedy}"
        )
    weight = rows[-1].get("ratio_of_sim") if rows and cfg.get("ratio", True) else None
    if weight is not None and weight < COLLAPSED:
        remedy = "train without weights: ratio=false" if is_mended else "set mend=true"
        found.append(
            f"the mean weight of simulated rows is {weight:.2g}, because they hardly look real: the training made "
            f"little use of the simulator; {remedy}"
        )
    return found


def best_trial(rows: Sequence[Mapping[str, Any]]) -> float | None:
    """Returns the lower bound of the return in the simulator of the policy that ``keep=best_in_simulator`` returns.

    It is the highest of several bounds, so the policy's expected return there may still be lower.

    Args:
        rows: metrics of a training.

    Returns:
        The bound; None with ``keep=last``.

    Examples:
        >>> best_trial([{"updates": 1000, "return_kept": 20.0}, {"updates": 2000, "return_kept": 20.0}])
        20.0
    """
    return rows[-1].get("return_kept") if rows else None


def write_failure(directory: Path, failure: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Writes the summary.json of a failed run, which has no policy, with the reason of the failure."""
    failed = {"updates": failure["updates"], "return_real": None, "failure": failure["why"]}
    write_summary(directory, {**settings, **failed})


def run_settings(cfg: DictConfig, real: TensorDictBase) -> dict[str, Any]:
    """Collects the entries of summary.json that describe a run: environment, gap, data, options of H2O+, seed."""
    of_h2o_plus = ("backbone", "mixing", "ratio")  # options that no other method reads
    return {
        "env": cfg.env.name,
        "gap": cfg.gap,
        "mend": cfg.mend,
        "warm_start": cfg.warm_start,
        "keep": cfg.keep,
        "data": cfg.data if isinstance(cfg.data, str) else list(cfg.data),
        "data_seconds": cfg.data_seconds,
        "transitions": len(real),
        **({key: cfg[key] for key in of_h2o_plus} if cfg.get("method", "h2o_plus") == "h2o_plus" else {}),
        "seed": cfg.seed,
        "device": cfg.get("device", "cpu"),
    }


def write_summary(directory: Path, summary: dict) -> None:
    """Writes summary.json, and adds the result of ``mend``, what produced it, and the command."""
    summary = summary | summary_of_mending(directory) | provenance() | {"command": shlex.join(["python", *sys.argv])}
    write_text(directory / "summary.json", json.dumps(summary, indent=2) + "\n")


def table_of_run(
    in_reality: Mapping[str, Evaluation], directory: Path, film: Path | None, seconds_per_step: float
) -> str:
    """Format what ``mend`` found, episodes in reality by policy, the names of the files, and the run's warnings.

    Args:
        in_reality: evaluations by the name of the policy.
        directory: the run's folder.
        film: path of the film, or None.
        seconds_per_step: control step, in s.
    """
    folder = os.path.relpath(directory)
    lines = [
        *lines_of_mending([directory]),
        *_lines(in_reality, seconds_per_step),
        f"\nresults    {folder}/summary.json, metrics.csv",
        f"look at    {folder}/learning_curve.png" + (f", {film.name}" if film else ""),
        f"replay     python recipes/evaluate.py checkpoint={folder}",
        *(f"warning    {warning}" for warning in _warnings_in(directory)),
    ]
    return "\n".join(lines)


def _warnings_in(directory: Path) -> list[str]:
    """The warnings in the summary of a run; none if it has no summary, or one of an earlier version."""
    summary = directory / "summary.json"
    return json.loads(summary.read_text()).get("warnings", []) if summary.exists() else []


def table_of_population(
    in_reality: Mapping[str, Evaluation | None],
    directory: Path,
    seconds_per_step: float,
    trials: Mapping[str, float | None] | None = None,
) -> str:
    """Format the same table for a population, one line per member, and the member to use.

    Args:
        in_reality: evaluations by the name of the member; None stands for a member that failed.
        directory: the population's folder.
        seconds_per_step: control step, in s.
        trials: by member, the value of :func:`best_trial`. The member with the highest one is the one to use. None if
            there are none, or if the members have different simulators.
    """
    folder = os.path.relpath(directory)
    tried = {name: value for name, value in (trials or {}).items() if value is not None}
    best = max(tried, key=lambda name: tried[name], default=None)
    lines = [
        *lines_of_mending([directory / name for name in in_reality]),
        *_lines(in_reality, seconds_per_step),
        f"\nresults    {folder}/*/summary.json, metrics.csv, learning_curve.png",
        *([] if best is None else [f"use        {best}, the best in the simulator: {tried[best]:.0f}"]),
        f"replay     python recipes/evaluate.py checkpoint={folder}/{best or next(iter(in_reality))}",
        *(f"warning    {name}: {warning}" for name in in_reality for warning in _warnings_in(directory / name)),
    ]
    return "\n".join(lines)


def _lines(in_reality: Mapping[str, Evaluation | None], seconds_per_step: float) -> list[str]:
    width = max(24, *(len(name) + 2 for name in in_reality))
    lines = [f"\n{'in reality':<{width}}{'return':>10}{'':>9}{'lasts':>10}{'episodes':>10}"]
    for name, result in in_reality.items():
        if result is None:
            lines.append(f"{name:<{width}}{'failed':>10}")
            continue
        spread, seconds = f"± {result.std:.0f}", result.mean_length * seconds_per_step
        lines.append(f"{name:<{width}}{result.mean:>10.0f}{spread:>9}{seconds:>8.1f} s{len(result.returns):>10}")
    return lines
