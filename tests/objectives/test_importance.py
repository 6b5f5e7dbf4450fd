"""Importance weighting: the estimator's ratio in TorchRL's own losses."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP
from torchrl.objectives import IQLLoss, SACLoss, SoftUpdate, TD3Loss

from tests.objectives.conftest import ACTION_DIM, OBSERVATION_DIM, Parts, make_batch
from torchrl_h2o.objectives import ImportanceWeightedLoss


def sac(parts):
    return SACLoss(parts.actor, parts.qvalues, reduction="none", scalar_output_mode="exclude")


def td3(parts):
    network = MLP(OBSERVATION_DIM, ACTION_DIM, num_cells=[8], activate_last_layer=True, activation_class=torch.nn.Tanh)
    actor = TensorDictModule(network.to(parts.dtype), in_keys=["observation"], out_keys=["action"])
    return TD3Loss(actor, parts.qvalues[0], action_spec=parts.actor.spec["action"], reduction="none")


def iql(parts):
    return IQLLoss(parts.actor, parts.qvalues, parts.value, reduction="none", scalar_output_mode="exclude")


@pytest.mark.parametrize("build", [sac, td3, iql])
def test_the_estimator_s_weights_drive_a_gradient_step_of(build):
    parts, batch = Parts(dtype=torch.float32), make_batch(0, 8, dtype=torch.float32)
    parts.estimator(batch)
    loss = ImportanceWeightedLoss(build(parts))
    targets = SoftUpdate(loss, tau=0.01)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before = [p.clone() for p in loss.parameters()]
    still = loss.loss.target_qvalue_network_params.clone()
    sum(loss(batch).values()).backward()
    optimiser.step()
    targets.step()
    assert all((p != q).any() for p, q in zip(before, loss.parameters(), strict=True))
    assert (loss.loss.target_qvalue_network_params != still).any()


def test_weights_are_constants_and_keys_and_discount_are_those_of_the_loss_inside(batch):
    loss = ImportanceWeightedLoss(iql(Parts()))
    batch["dynamics_ratio"] = torch.rand(batch.shape, dtype=torch.float64).requires_grad_()
    loss.make_value_estimator(gamma=0.5)
    loss.set_keys(reward="pay", real="measured")
    batch["next"].rename_key_("reward", "pay")
    batch.rename_key_("real", "measured")
    loss(batch)["loss_qvalue"].backward()
    assert batch["dynamics_ratio"].grad is None
    assert loss.loss.value_estimator.gamma == 0.5


def test_dispatch_keeps_the_weight_of_real_rows(batch):
    loss = ImportanceWeightedLoss(iql(Parts()))
    batch["dynamics_ratio"] = torch.zeros(batch.shape, dtype=torch.float64)
    expected = loss(batch)
    loss.select_out_keys("loss_value")
    tensors = {
        "_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss._dispatch_keys if k in batch.keys(True)
    }
    torch.testing.assert_close(loss(**tensors), expected["loss_value"])


def test_each_row_s_terms_are_multiplied_by_its_weight(batch):
    parts = Parts()
    del batch["real"]
    batch["dynamics_ratio"] = torch.linspace(0.0, 2.0, batch.shape[0], dtype=torch.float64)
    inner = iql(parts)
    terms = inner(batch.copy())
    losses = ImportanceWeightedLoss(inner)(batch)
    for key, value in losses.items():
        expected = sum(w * t for w, t in zip(batch["dynamics_ratio"].tolist(), terms[key].tolist(), strict=True))
        assert value.item() == pytest.approx(expected / batch.shape[0], rel=1e-12)


def test_real_rows_keep_weight_one(batch):
    parts = Parts()
    inner = iql(parts)
    batch["dynamics_ratio"] = torch.zeros(batch.shape, dtype=torch.float64)
    terms = inner(batch.copy())["loss_value"]
    weighted = ImportanceWeightedLoss(inner, reduction="none")(batch)["loss_value"]
    torch.testing.assert_close(weighted, torch.where(batch["real"], terms, 0.0))


def test_terms_that_are_not_named_are_reduced_as_they_are(batch):
    inner = iql(Parts())
    batch["dynamics_ratio"] = torch.linspace(0.0, 2.0, batch.shape[0], dtype=torch.float64)
    plain = inner(batch.copy())
    named = ImportanceWeightedLoss(inner, terms=["loss_qvalue"])(batch)
    every = ImportanceWeightedLoss(inner)(batch)
    assert set(named.keys()) == set(every.keys())
    torch.testing.assert_close(named["loss_qvalue"], every["loss_qvalue"])
    for key in ("loss_actor", "loss_value"):
        torch.testing.assert_close(named[key], plain[key].mean())
        assert not torch.allclose(named[key], every[key])
    with pytest.raises(ValueError, match="has no loss_q to weigh, but loss_actor"):
        ImportanceWeightedLoss(inner, terms=["loss_q"])


def test_weights_of_one_are_the_loss_itself(batch):
    parts = Parts()
    batch["dynamics_ratio"] = torch.ones(batch.shape[0], 1, dtype=torch.float64)
    weighted = ImportanceWeightedLoss(iql(parts))(batch)
    plain = IQLLoss(parts.actor, parts.qvalues, parts.value)
    torch.testing.assert_close(weighted, plain(batch).select(*weighted.keys()))


def test_targets_are_those_of_the_loss_inside_and_held_once():
    loss = ImportanceWeightedLoss(sac(Parts()))
    names = [name for name, _ in loss.named_parameters()]
    assert len(names) == len(set(names))
    assert not [k for k in loss.state_dict() if k.startswith("target_")]
    SoftUpdate(loss, tau=0.5).step()


def test_a_loss_that_reduces_is_refused():
    with pytest.raises(ValueError, match="reduction='none'"):
        ImportanceWeightedLoss(SACLoss(Parts().actor, Parts().qvalues))


def test_a_batch_without_weights_says_where_they_come_from(batch):
    with pytest.raises(KeyError, match="DynamicsRatioEstimator"):
        ImportanceWeightedLoss(sac(Parts()))(batch)
