"""The option ``warm_start``: a training begins at the behaviour in the real data, and its critics learn that first."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.optim.lr_scheduler import LinearLR
from torchrl.data import TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.objectives import BCLoss

CLONED = 2000  # updates of behaviour cloning
ROWS = 256  # transitions of each
LR = 1e-3  # at the first of them; it falls to zero
HELD = 1000  # first updates of a training in which the cloned policy stays as it is
INSIDE = 1e-3  # share of their range by which actions at its ends are moved inside, because a tanh never reaches them


def clone_behaviour(actor: TensorDictModule, action_spec: TensorSpec, real: TensorDictBase, seed: int) -> None:
    """Fits a policy to the actions in real data, with TorchRL's loss.

    Args:
        actor: the policy.
        action_spec: spec of the actions.
        real: the measured transitions with the run's preprocessing, ``[T]``.
        seed: the run's seed.
    """
    generator = torch.Generator().manual_seed(seed)
    loss, shown = BCLoss(actor), real.select(*actor.in_keys, "action")
    space = cast(ContinuousBox, action_spec.space)
    low, high = space.low.to(real.device), space.high.to(real.device)
    edge = INSIDE * (high - low)
    shown["action"] = shown["action"].clamp(low + edge, high - edge)
    optimiser = torch.optim.Adam(loss.parameters(), lr=LR)
    schedule = LinearLR(optimiser, 1.0, 0.0, total_iters=CLONED)
    for _ in range(CLONED):
        chosen = torch.randint(len(shown), (min(ROWS, len(shown)),), generator=generator)
        loss(shown[chosen])["loss_bc"].backward()
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
