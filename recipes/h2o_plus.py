"""Trains H2O+ from real data and an imperfect simulator, and shows what its policy does in reality.

python recipes/h2o_plus.py                                             # the wheel-legged robot, nothing downloaded
python recipes/h2o_plus.py data=standing_still.txt                     # the same with the real robot's log
python recipes/h2o_plus.py env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0
python recipes/h2o_plus.py gap_fix=outputs/close_the_loop/.../report.json     # in the simulator, mended
python recipes/h2o_plus.py backbone=sparse mixing=0.5 ratio=false      # anything in config/ can be overridden
python recipes/h2o_plus.py seeds=[0,1,2,3,4] gaps=[gravity,friction]   # ten runs at once, stacked
python recipes/h2o_plus.py resume=outputs/wheel_legged/...             # go on after an interruption
"""

import quiet  # noqa: F401, I001  (before the packages that it keeps quiet)

import time
from pathlib import Path

import hydra
import torch
from environments import make_simulator
from job import prepare, resumable, run_job
from judging import judge, judge_failed
from learner import Learner, adam, make_networks
from omegaconf import DictConfig
from population_training import members_of, train_population
from real_data import behaviour_in
from results import print_population
from run import claimed, open_run
from sac import SAC
from tensordict import TensorDictBase
from torch.nn.functional import pad
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate
from training import Method

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    InSampleValueLoss,
    SparseValueLoss,
    make_dynamics_ratio_estimator,
    make_value,
)


class H2OPlusTerms(torch.nn.Module):
    """What an update adds up: H2O+'s loss on a batch, and the discriminators' on pairs of their own."""

    def __init__(self, loss: H2OPlusLoss, ratio_loss: DynamicsRatioLoss, ratio: bool, num_real: int) -> None:
        super().__init__()
        self.loss, self.ratio_loss, self.ratio, self.num_real = loss, ratio_loss, ratio, num_real

    def forward(self, batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, torch.Tensor]:
        ratio_losses = self.ratio_loss(pairs)
        if self.ratio:
            of_simulated = self.ratio_loss.dynamics_ratio(batch[self.num_real :])  # Eq. (9)
            batch["dynamics_ratio"] = pad(of_simulated, (self.num_real, 0), value=1.0)
        return {**self.loss(batch), **ratio_losses}

    def draw_noise(
        self, batch: TensorDictBase, pairs: TensorDictBase, generator: torch.Generator | None = None
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """The noise of a forward, for the batch and for the pairs, drawn in the forward's order."""
        of_pairs = self.ratio_loss.draw_noise(pairs, generator)
        return self.loss.draw_noise(batch, generator), of_pairs


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """The method: real and simulated batches, one loss, one optimiser."""
    # Networks. Each is held by the loss that trains it.
    actor, qvalues = make_networks(cfg, observation_dim, action_spec)
    value_loss = make_value_loss(cfg, observation_dim)
    estimator = make_dynamics_ratio_estimator(observation_dim, action_spec.shape[-1], cfg.num_cells)

    # Losses. The discriminators have batches of their own, so their loss stands beside H2O+'s.
    num_real, _ = cfg.batch_size
    loss = H2OPlusLoss(
        actor, qvalues, value_loss, mixing=cfg.mixing, target_entropy=cfg.target_entropy, num_real=num_real
    )
    loss.make_value_estimator(gamma=cfg.gamma)
    ratio_loss = DynamicsRatioLoss(estimator, input_noise=cfg.input_noise)

    def figures(batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, float]:
        return {"ratio_of_sim": float(estimator(batch)["dynamics_ratio"][~batch["real"]].mean())}

    return Learner(
        actor,
        {"loss": loss, "ratio_loss": ratio_loss},
        adam(loss, ratio_loss, lr=cfg.lr),
        SoftUpdate(loss, tau=cfg.tau),
        replay,
        [cfg.batch_size, cfg.discriminator_batch_size],
        H2OPlusTerms(loss, ratio_loss, cfg.ratio, num_real),
        figures,
    )


H2O_PLUS = Method("H2O+", make_learner)


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
    make_value_loss(cfg, observation_dim=1)  # a backbone that there is not: said before the data are read
    with claimed(directory), resumable(directory):
        if members := members_of(cfg):
            run_population(cfg, members, directory)
        else:
            run_job(cfg, directory, [H2O_PLUS, SAC] if cfg.baseline else [H2O_PLUS])


def run_population(cfg: DictConfig, members: dict[str, DictConfig], directory: Path) -> None:
    """The same for many runs at once, each with its files in a folder of its own; no baseline and no films."""
    start = time.perf_counter()
    for own in members.values():
        make_simulator(own, raw=True)  # a gap that there is not
    real = prepare(cfg, directory)
    members = members_of(cfg)  # with what was measured from the data
    wall_s = time.perf_counter() - start
    outcomes = train_population(make_learner, cfg, members, real, directory)
    in_reality = {}
    for name, outcome in outcomes.items():
        own, folder = members[name], directory / name
        if outcome.failure is None:
            so_far_s = wall_s + outcome.seconds
            in_reality[name] = judge(own, real, {"H2O+": outcome.policy}, {"H2O+": outcome}, folder, so_far_s)["H2O+"]
        else:
            judge_failed(own, real, outcome.failure, folder)
            in_reality[name] = None
    print_population(cfg, in_reality | {"the data's behaviour": behaviour_in(cfg, real)}, directory)


if __name__ == "__main__":
    main()
