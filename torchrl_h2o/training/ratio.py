"""The estimator of the dynamics ratio that ``ratio_estimator`` names, its loss, and the pairs that train it.

``paper``: the authors' two discriminators, trained on the batches of the replay buffer. ``change``: the same with the
normalised change s' - s as input, noise on this change only, and unbounded logits given (s, a). ``pairs``: one
discriminator, trained on the real transitions and on what the run's simulator makes of the same states and actions.
The ratio of ``change`` and ``pairs`` can be that of averaged discriminators, which has less noise.
"""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.data import HybridReplayBuffer, PairedTransitions
from torchrl_h2o.objectives import DynamicsRatioLoss, fit_change_scale, make_dynamics_ratio_estimator
from torchrl_h2o.residuals import Simulation, simulate_transitions
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.task import Task

CHANGE_NOISE = {"change": 1.0, "pairs": 0.05}  # change_noise=auto


def make_ratio_loss(
    cfg: DictConfig, observation_dim: int, action_dim: int, replay: HybridReplayBuffer, *, delayed: bool = False
) -> DynamicsRatioLoss:
    """Builds the estimator named in the configuration, and the loss that holds and trains it.

    Args:
        cfg: the run's configuration.
        observation_dim: size of the observation.
        action_dim: size of the action.
        replay: the preprocessed data, from which the scale of the change of the observation is measured.
        delayed: whether ``change`` and ``pairs`` use averaged discriminators, for methods whose ``SoftUpdate`` averages
            them. ``paper`` never does, as in the authors' code.
    """
    following = replay.next_observation
    sizes = observation_dim, action_dim, cfg.num_cells
    if cfg.ratio_estimator == "paper":
        estimator = make_dynamics_ratio_estimator(*sizes, next_observation=following)
        return DynamicsRatioLoss(estimator, input_noise=cfg.input_noise)
    change = {
        "next_observation": following,
        "change_scale": fit_change_scale(replay.real[:], next_observation=following),
    }
    noise = CHANGE_NOISE[cfg.ratio_estimator] if cfg.change_noise == "auto" else cfg.change_noise
    if cfg.ratio_estimator == "change":
        estimator = make_dynamics_ratio_estimator(*sizes, **change, logit_bound=(None, cfg.ratio_logit_bound))
        return DynamicsRatioLoss(estimator, input_noise={following: noise}, delay_estimator=delayed)
    estimator = make_dynamics_ratio_estimator(
        *sizes, **change, with_sa_network=False, logit_bound=cfg.ratio_logit_bound
    )
    return DynamicsRatioLoss(
        estimator,
        input_noise={following: noise},
        weight_penalty=cfg.ratio_weight_penalty,
        delay_estimator=delayed,
    )


def make_pairs(
    cfg: DictConfig, task: Task, real: TensorDictBase, preprocessing: Preprocessing, replay: HybridReplayBuffer
) -> PairedTransitions | None:
    """Simulates the real transitions, if the estimator is trained on pairs.

    Random effects have a fixed seed, so a resumed run has the same pairs.

    Args:
        cfg: the run's configuration.
        task: the task, with the run's simulator.
        real: the measured transitions in physical units, ``[T]``.
        preprocessing: of the run.
        replay: gives the entry that holds the next observation, and the device.

    Returns:
        The pairs, or None for an estimator that is trained on the replay buffer.

    Raises:
        ValueError: if the state of the simulator cannot be set from the task's observation.
    """
    if cfg.ratio_estimator != "pairs":
        return None
    simulation = Simulation.from_env(task.make_simulator())
    following = simulate_transitions(simulation, real)
    shown = preprocessing.apply(real)
    simulated_next = preprocessing.next_observation(shown, following)
    original = shown.select("observation", "action").set(replay.next_observation, shown["next", "observation"])
    return PairedTransitions(
        original, simulated_next, next_observation=replay.next_observation, device=torch.device(replay.device)
    )
