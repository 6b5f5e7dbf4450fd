"""What a run's policies do in reality and in the simulator they learnt in: summary.json and learning_curve.png."""

import time
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.training.environments import make_reality, make_simulator
from torchrl_h2o.training.learning_curve import Trained, draw_learning_curve
from torchrl_h2o.training.real_data import behaviour_in
from torchrl_h2o.training.returns import Evaluation, evaluate
from torchrl_h2o.training.run_folder import write_summary

H2O_PLUS_S = ("backbone", "mixing", "ratio")  # which no other method reads


def judge(
    cfg: DictConfig,
    real: TensorDictBase,
    policies: dict[str, torch.nn.Module],
    trainings: dict[str, Trained],
    directory: Path,
    wall_s: float,
) -> dict[str, Evaluation]:
    """Evaluates the policies and leaves summary.json and learning_curve.png.

    Args:
        cfg: the run's configuration.
        real: the measured transitions.
        policies: by method; the one that the run is about, and maybe others beside it.
        trainings: theirs.
        directory: where the files go.
        wall_s: seconds that the run took so far.

    Returns:
        The episodes in reality, by method, and the data's own.
    """
    start = time.perf_counter()
    main = next(iter(policies))
    reality, simulator = make_reality(cfg, cfg.final_episodes), make_simulator(cfg, 1)
    in_reality = {name: evaluate(reality, policy, cfg.final_episodes) for name, policy in policies.items()}
    in_simulator = evaluate(simulator, policies[main], 1)
    behaviour = behaviour_in(cfg, real)
    draw_learning_curve(directory / "learning_curve.png", trainings, behaviour, cfg)
    write_summary(
        directory,
        {
            "method": main,
            **settings(cfg, real),
            "updates": trainings[main].updates,
            "return_real": in_reality[main].summary(),
            "return_sim": in_simulator.summary(),
            "return_data": behaviour.summary(),
            "baselines": {name: in_reality[name].summary() for name in policies if name != main},
            "updates_per_second": trainings[main].updates_per_second,
            "wall_s": wall_s + time.perf_counter() - start,
        },
    )
    return in_reality | {"the data's behaviour": behaviour}


def judge_failed(cfg: DictConfig, real: TensorDictBase, failure: dict, directory: Path) -> None:
    """Leaves the summary.json of a run that has no policy to show, and says there why."""
    failed = {"updates": failure["updates"], "return_real": None, "failure": failure["why"]}
    write_summary(directory, settings(cfg, real) | failed)


def settings(cfg: DictConfig, real: TensorDictBase) -> dict:
    """What a summary says of the run itself."""
    return {
        "env": cfg.env.name,
        "gap": cfg.gap,
        "gap_fix": cfg.get("gap_fix"),
        "data": cfg.data,
        "transitions": len(real),
        **({key: cfg[key] for key in H2O_PLUS_S} if cfg.get("method", "h2o_plus") == "h2o_plus" else {}),
        "seed": cfg.seed,
    }
