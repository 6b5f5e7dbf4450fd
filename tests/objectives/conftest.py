"""Small seeded networks and batches for the tests of the losses; float64 by default."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from torchrl_h2o.objectives import (
    ConservativeLoss,
    DynamicsModelLoss,
    DynamicsRatioLoss,
    ExpectileValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    RepresentationLoss,
    make_actor,
    make_dynamics_model,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_representation_deviation,
    make_value,
)

OBSERVATION_DIM, ACTION_DIM = 3, 2
CELLS = (8, 8)


def _spread(module: torch.nn.Module) -> torch.nn.Module:
    """Draws all parameters anew: last layers start near zero, where a missing term would go unnoticed."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.5)
    return module


def make_batch(num_real: int = 4, num_sim: int = 3, seed: int = 0, dtype=torch.float64) -> TensorDict:
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=rng, dtype=dtype)

    size = num_real + num_sim
    terminated = torch.arange(size)[:, None] % 3 == 0
    truncated = torch.arange(size)[:, None] % 3 == 1
    return TensorDict(
        observation=normal(size, OBSERVATION_DIM),
        action=torch.tanh(normal(size, ACTION_DIM)),
        real=torch.arange(size) < num_real,
        next=TensorDict(
            observation=normal(size, OBSERVATION_DIM),
            reward=normal(size, 1),
            terminated=terminated,
            truncated=truncated,
            done=terminated | truncated,
        ),
        batch_size=size,
    )


class Parts:
    """Newly built networks of one seed, and the losses that use them."""

    def __init__(self, seed: int = 0, dtype=torch.float64) -> None:
        torch.manual_seed(seed)
        self.dtype = dtype
        self.actor = self._own(make_actor(OBSERVATION_DIM, Bounded(-1, 1, (ACTION_DIM,), dtype=dtype), CELLS))
        self.qvalues = [self._own(make_qvalue(OBSERVATION_DIM, ACTION_DIM, CELLS)) for _ in range(2)]
        self.value = self._own(make_value(OBSERVATION_DIM, CELLS))
        self.estimator = self._own(make_dynamics_ratio_estimator(OBSERVATION_DIM, ACTION_DIM, CELLS))
        self.representation = self._own(make_representation_deviation(OBSERVATION_DIM, ACTION_DIM, CELLS))
        self.models = [
            self._own(model) for model in make_dynamics_model(OBSERVATION_DIM, ACTION_DIM, CELLS, ensemble=3)
        ]

    def _own(self, module: torch.nn.Module) -> torch.nn.Module:
        return _spread(module).to(self.dtype)

    def bellman(self, **kwargs) -> MixedBellmanLoss:
        return _move_targets(MixedBellmanLoss(self.actor, self.qvalues, self.value, **kwargs))

    def h2o_plus(
        self, value_loss=ExpectileValueLoss, ratio: bool = True, delay_estimator: bool = False, **kwargs
    ) -> H2OPlusLoss:
        ratio_loss = DynamicsRatioLoss(self.estimator, delay_estimator=delay_estimator) if ratio else None
        own, bellman = _split(kwargs)
        bellman_loss = MixedBellmanLoss(self.actor, self.qvalues, self.value, **bellman)
        return _move_targets(H2OPlusLoss(bellman_loss, value_loss(self.value), ratio_loss, **own))

    def sac(self, **kwargs) -> H2OPlusLoss:
        own, bellman = _split(kwargs)
        return _move_targets(H2OPlusLoss(MixedBellmanLoss(self.actor, self.qvalues, mixing=0.0, **bellman), **own))


def _split(kwargs: dict) -> tuple[dict, dict]:
    """Splits keyword arguments into those of H2OPlusLoss and those of its MixedBellmanLoss."""
    own = {key: kwargs[key] for key in ("weighted", "fixed_alpha", "cloning", "target_entropy") if key in kwargs}
    return own, {key: value for key, value in kwargs.items() if key not in own}


def _move_targets(loss):
    """Moves the target networks away from the online ones, so that a test fails if a loss uses the wrong one."""
    with torch.no_grad():
        for target in loss.target_qvalue_network_params.values(True, True):
            target.add_(0.1 * torch.randn_like(target))
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    return loss


#: one loss of each kind, made of the same networks
LOSSES = {
    "value": lambda parts: ExpectileValueLoss(parts.value),
    "ratio": lambda parts: DynamicsRatioLoss(parts.estimator),
    "bellman": lambda parts: parts.bellman(),
    "h2o_plus": lambda parts: parts.h2o_plus(),
    "cloning": lambda parts: parts.sac(cloning=5.0),
    "representation": lambda parts: RepresentationLoss(parts.representation),
    "dynamics": lambda parts: DynamicsModelLoss(parts.models),
    "conservative": lambda parts: ConservativeLoss(parts.sac()),
}


@pytest.fixture
def parts() -> Parts:
    return Parts()


@pytest.fixture
def batch() -> TensorDict:
    return make_batch()
