"""The loop that every method goes through: simulate, update, look at it, again and again."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from copy import deepcopy
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Method:
    """What tells one method from another.

    Args:
        title: what bars, tables and checkpoints call it.
        make_learner: from the configuration, the size of the observation, the action's spec and the data.
    """

    title: str
    make_learner: MakeLearner


class Trainee:
    """A policy in training: what it learns with, its data, the simulator that it acts in, and how it is looked at.

    Args:
        make_learner: from the configuration, the size of the observation, the action's spec and the data.
        cfg: the run's configuration.
        replay: its data, the real ones as the learner sees them. The networks are where it is; the simulator stays on
            the CPU, with a copy of the policy.
    """

    def __init__(self, make_learner: MakeLearner, cfg: DictConfig, replay: HybridReplayBuffer) -> None:
        self.cfg = cfg
        simulator, self._reality = make_simulator(cfg, cfg.num_worlds), make_reality(cfg, cfg.eval_episodes)
        self._trials = make_simulator(cfg, cfg.eval_episodes)
        observation_dim = simulator.observation_spec["observation"].shape[-1]
        with replay.device:
            action_spec = simulator.action_spec_unbatched.to(replay.device)
            self.learner = make_learner(cfg, observation_dim, action_spec, replay)
        self._actor = self.learner.actor if replay.device.type == "cpu" else deepcopy(self.learner.actor).cpu()
        self.components = self.learner.components
        if keeps_best(cfg):
            self.components["policy"] = deepcopy(self._actor)
        self._open = ExitStack()
        self.collector = self._open.enter_context(collecting(cfg, simulator, self._actor, replay.keys))
        self._rollouts = iter(self.collector)

    @property
    def policy(self) -> torch.nn.Module:
        """The one that ``keep`` asks for."""
        return self.components["policy"] if keeps_best(self.cfg) else self.actor

    @property
    def actor(self) -> torch.nn.Module:
        """The policy that is trained, as it is now, where the simulator is."""
        self._catch_up()
        return self._actor

    def _catch_up(self) -> None:
        if self._actor is not self.learner.actor:
            self._actor.load_state_dict(self.learner.actor.state_dict())

    def simulate(self) -> None:
        """An epoch's steps of the policy in the simulator, into the replay buffer."""
        self._catch_up()
        self.collector.update_policy_weights_()
        simulated = next(self._rollouts).reshape(-1)
        simulated["next", "reward"] = learning_reward(self.cfg, simulated["next", "reward"])
        self.learner.replay.extend(simulated)

    def look(self, rows: list[dict]) -> dict[str, float]:
        """What the policy does now; takes it as the one to keep if it is the best in the simulator.

        Args:
            rows: what this gave before.
        """
        actor, promised = self.actor, {}
        evaluation = evaluate(self._reality, actor, self.cfg.eval_episodes)
        if keeps_best(self.cfg):
            promised["return_sim"] = evaluate(self._trials, actor, self.cfg.eval_episodes).mean
            if promised["return_sim"] >= max((row["return_sim"] for row in rows), default=-inf):
                self.components["policy"].load_state_dict(actor.state_dict())
        return {
            **promised,
            "return_real": evaluation.mean,
            "return_real_std": evaluation.std,
            "length_real": evaluation.mean_length,
            **self.learner.figures(*self.learner.batches),
        }

    def close(self) -> None:
        """Ends the collector's workers."""
        self._open.close()


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
    real = as_observed(cfg, real)  # both streams show observations and rewards in the same way
    replay = HybridReplayBuffer(real, sim_capacity=int(cfg.sim_capacity * len(real)), batch_size=cfg.batch_size)
    trainee = Trainee(make_learner, cfg, replay)
    learner = trainee.learner
    if cfg.get("compiled", False):  # a run of an earlier version says nothing of it
        learner.terms_of = torch.compile(learner.terms_of)
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=num_epochs(cfg))
    training = Training(name, cfg, directory, **trainee.components, schedule=schedule)
    with closing(trainee):
        for epoch, evaluating in training.epochs(trainee.collector):
            if learner.simulates:
                trainee.simulate()
            for _ in training.epoch_updates():
                losses = learner.update()
            schedule.step()
            if evaluating:
                figures = {name: loss.item() for name, loss in losses.items()}
                training.log(epoch, **trainee.look(training.rows), **figures)
    return trainee.policy, training
