"""The training loop of every method in ``recipes/train.py``: collect, update, evaluate."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch.optim.lr_scheduler import LinearLR
from torchrl.collectors import BaseCollector
from torchrl.data import TensorSpec

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.collection import collecting
from torchrl_h2o.training.compiling import maybe_compiled
from torchrl_h2o.training.cuda_graph import fit_to_device
from torchrl_h2o.training.environments import keeps_best, make_replay, preprocessing_of, task_of
from torchrl_h2o.training.evaluators import evaluator_of
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.ongoing_episodes import OngoingEpisodes
from torchrl_h2o.training.progress import Budget, Training, epoch_seed
from torchrl_h2o.training.ratio import make_pairs
from torchrl_h2o.training.returns import BestPolicy
from torchrl_h2o.training.warm_start import held_updates

MakeLearner = Callable[[DictConfig, int, TensorSpec, HybridReplayBuffer], Learner]


@dataclass(frozen=True)
class Method:
    """A method of the comparison.

    Args:
        title: name in progress bars, tables and checkpoint folders.
        make_learner: builds the learner from the configuration, the observation's size, the action's spec and the
            replay buffer.
    """

    title: str
    make_learner: MakeLearner


class Trainee:
    """A learner with its environments: collects in the simulator, evaluates in reality.

    For a learner that uses no simulated rows, no simulator is built: nothing is collected, and ``keep`` has no effect.

    Args:
        make_learner: see :class:`Method`.
        cfg: the run's configuration.
        replay: the preprocessed data. The networks are on the buffer's device. Simulators stay on the CPU and use a
            copy of the policy there.
    """

    def __init__(self, make_learner: MakeLearner, cfg: DictConfig, replay: HybridReplayBuffer) -> None:
        self.cfg = cfg
        task, self._preprocessing = task_of(cfg), preprocessing_of(cfg)
        reality = task.make_reality(preprocessing=self._preprocessing)
        observation_dim = reality.observation_spec["observation"].shape[-1]
        with replay.device:
            action_spec = reality.action_spec_unbatched.to(replay.device)
            self.learner = make_learner(cfg, observation_dim, action_spec, replay)
        self._actor = self.learner.actor
        if replay.device.type != "cpu":  # not a copy of the learner's, whose bounds of the action stay on the GPU
            self._actor = make_actor(observation_dim, reality.action_spec_unbatched, cfg.num_cells)
            self._copy_to_cpu()
        self.components = self.learner.components
        self.make_pairs = partial(make_pairs, cfg, task, preprocessing=self._preprocessing, replay=replay)
        self._open = ExitStack()
        self._collector = self._best = None
        if self.learner.simulates:
            simulator = task.make_training_simulator(cfg.num_worlds, self._preprocessing)
            self._collector = self._open.enter_context(collecting(cfg, simulator, self._actor, replay.stream_keys))
            self._rollouts = iter(self._collector)
            self.components["episodes"] = self._episodes = OngoingEpisodes(self._collector)
            if keeps_best(cfg):
                self._best = BestPolicy(self._actor)
                self.components["policy"] = self._best.policy
        evaluator = evaluator_of(cfg, task, self._preprocessing, self._best)
        self.evaluator = self._open.enter_context(closing(evaluator))

    @property
    def policy(self) -> torch.nn.Module:
        """The policy that the run returns: the last one, or the best in the simulator if ``keep`` requires it."""
        return self.actor if self._best is None else self._best.policy

    @property
    def actor(self) -> torch.nn.Module:
        """The trained policy with its current parameters, on the CPU."""
        self._copy_to_cpu()
        return self._actor

    def _copy_to_cpu(self) -> None:
        if self._actor is not self.learner.actor:
            self._actor.load_state_dict(self.learner.actor.state_dict())

    def begin_epoch(self, epoch: int) -> None:
        """Seeds torch and the simulator for the epoch, and collects the epoch's transitions."""
        seed = epoch_seed(self.cfg.seed, epoch)
        torch.manual_seed(seed)
        if self._collector is not None:
            self._episodes.begin_epoch(epoch, seed)
            self._collect(self._collector)

    def _collect(self, collector: BaseCollector) -> None:
        """Runs the policy in the simulator for one epoch and adds the transitions to the replay buffer."""
        self._copy_to_cpu()
        # TorchRL's overloads leave out the call without arguments, which sends the collector's own policy.
        cast(Any, collector).update_policy_weights_()
        simulated = next(self._rollouts)
        simulated["next", "reward"] = self._preprocessing.reward(simulated["next", "reward"])
        self.learner.replay.extend(simulated)

    def close(self) -> None:
        """Ends the processes of the collector and of the evaluator."""
        self._open.close()


def train(method: Method, cfg: DictConfig, real: TensorDictBase, directory: Path) -> tuple[torch.nn.Module, Training]:
    """Trains one method.

    Args:
        method: the method to train.
        cfg: the run's configuration.
        real: the measured transitions, ``[T]``.
        directory: the run's folder.

    Returns:
        The policy selected by ``keep``, and the training with its metrics.
    """
    replay = make_replay(cfg, real)
    trainee, budget = Trainee(method.make_learner, cfg, replay), Budget.from_config(cfg)
    learner = trainee.learner
    if learner.trains_discriminators:
        learner.pairs = trainee.make_pairs(real)
    if replay.device.type == "cpu":
        parameters = learner.parameters if learner.one_graph else None
        learner.terms_of = maybe_compiled(
            learner.terms_of, cfg.compiled, cfg.updates, parameters=parameters, pays=learner.pays_to_compile
        )
    elif cfg.compiled is not False:
        learner.use_cuda_graphs()
    schedule = LinearLR(learner.optimiser, 1.0, cfg.lr_end_factor, total_iters=budget.epochs)
    training = Training(method.title, directory, budget, **trainee.components, schedule=schedule)
    fit_to_device(learner.optimiser, replay.device)
    with closing(trainee):
        for epoch, evaluating in training.epochs():
            trainee.begin_epoch(epoch)
            held = held_updates(cfg) - epoch * cfg.updates_per_epoch
            for update in training.epoch_updates():
                losses = learner.update(is_held=update < held)
                training.check(losses)
            schedule.step()
            if evaluating:
                figures = learner.figures(*learner.batches)
                figures |= {name: loss.item() for name, loss in losses.items()}
                training.evaluate(trainee.evaluator, trainee.actor, epoch, **figures)
    return trainee.policy, training
