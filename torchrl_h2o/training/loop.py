"""The loop that every method goes through: simulate, update, look at it, again and again."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from copy import deepcopy
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch.optim.lr_scheduler import LinearLR
from torchrl.data import TensorSpec

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.collection import collecting
from torchrl_h2o.training.compiling import maybe_compiled
from torchrl_h2o.training.environments import as_observed, learning_reward, make_reality, make_simulator
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.returns import evaluate
from torchrl_h2o.training.run_folder import Training, keeps_best, num_epochs

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

    One that learns from real data alone has no simulator: nothing is simulated, and no policy chosen there.

    Args:
        make_learner: from the configuration, the size of the observation, the action's spec and the data.
        cfg: the run's configuration.
        replay: its data, the real ones as the learner sees them. The networks are where it is; the simulator stays on
            the CPU, with a copy of the policy.
    """

    def __init__(self, make_learner: MakeLearner, cfg: DictConfig, replay: HybridReplayBuffer) -> None:
        self.cfg = cfg
        self._reality = make_reality(cfg, cfg.eval_episodes)
        observation_dim = self._reality.observation_spec["observation"].shape[-1]
        with replay.device:
            action_spec = self._reality.action_spec_unbatched.to(replay.device)
            self.learner = make_learner(cfg, observation_dim, action_spec, replay)
        self._actor = self.learner.actor if replay.device.type == "cpu" else deepcopy(self.learner.actor).cpu()
        self.components = self.learner.components
        self._open = ExitStack()
        self._collector = self._trials = None
        if self.learner.simulates:
            simulator = make_simulator(cfg, cfg.num_worlds)
            self._collector = self._open.enter_context(collecting(cfg, simulator, self._actor, replay.keys))
            self._rollouts = iter(self._collector)
            if keeps_best(cfg):
                self._trials = make_simulator(cfg, cfg.eval_episodes)
                self.components["policy"] = deepcopy(self._actor)

    @property
    def policy(self) -> torch.nn.Module:
        """The one that ``keep`` asks for."""
        return self.actor if self._trials is None else self.components["policy"]

    @property
    def actor(self) -> torch.nn.Module:
        """The policy that is trained, as it is now, where the simulator is."""
        self._catch_up()
        return self._actor

    def _catch_up(self) -> None:
        if self._actor is not self.learner.actor:
            self._actor.load_state_dict(self.learner.actor.state_dict())

    def begin_epoch(self, epoch: int) -> None:
        """Starts the epoch's random streams, torch's and the simulator's, and simulates its steps."""
        seed = int(np.random.SeedSequence((self.cfg.seed, epoch)).generate_state(1)[0])
        torch.manual_seed(seed)
        if self._collector is not None:
            self._collector.set_seed(seed % 2**31)
            self._simulate()

    def _simulate(self) -> None:
        """An epoch's steps of the policy in the simulator, into the replay buffer."""
        self._catch_up()
        self._collector.update_policy_weights_()
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
        if self._trials is not None:
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


def train(method: Method, cfg: DictConfig, real: TensorDictBase, directory: Path) -> tuple[torch.nn.Module, Training]:
    """Trains one method.

    Args:
        method: what it learns with.
        cfg: the run's configuration.
        real: the measured transitions.
        directory: the run's folder.

    Returns:
        The policy that ``keep`` asks for, and the training with its metrics.
    """
    real = as_observed(cfg, real)  # both streams show observations and rewards in the same way
    replay = HybridReplayBuffer(real, sim_capacity=int(cfg.sim_capacity * len(real)), batch_size=cfg.batch_size)
    trainee = Trainee(method.make_learner, cfg, replay)
    learner = trainee.learner
    learner.terms_of = maybe_compiled(cfg, learner.terms_of, pays=learner.pays_to_compile)
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=num_epochs(cfg))
    training = Training(method.title, cfg, directory, **trainee.components, schedule=schedule)
    with closing(trainee):
        for epoch, evaluating in training.epochs():
            trainee.begin_epoch(epoch)
            for _ in training.epoch_updates():
                losses = learner.update()
            schedule.step()
            if evaluating:
                figures = {name: loss.item() for name, loss in losses.items()}
                training.log(epoch, **trainee.look(training.rows), **figures)
    return trainee.policy, training
