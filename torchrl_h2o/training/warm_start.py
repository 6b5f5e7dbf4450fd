"""The option ``warm_start``: a training begins at the data's behaviour or an earlier policy, and critics learn it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeGuard, cast

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.optim.lr_scheduler import LinearLR
from torchrl.data import TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.objectives import BCLoss

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.trained_policy import load_policy

CLONED = 2000  # updates of behaviour cloning
ROWS = 256  # transitions of each
LR = 1e-3  # at the first of them; it falls to zero
INSIDE = 0.01  # share of the actions' range within which an action is at its limit, which a tanh does not reach
HELD = 1000  # first updates of a training in which the cloned policy stays as it is


def begin(cfg: DictConfig, actor: TensorDictModule, action_spec: TensorSpec, replay: HybridReplayBuffer) -> None:
    """Sets a policy to where ``warm_start`` begins: the behaviour in the real data, or the policy of an earlier run.

    Args:
        cfg: the run's configuration.
        actor: the policy.
        action_spec: spec of the actions.
        replay: the buffer with the real rows.

    Raises:
        ValueError: if the earlier policy has other inputs or layers.
    """
    if not names_run(cfg.warm_start):
        if cfg.warm_start:
            clone_behaviour(actor, action_spec, replay, cfg.seed)
        return
    from torchrl_h2o.training.methods import METHODS  # the methods import this module

    earlier = load_config(cfg.warm_start, typed=cfg)
    policy = load_policy(earlier, cfg.warm_start, METHODS[earlier.method].title)
    try:
        actor.load_state_dict(policy.state_dict())
    except RuntimeError:
        raise ValueError(
            f"warm_start={cfg.warm_start}: its policy has other inputs or layers; set env, num_cells, frames and "
            "action_history as in that run"
        ) from None


def names_run(warm_start: bool | str) -> TypeGuard[str]:
    """Whether the option ``warm_start`` names an earlier run."""
    return isinstance(warm_start, str)


def prepare_warm_start(cfg: DictConfig) -> None:
    """Takes the normalisation of the observations from the run whose policy ``warm_start`` names."""
    if names_run(cfg.warm_start):
        cfg.observation_norm = load_config(cfg.warm_start, typed=cfg).observation_norm


def clone_behaviour(actor: TensorDictModule, action_spec: TensorSpec, replay: HybridReplayBuffer, seed: int) -> None:
    """Fits a policy to the actions in real data, with TorchRL's loss.

    Args:
        actor: the policy.
        action_spec: spec of the actions. Actions at its limits are moved a little inside, because a few of them would
            outweigh all others.
        replay: the buffer with the real rows.
        seed: the run's seed.
    """
    space = cast(ContinuousBox, action_spec.space)
    edge = INSIDE * (space.high - space.low)
    low, high = (limit.to(replay.device) for limit in (space.low + edge, space.high - edge))
    generator = torch.Generator(replay.device).manual_seed(seed)
    loss = BCLoss(actor)
    optimiser = torch.optim.Adam(loss.parameters(), lr=LR)
    schedule = LinearLR(optimiser, 1.0, 0.0, total_iters=CLONED)
    for _ in range(CLONED):
        batch = replay.sample((ROWS, 0), generator=generator)
        batch["action"] = batch["action"].clamp(low, high)
        loss(batch)["loss_bc"].backward()
        optimiser.step()
        optimiser.zero_grad()
        schedule.step()


def held_updates(cfg: DictConfig) -> int:
    """Number of first updates in which the policy stays as it is: none without ``warm_start``, at most half of all."""
    return min(HELD, cfg.updates // 2) if cfg.warm_start else 0


def hold(parameters: Iterable[Tensor], optimiser: torch.optim.Optimizer) -> None:
    """Sets the gradients of a policy's parameters to zero, so that Adam, which has not moved them yet, leaves them.

    The optimiser's count of steps begins anew as well: without its correction for few steps, the first real ones would
    be several times too large.
    """
    for parameter in parameters:
        if parameter.grad is not None:
            parameter.grad.zero_()
        if "step" in optimiser.state[parameter]:
            optimiser.state[parameter]["step"].zero_()
