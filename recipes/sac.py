"""SAC in the simulator alone: TorchRL's own loss, on the same budget. What zero-shot transfer comes to."""

from pathlib import Path

import torch
from environments import as_observed, learning_reward, make_reality, make_simulator
from evaluation import evaluate
from learner import Learner, adam
from omegaconf import DictConfig
from run import Training, num_epochs
from tensordict import TensorDictBase
from torch.optim.lr_scheduler import LinearLR
from torchrl.collectors import Collector
from torchrl.data import TensorSpec
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import make_actor, make_qvalue


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """TorchRL's loss, on simulated rows alone."""
    torch.manual_seed(cfg.seed)
    actor = make_actor(observation_dim, action_spec, cfg.num_cells)
    qvalues = [make_qvalue(observation_dim, action_spec.shape[-1], cfg.num_cells) for _ in range(2)]
    loss = SACLoss(actor, qvalues, loss_function="l2", target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)
    targets = SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, {"loss": loss}, adam(loss, lr=cfg.lr), targets, replay, [(0, sum(cfg.batch_size))], loss)


def train_sac(cfg: DictConfig, real: TensorDictBase, directory: Path) -> tuple[torch.nn.Module, Training]:
    """SAC on simulated batches; of the real data it sees nothing but the scale of the observations."""
    simulator, reality = make_simulator(cfg), make_reality(cfg)
    replay = HybridReplayBuffer(as_observed(cfg, real), sim_capacity=int(cfg.sim_capacity * len(real)))
    observation_dim = simulator.observation_spec["observation"].shape[-1]
    learner = make_learner(cfg, observation_dim, simulator.action_spec_unbatched, replay)
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=num_epochs(cfg))
    collector = Collector(simulator, learner.actor, frames_per_batch=cfg.steps_per_epoch, reset_at_each_iter=True)
    rollouts = iter(collector)

    training = Training("SAC in the simulator", cfg, directory, **learner.components, schedule=schedule)
    for epoch, evaluating in training.epochs(simulator):
        simulated = next(rollouts)
        simulated["next", "reward"] = learning_reward(cfg, simulated["next", "reward"])
        replay.extend(simulated)
        for _ in training.epoch_updates():
            losses = learner.update()
        schedule.step()
        if evaluating:
            evaluation = evaluate(reality, learner.actor, cfg.eval_episodes)
            training.log(
                epoch,
                return_real=evaluation.mean,
                return_real_std=evaluation.std,
                length_real=evaluation.mean_length,
                **{name: value.item() for name, value in losses.items()},
            )
    collector.shutdown()
    return learner.actor, training
