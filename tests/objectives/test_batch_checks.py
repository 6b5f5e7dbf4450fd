"""Losses refuse a batch that would change a result without an error, and name the entry, its shape or its dtype."""

import re

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import TD3Loss

from tests.objectives import conftest
from tests.objectives.conftest import CELLS, Parts, make_batch
from torchrl_h2o.objectives import (
    ConservativeLoss,
    DynamicsRatioLoss,
    DynamicsRewardCorrection,
    ExpectileValueLoss,
    ImportanceWeightedLoss,
    MixedBellmanLoss,
    make_actor,
    make_qvalue,
    make_value,
)


def weighted_td3(parts):
    loss = TD3Loss(parts.actor, parts.qvalues, action_spec=parts.actor.spec["action"], reduction="none")
    return ImportanceWeightedLoss(loss)


LOSSES = {
    **conftest.LOSSES,
    "sac": lambda parts: parts.sac(),
}
losses = pytest.mark.parametrize("name", LOSSES)
bootstrapping = pytest.mark.parametrize("name", ["bellman", "h2o_plus", "sac", "conservative"])


def full_batch(**kwargs):
    batch = make_batch(**kwargs)
    rows = torch.linspace(-1, 1, len(batch), dtype=batch["observation"].dtype)
    return batch.update({"state_action_value": rows[:, None], "dynamics_ratio": rows.abs()})


def wide(batch, key, width):
    return batch.set(key, torch.zeros(len(batch), width, dtype=torch.float64))


@losses
@pytest.mark.parametrize("dtype", [torch.float64, torch.long, torch.uint8])
def test_a_mark_of_real_rows_that_is_not_boolean_is_refused(name, dtype):
    batch = full_batch()
    batch["real"] = batch["real"].to(dtype)
    with pytest.raises(ValueError, match=rf"'real' is {dtype}, expected torch.bool: write .*\.bool\(\)"):
        LOSSES[name](Parts())(batch)


@bootstrapping
@pytest.mark.parametrize("value", [0.0, 0.5, float("nan")])
def test_terminated_that_is_not_boolean_is_refused(name, value):
    batch = full_batch()
    batch["next", "terminated"] = torch.full((len(batch), 1), value, dtype=torch.float64)
    with pytest.raises(
        ValueError, match=r"\('next', 'terminated'\) is torch.float64, expected torch.bool: write .*\.bool\(\)"
    ):
        LOSSES[name](Parts())(batch)


@losses
def test_an_empty_batch_is_refused(name):
    with pytest.raises(ValueError, match=r"the batch has the shape \[0\], so it is empty"):
        LOSSES[name](Parts())(full_batch()[:0])


@losses
def test_a_batch_without_one_of_the_streams_is_accepted(name):
    for batch in (full_batch(num_real=0), full_batch(num_sim=0)):
        assert all(value.isfinite().all() for value in LOSSES[name](Parts())(batch).values())


@bootstrapping
def test_an_action_of_another_size_is_named_with_both_shapes(name):
    with pytest.raises(ValueError, match=r"the batch has 'action' \[7, 5\], expected \[7, 2\]: the networks"):
        LOSSES[name](Parts())(wide(full_batch(), "action", 5))


@losses
def test_an_observation_of_another_size_is_named(name):
    with pytest.raises(ValueError, match=r"'observation' \[7, 4\].*expected"):
        LOSSES[name](Parts())(wide(full_batch(), "observation", 4))


@pytest.mark.parametrize("name", ["ratio", "bellman", "h2o_plus", "conservative"])
def test_a_next_observation_of_another_size_is_named_with_both_shapes(name):
    with pytest.raises(ValueError, match=r"\('next', 'observation'\) \[7, 4\], expected \[7, 3\]"):
        LOSSES[name](Parts())(wide(full_batch(), ("next", "observation"), 4))


def test_sizes_that_cancel_are_refused():
    batch = wide(wide(full_batch(), "observation", 4), "action", 1)  # together as many as the Q network reads
    with pytest.raises(ValueError, match=r"'observation' \[7, 4\], expected \[7, 3\]"):
        Parts().bellman()(batch)


def test_entries_whose_single_sizes_are_unknown_are_named_together():
    loss, batch = DynamicsRatioLoss(Parts().estimator), wide(full_batch(), "action", 5)
    with pytest.raises(ValueError, match=r"'observation' \[7, 3\] and 'action' \[7, 5\], .* 8 in total, expected 5"):
        loss(batch)
    with pytest.raises(ValueError, match=r"DynamicsRatioEstimator: .* 8 in total, expected 5"):
        loss.estimator(batch)


def test_pairs_are_checked_like_the_batch():
    loss, pairs = Parts().h2o_plus(), wide(full_batch(), "action", 5)
    with pytest.raises(ValueError, match="8 in total, expected 5"):
        loss(full_batch(), pairs)
    with pytest.raises(ValueError, match=r"'real' is torch.int64"):
        loss(full_batch(), full_batch().set("real", torch.ones(7, dtype=torch.long)))


@losses
@pytest.mark.parametrize("dtype", [torch.float32, torch.long])
def test_observations_of_another_dtype_than_the_networks_are_named(name, dtype):
    batch = full_batch()
    batch["observation"] = batch["observation"].to(dtype)
    with pytest.raises(ValueError, match=f"'observation' is {dtype}, and its network was built for torch.float64"):
        LOSSES[name](Parts())(batch)


def test_under_autocast_any_floating_point_dtype_is_accepted():
    batch = make_batch(dtype=torch.bfloat16)
    loss = Parts(dtype=torch.float32).sac()
    with torch.autocast("cpu", torch.bfloat16):
        assert loss(batch)["loss_qvalue"].isfinite()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (("next", "reward"), torch.zeros(7, 7)),  # would be broadcast to [7, 7]
        (("next", "terminated"), torch.zeros(7, 2, dtype=torch.bool)),
        ("real", torch.zeros(7, 2, dtype=torch.bool)),
        ("dynamics_ratio", torch.zeros(7, 7)),
        ("priority_weight", torch.zeros(7, 7)),
        ("steps_to_next_obs", torch.ones(7, 7)),
    ],
    ids=str,
)
def test_an_entry_of_other_than_one_value_a_row_is_named(key, value):
    name = re.escape(repr(key))
    with pytest.raises(ValueError, match=rf"{name} has the shape .*expected one value per row, \[7\] or \[7, 1\]"):
        Parts().bellman()(make_batch().set(key, value))


def test_values_and_divergences_of_other_than_one_value_a_row_are_named():
    with pytest.raises(ValueError, match=r"'state_action_value' has the shape \[7, 2\]"):
        ExpectileValueLoss(Parts().value)(wide(full_batch(), "state_action_value", 2))
    with pytest.raises(ValueError, match=r"'dynamics_divergence' has the shape \[7, 2\]"):
        ConservativeLoss(Parts().sac())(wide(full_batch(), "dynamics_divergence", 2))


def test_weights_of_other_than_one_value_a_row_are_named():
    loss = weighted_td3(Parts())
    with pytest.raises(ValueError, match=r"'dynamics_ratio' has the shape \[7, 3\]"):
        loss(wide(full_batch(), "dynamics_ratio", 3))
    with pytest.raises(ValueError, match=r"'real' is torch.float64"):
        loss(full_batch().set("real", torch.full((7,), 0.5, dtype=torch.float64)))
    with pytest.raises(ValueError, match="so it is empty"):
        loss(full_batch()[:0])


def test_the_reward_correction_refuses_the_same():
    correction = DynamicsRewardCorrection(Parts().estimator)
    with pytest.raises(ValueError, match=r"DynamicsRewardCorrection: 'real' is torch.float64"):
        correction(full_batch().set("real", torch.full((7,), 0.5, dtype=torch.float64)))
    with pytest.raises(ValueError, match=r"'reward'\) has the shape \[7, 7\]"):
        correction(wide(full_batch(), ("next", "reward"), 7))


def test_networks_built_for_different_sizes_are_refused_when_the_loss_is_built():
    actor = make_actor(3, Bounded(-1, 1, (2,)), CELLS)
    with pytest.raises(ValueError, match=r"for 9 numbers of 'observation' and 'action', .* have 5 by the other"):
        MixedBellmanLoss(actor, make_qvalue(3, 6, CELLS), make_value(3, CELLS))
    with pytest.raises(ValueError, match=r"for 4 numbers of 'observation', .* have 3 by the other"):
        MixedBellmanLoss(actor, make_qvalue(3, 2, CELLS), make_value(4, CELLS))


def test_networks_of_unknown_input_size_are_not_checked():
    batch = full_batch().set("observation", torch.zeros(7, 3, dtype=torch.long))

    class Embedding(nn.Module):
        def __init__(self):
            super().__init__()
            self.embedding, self.head = nn.Embedding(5, 4), MLP(4, 1, num_cells=[8])

        def forward(self, observation):
            return self.head(self.embedding(observation[..., 0]))

    embedded = ValueOperator(Embedding().double(), in_keys=["observation"])
    assert ExpectileValueLoss(embedded)(batch)["loss_value"].isfinite()
    lazy = TensorDictModule(nn.Sequential(nn.LazyLinear(1)), in_keys=["observation"], out_keys=["state_value"])
    assert ExpectileValueLoss(lazy)(full_batch(dtype=torch.float32))["loss_value"].isfinite()
