"""The loop that every method goes through: simulate, update, look at it, again and again."""

from collections.abc import Callable
from copy import deepcopy
from math import inf
from pathlib import Path

import torch
from collection import collecting
from environments import as_observed, learning_reward, make_reality, make_simulator
from evaluation import evaluate
from learner import Learner
from omegaconf import DictConfig
from run import Training, keeps_best, num_epochs
from tensordict import TensorDictBase
from torch.optim.lr_scheduler import LinearLR
from torchrl.data import TensorSpec

from torchrl_h2o.data import HybridReplayBuffer

MakeLearner = Callable[[DictConfig, int, TensorSpec, HybridReplayBuffer], Learner]


def train(
    name: str, make_learner: MakeLearner, cfg: DictConfig, real: TensorDictBase, directory: Path
) -> tuple[torch.nn.Module, Training]:
    """Trains one method.

    Args:
        name: what the bar and the tables call it.
        make_learner: from the configuration, the size of the observation, the action's spec and the data.
        cfg: the run's configuration.
        real: the measured transitions.
        directory: the run's folder.

    Returns:
        The policy that ``keep`` asks for, and the training with its metrics.
    """
    simulator, reality = make_simulator(cfg, cfg.num_worlds), make_reality(cfg, cfg.eval_episodes)
    trials = make_simulator(cfg, cfg.eval_episodes)
    real = as_observed(cfg, real)  # both streams show observations and rewards in the same way
    replay = HybridReplayBuffer(real, sim_capacity=int(cfg.sim_capacity * len(real)), batch_size=cfg.batch_size)
    observation_dim = simulator.observation_spec["observation"].shape[-1]
    learner = make_learner(cfg, observation_dim, simulator.action_spec_unbatched, replay)
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=num_epochs(cfg))

    components = learner.components
    if keeps_best(cfg):
        components["policy"] = deepcopy(learner.actor)
    training = Training(name, cfg, directory, **components, schedule=schedule)
    with collecting(cfg, simulator, learner.actor, replay.keys) as collector:
        rollouts = iter(collector)
        for epoch, evaluating in training.epochs(collector):
            collector.update_policy_weights_()
            simulated = next(rollouts).reshape(-1)
            simulated["next", "reward"] = learning_reward(cfg, simulated["next", "reward"])
            replay.extend(simulated)
            for _ in training.epoch_updates():
                losses = learner.update()
            schedule.step()
            if evaluating:
                evaluation = evaluate(reality, learner.actor, cfg.eval_episodes)
                promised = {}
                if keeps_best(cfg):
                    promised["return_sim"] = evaluate(trials, learner.actor, cfg.eval_episodes).mean
                    if promised["return_sim"] >= max((row["return_sim"] for row in training.rows), default=-inf):
                        components["policy"].load_state_dict(learner.actor.state_dict())
                training.log(
                    epoch,
                    **promised,
                    return_real=evaluation.mean,
                    return_real_std=evaluation.std,
                    length_real=evaluation.mean_length,
                    **learner.figures(*learner.batches),
                    **{name: value.item() for name, value in losses.items()},
                )
    return components["policy" if keeps_best(cfg) else "actor"], training
