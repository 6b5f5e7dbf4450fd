"""Importance weighting: the estimator's ratio in TorchRL's own losses."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP, OneHotCategorical, ProbabilisticActor, QValueActor
from torchrl.objectives import DiscreteSACLoss, DQNLoss, IQLLoss, REDQLoss, SACLoss, SoftUpdate, TD3Loss

from tests.objectives.conftest import ACTION_DIM, OBSERVATION_DIM, Parts, make_batch
from torchrl_h2o.objectives import ImportanceWeightedLoss, total_loss


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


def redq(parts, reduction, networks):
    return REDQLoss(parts.actor, parts.qvalues[0], num_qvalue_nets=networks, sub_sample_len=2, reduction=reduction)


@pytest.mark.parametrize("networks", [4, 7], ids=["4 networks", "as many networks as rows"])
@pytest.mark.parametrize("masked", [False, True])
def test_rows_of_an_ensemble_are_weighted_not_its_networks(batch, networks, masked):
    inner = redq(Parts(), "none", networks)
    weights, kept = torch.linspace(0.0, 2.0, 7, dtype=torch.float64), torch.ones(7, dtype=torch.bool)
    batch["real"][:], batch["dynamics_ratio"] = False, weights
    torch.manual_seed(1)
    terms = inner(batch.copy())["loss_qvalue"]
    assert terms.shape == (networks, 7)
    if masked:
        batch["collector"] = {"mask": torch.arange(7)[:, None] != 3}
        kept[3] = False
    for reduction, expected in (("mean", (terms * weights)[:, kept].mean()), ("none", (terms * weights * kept))):
        torch.manual_seed(1)
        got = ImportanceWeightedLoss(inner, terms=["loss_qvalue"], reduction=reduction)(batch.copy())["loss_qvalue"]
        torch.testing.assert_close(got, expected)


def dqn(parts, reduction="none"):
    network = MLP(OBSERVATION_DIM, ACTION_DIM, num_cells=[8]).double()
    actor = QValueActor(network, in_keys=["observation"], action_space="one_hot")
    return DQNLoss(actor, action_space="one_hot", reduction=reduction)


def discrete_sac(parts, reduction="none"):
    logits = TensorDictModule(MLP(OBSERVATION_DIM, ACTION_DIM).double(), in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(logits, in_keys=["logits"], distribution_class=OneHotCategorical)
    values = TensorDictModule(
        MLP(OBSERVATION_DIM, ACTION_DIM).double(), in_keys=["observation"], out_keys=["action_value"]
    )
    kwargs = {"action_space": "one-hot", "num_actions": ACTION_DIM, "loss_function": "l2"}
    return DiscreteSACLoss(actor, values, reduction=reduction, scalar_output_mode="exclude", **kwargs)


@pytest.mark.parametrize("build", [dqn, discrete_sac])
def test_losses_of_discrete_actions_are_weighted(batch, build):
    batch["action"] = torch.eye(ACTION_DIM, dtype=torch.bool)[torch.arange(7) % ACTION_DIM]
    batch["real"][:], batch["dynamics_ratio"] = False, torch.linspace(0.0, 2.0, 7, dtype=torch.float64)
    inner = build(Parts())
    terms, losses = inner(batch.copy()), ImportanceWeightedLoss(inner)(batch.copy())
    key = "loss" if build is dqn else "loss_qvalue"
    torch.testing.assert_close(losses[key], (terms[key] * batch["dynamics_ratio"]).mean())
    assert total_loss(losses).requires_grad


def test_a_loss_without_terms_is_refused():
    inner = sac(Parts())
    inner.out_keys = ["alpha", "entropy"]
    with pytest.raises(ValueError, match=r"SACLoss has no term named 'loss\.\.\.' to weigh, but only"):
        ImportanceWeightedLoss(inner)


def reduced_sac(parts):
    return SACLoss(parts.actor, parts.qvalues)


def reduced_iql(parts):
    return IQLLoss(parts.actor, parts.qvalues, parts.value)


@pytest.mark.parametrize(
    ("rowwise", "reduced", "masked"),
    [(sac, reduced_sac, False), (sac, reduced_sac, True), (iql, reduced_iql, False)],
    ids=["sac", "sac with a mask", "iql"],  # TorchRL's IQL loses the mask on its way to Q
)
def test_weights_of_one_are_the_loss_itself_with_priority_weights(batch, rowwise, reduced, masked):
    batch["real"][:], batch["dynamics_ratio"] = False, torch.ones(7, dtype=torch.float64)
    batch["priority_weight"] = torch.linspace(0.1, 2.0, 7, dtype=torch.float64)
    if masked:
        batch["collector"] = {"mask": torch.arange(7)[:, None] != 3}
    loss, inner = ImportanceWeightedLoss(rowwise(Parts())), reduced(Parts())
    torch.manual_seed(1)
    got = loss(batch.copy())
    torch.manual_seed(1)
    torch.testing.assert_close(got, inner(batch.copy()).select(*got.keys()))
