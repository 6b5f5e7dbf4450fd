"""Trains H2O+ from real data and an imperfect simulator, and shows what its policy does in reality.

python recipes/h2o_plus.py                                             # the wheel-legged robot, nothing downloaded
python recipes/h2o_plus.py data=standing_still.txt                     # the same with the real robot's log
python recipes/h2o_plus.py env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0
python recipes/h2o_plus.py gap_fix=outputs/close_the_loop/.../report.json     # in the simulator, mended
python recipes/h2o_plus.py backbone=sparse mixing=0.5 ratio=false      # anything in config/ can be overridden
python recipes/h2o_plus.py resume=outputs/wheel_legged/...             # go on after an interruption
"""

import quiet  # noqa: F401, I001  (before the packages that it keeps quiet)

import os
import sys
import time
from pathlib import Path

import hydra
import torch
from collection import check_collector
from environments import make_reality, make_simulator, measure_observation_norm
from evaluation import evaluate
from learner import Learner, adam
from learning_curve import draw_learning_curve
from omegaconf import DictConfig
from real_data import behaviour_in, read_real_data
from rendering import try_to_film
from results import print_table
from run import Training, open_run, save_config, write_summary
from sac import train_sac
from tensordict import TensorDictBase
from torch.nn.functional import pad
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate
from training import train

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    InSampleValueLoss,
    SparseValueLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
)


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """The method: real and simulated batches, one loss, one optimiser."""
    torch.manual_seed(cfg.seed)
    action_dim = action_spec.shape[-1]

    # Networks. Each is held by the loss that trains it.
    actor = make_actor(observation_dim, action_spec, cfg.num_cells)
    qvalues = [make_qvalue(observation_dim, action_dim, cfg.num_cells) for _ in range(2)]
    value_loss = make_value_loss(cfg, observation_dim)
    estimator = make_dynamics_ratio_estimator(observation_dim, action_dim, cfg.num_cells)

    # Losses. The discriminators have batches of their own, so their loss stands beside H2O+'s.
    num_real, _ = cfg.batch_size
    loss = H2OPlusLoss(
        actor, qvalues, value_loss, mixing=cfg.mixing, target_entropy=cfg.target_entropy, num_real=num_real
    )
    loss.make_value_estimator(gamma=cfg.gamma)
    ratio_loss = DynamicsRatioLoss(estimator, input_noise=cfg.input_noise)

    def terms_of(batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, torch.Tensor]:
        ratio_losses = ratio_loss(pairs)
        if cfg.ratio:
            simulated = estimator(batch[num_real:])  # Eq. (9)
            batch["dynamics_ratio"] = pad(simulated["dynamics_ratio"], (num_real, 0), value=1.0)
        return {**loss(batch), **ratio_losses}

    def figures(batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, float]:
        return {"ratio_of_sim": float(estimator(batch)["dynamics_ratio"][~batch["real"]].mean())}

    return Learner(
        actor,
        {"loss": loss, "ratio_loss": ratio_loss},
        adam(loss, ratio_loss, lr=cfg.lr),
        SoftUpdate(loss, tau=cfg.tau),
        replay,
        [cfg.batch_size, cfg.discriminator_batch_size],
        terms_of,
        figures,
    )


def train_h2o_plus(cfg: DictConfig, real: TensorDictBase, directory: Path) -> tuple[torch.nn.Module, Training]:
    """Real and simulated data, the simulator's weighed by how real they look."""
    return train("H2O+", make_learner, cfg, real, directory)


def make_value_loss(cfg: DictConfig, observation_dim: int) -> InSampleValueLoss:
    """The backbone: swapping it is one argument."""
    value_network = make_value(observation_dim, cfg.num_cells)
    if cfg.backbone == "expectile":
        return ExpectileValueLoss(value_network, cfg.expectile)
    if cfg.backbone == "sparse":
        return SparseValueLoss(value_network, cfg.value_alpha)
    if cfg.backbone == "exponential":
        return ExponentialValueLoss(value_network, cfg.value_alpha)
    raise ValueError(f"backbone={cfg.backbone}: choose expectile, sparse or exponential")


@hydra.main(config_path="config", config_name="h2o_plus", version_base=None)
def main(cfg: DictConfig) -> None:
    cfg, directory = open_run(cfg)
    try:
        run(cfg, directory)
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted; go on with: python {sys.argv[0]} resume={os.path.relpath(directory)}")


def run(cfg: DictConfig, directory: Path) -> None:
    """Trains, evaluates in reality, and leaves summary.json, metrics.csv, learning_curve.png and a film."""
    start = time.perf_counter()
    make_value_loss(cfg, observation_dim=1)  # what there is not, backbone, gap or report: said before the data are read
    make_simulator(cfg, raw=True)
    check_collector(cfg)
    real = read_real_data(cfg)
    measure_observation_norm(cfg, real)
    save_config(cfg, directory)
    wall_s = time.perf_counter() - start

    policies, trainings = {}, {}
    policies["H2O+"], trainings["H2O+"] = train_h2o_plus(cfg, real, directory)
    if cfg.baseline:
        policies["SAC in the simulator"], trainings["SAC in the simulator"] = train_sac(cfg, real, directory)
    wall_s += sum(training.progress["seconds"] for training in trainings.values())

    # What the policies do in reality, and in the simulator that they were trained in.
    start = time.perf_counter()
    reality, simulator = make_reality(cfg, cfg.final_episodes), make_simulator(cfg, 1)
    in_reality = {name: evaluate(reality, policy, cfg.final_episodes) for name, policy in policies.items()}
    in_simulator = evaluate(simulator, policies["H2O+"], 1)
    behaviour = behaviour_in(cfg, real)
    draw_learning_curve(directory / "learning_curve.png", trainings, behaviour.mean, cfg)
    write_summary(
        directory,
        {
            "env": cfg.env.name,
            "gap": cfg.gap,
            "gap_fix": cfg.get("gap_fix"),
            "data": cfg.data,
            "transitions": len(real),
            "backbone": cfg.backbone,
            "mixing": cfg.mixing,
            "ratio": cfg.ratio,
            "seed": cfg.seed,
            "updates": trainings["H2O+"].updates,
            "return_real": in_reality["H2O+"].summary(),
            "return_sim": in_simulator.summary(),
            "return_data": behaviour.summary(),
            "baselines": {name: in_reality[name].summary() for name in policies if name != "H2O+"},
            "updates_per_second": trainings["H2O+"].updates_per_second,
            "wall_s": wall_s + time.perf_counter() - start,
        },
    )
    film = try_to_film(cfg, policies["H2O+"], directory) if cfg.render else None
    print_table(cfg, in_reality | {"the data's behaviour": behaviour}, directory, film)


if __name__ == "__main__":
    main()
