"""Evaluates trained policies in reality and in their simulator; writes summary.json and learning_curve.png."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.training.learning_curve import Trained, draw_learning_curve
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.returns import Evaluation, evaluate
from torchrl_h2o.training.run_folder import write_summary
from torchrl_h2o.training.task import Task

DATA = "the data's behaviour"


def judge(
    task: Task,
    preprocessing: Preprocessing,
    policies: Mapping[str, torch.nn.Module],
    trainings: Mapping[str, Trained],
    behaviour: Evaluation,
    directory: Path,
    *,
    episodes: int,
    settings: Mapping[str, Any],
    wall_s: float,
) -> dict[str, Evaluation]:
    """Evaluates the policies and writes summary.json and learning_curve.png.

    Args:
        task: the task.
        preprocessing: of the observations that the policies read.
        policies: by method; the first is the one that the run is about, the others are baselines.
        trainings: their trainings, by method.
        behaviour: returns of the data's own episodes.
        directory: where the files go.
        episodes: number of episodes in reality.
        settings: further entries of the summary, see :func:`run_settings`.
        wall_s: seconds that the run has taken so far.

    Returns:
        The evaluations in reality by method, and the data's behaviour.
    """
    start = time.perf_counter()
    main = next(iter(policies))
    reality, simulator = task.make_reality(episodes, preprocessing), task.make_simulator(1, preprocessing)
    in_reality = {name: evaluate(reality, policy, episodes) for name, policy in policies.items()}
    in_simulator = evaluate(simulator, policies[main], 1)
    draw_learning_curve(directory / "learning_curve.png", trainings, behaviour, task)
    write_summary(
        directory,
        {
            "method": main,
            **settings,
            "updates": trainings[main].updates,
            "return_real": in_reality[main].summary(),
            "return_sim": in_simulator.summary(),
            "return_data": behaviour.summary(),
            "baselines": {name: in_reality[name].summary() for name in policies if name != main},
            "updates_per_second": trainings[main].updates_per_second,
            "wall_s": wall_s + time.perf_counter() - start,
        },
    )
    return in_reality | {DATA: behaviour}


def write_failure(directory: Path, failure: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Writes the summary.json of a run without a policy, with the reason of its failure."""
    failed = {"updates": failure["updates"], "return_real": None, "failure": failure["why"]}
    write_summary(directory, {**settings, **failed})


def run_settings(cfg: DictConfig, real: TensorDictBase) -> dict[str, Any]:
    """The entries of a summary that describe the run: environment, gap, data, the method's options and the seed."""
    of_h2o_plus = ("backbone", "mixing", "ratio")  # options that no other method reads
    return {
        "env": cfg.env.name,
        "gap": cfg.gap,
        "gap_fix": cfg.get("gap_fix"),
        "data": cfg.data,
        "transitions": len(real),
        **({key: cfg[key] for key in of_h2o_plus} if cfg.get("method", "h2o_plus") == "h2o_plus" else {}),
        "seed": cfg.seed,
    }
