"""The checks of TorchRL's own test base for loss modules, applied to these losses."""

import copy
import re

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, TD1Estimator

from tests.objectives.conftest import ACTION_DIM, LOSSES, OBSERVATION_DIM, Parts, make_actor, make_batch
from torchrl_h2o.objectives import (
    ConservativeLoss,
    DynamicsRatioLoss,
    EntropyBonus,
    H2OPlusLoss,
    ImportanceWeightedLoss,
    MixedBellmanLoss,
)

losses = pytest.mark.parametrize("name", LOSSES)
with_q = pytest.mark.parametrize("build", ["bellman", "h2o_plus", "sac"])


def seeded(loss, batch):
    torch.manual_seed(4)
    return loss(batch.copy())


def full_batch():
    batch = make_batch()
    return batch.set("state_action_value", torch.linspace(-1, 1, batch.shape[0], dtype=torch.float64)[:, None])


@losses
def test_every_accepted_key_has_its_default_can_be_renamed_and_reset(name):
    loss = LOSSES[name](Parts())
    defaults = {key: getattr(loss.tensor_keys, key) for key in loss._AcceptedKeys.__dataclass_fields__}
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(unknown="name")
    for key, default in defaults.items():
        renamed = copy.deepcopy(loss)
        renamed.set_keys(**{key: "other"})
        assert getattr(renamed.tensor_keys, key) == "other"
        renamed.set_keys(**{key: None})
        assert getattr(renamed.tensor_keys, key) == default


@losses
def test_a_forward_leaves_the_entries_of_the_batch_as_they_were(name):
    batch = full_batch()
    before = batch.clone()
    LOSSES[name](Parts())(batch)
    assert (batch.select(*before.keys(True, True)) == before).all()


@losses
def test_resetting_reaches_every_network(name):
    loss = LOSSES[name](Parts())
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter += 1000
    before = {key: parameter.clone() for key, parameter in loss.named_parameters()}
    loss.reset_parameters_recursive()
    for key, parameter in loss.named_parameters():
        if "log_alpha" not in key:
            assert (parameter != before[key]).any(), key


@with_q
def test_n_step_transitions_are_discounted_by_gamma_to_the_n(build, batch):
    loss = getattr(Parts(), build)()
    bellman = getattr(loss, "bellman_loss", loss)
    one = seeded(bellman.mixed_target, batch)
    steps = torch.arange(1, batch.shape[0] + 1)[:, None]
    several = seeded(bellman.mixed_target, batch.copy().set("steps_to_next_obs", steps))
    reward = batch["next", "reward"].squeeze(-1)
    torch.testing.assert_close(several - reward, (one - reward) * 0.99 ** (steps.squeeze(-1) - 1))
    loss.set_keys(steps_to_next_obs="n")
    renamed = seeded(bellman.mixed_target, batch.copy().set("n", steps.squeeze(-1)))
    torch.testing.assert_close(renamed, several)


def test_rows_of_torchrl_s_multi_step_transform_get_sac_s_target():
    parts, size = Parts(dtype=torch.float32), 12
    done = torch.zeros(size, 1, dtype=torch.bool)
    trajectory = make_batch(size, 0, dtype=torch.float32)
    trajectory["next"].update({"done": done, "terminated": done.clone(), "truncated": done.clone()})
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(size), transform=MultiStepTransform(n_steps=3, gamma=0.99), batch_size=size
    )
    buffer.extend(trajectory)
    steps = buffer[:]
    assert (steps["steps_to_next_obs"] > 1).any()
    loss = MixedBellmanLoss(parts.actor, parts.qvalues, mixing=0.0)
    sac = SACLoss(parts.actor, parts.qvalues, loss_function="l2")
    sac.make_value_estimator(gamma=0.99)
    torch.testing.assert_close(seeded(loss.mixed_target, steps), seeded(sac._compute_target_v2, steps))


def test_priority_weights_are_applied_as_torchrl_s_sac_applies_them():
    batch = make_batch(0, 8)
    batch["priority_weight"] = torch.linspace(0.1, 3.0, 8, dtype=torch.float64)
    parts, others = Parts(), Parts()
    ours = H2OPlusLoss(MixedBellmanLoss(parts.actor, parts.qvalues, mixing=0.0))
    sac = SACLoss(others.actor, others.qvalues, loss_function="l2")
    SoftUpdate(ours, tau=0.1)
    got, expected = seeded(ours, batch), seeded(sac, batch)
    for key in ("loss_qvalue", "loss_actor", "loss_alpha", "entropy"):
        torch.testing.assert_close(got[key], expected[key].to(got[key]), rtol=1e-5, atol=1e-6)


def dropout_qvalue():
    network = MLP(OBSERVATION_DIM + ACTION_DIM, 1, num_cells=[8, 8], dropout=0.5).double()
    return ValueOperator(network, in_keys=["observation", "action"])


def test_random_networks_run_with_the_randomness_that_is_set(batch):
    parts = Parts()
    bellman_loss = MixedBellmanLoss(parts.actor, [dropout_qvalue(), dropout_qvalue()], mixing=0.0)
    loss = ConservativeLoss(H2OPlusLoss(bellman_loss))
    assert loss.vmap_randomness == "different"
    assert loss(batch)["loss_qvalue"].isfinite()
    loss.set_vmap_randomness("same")
    assert bellman_loss.vmap_randomness == "same"
    assert loss(batch)["loss_qvalue"].isfinite()
    with pytest.raises(ValueError, match="randomness"):
        loss.set_vmap_randomness("other")


@pytest.mark.parametrize("wrap", [ConservativeLoss, lambda loss: nn.ModuleDict({"a": ConservativeLoss(loss)})])
def test_a_wrapped_sac_loss_is_loaded_before_its_first_forward(wrap):
    state = wrap(SACLoss(Parts().actor, Parts().qvalues)).state_dict()
    parts = Parts(seed=1)
    other = wrap(SACLoss(parts.actor, parts.qvalues))
    other.load_state_dict(state)
    rowwise = SACLoss(parts.actor, parts.qvalues, reduction="none", scalar_output_mode="exclude")
    ImportanceWeightedLoss(rowwise).load_state_dict(
        {k.removeprefix("a."): v for k, v in other.state_dict().items()}, strict=True
    )


@with_q
def test_estimators_are_accepted_in_every_form_that_torchrl_accepts(build):
    loss = getattr(Parts(), build)()
    gamma = getattr(loss, "bellman_loss", loss).gamma
    for form in (ValueEstimators.TD0, TD0Estimator):
        assert loss.make_value_estimator(form, gamma=0.5) is loss
        assert gamma == 0.5
        loss.make_value_estimator(gamma=0.9)
    loss.make_value_estimator(TD0Estimator(gamma=0.25, value_network=None))
    assert gamma == 0.25
    loss.make_value_estimator()
    assert gamma == 0.25
    for unfit in (ValueEstimators.GAE, ValueEstimators.VTrace, TD1Estimator, GAE):
        with pytest.raises(NotImplementedError, match="one-step"):
            loss.make_value_estimator(unfit)
    with pytest.raises(ValueError, match="average_rewards"):
        loss.make_value_estimator(TD0Estimator, gamma=0.9, average_rewards=True)
    with pytest.raises(TypeError, match="lmbda"):
        loss.make_value_estimator(gamma=0.9, lmbda=0.5)


@with_q
def test_the_value_estimator_is_a_td0_estimator_of_equation_7(build, batch):
    loss = getattr(Parts(), build)()
    batch["steps_to_next_obs"] = torch.arange(1, 8)[:, None]
    loss.set_keys(steps_to_next_obs="n", reward="pay", done="ended")
    batch.rename_key_("steps_to_next_obs", "n")
    batch["next"].rename_key_("reward", "pay").rename_key_("done", "ended")
    loss.make_value_estimator(gamma=0.5)
    estimator, bellman = loss.value_estimator, getattr(loss, "bellman_loss", loss)
    assert isinstance(estimator, TD0Estimator)
    assert estimator.gamma == 0.5
    assert loss.make_value_estimator(estimator) is loss
    torch.manual_seed(4)
    target = estimator.value_estimate(batch)
    torch.testing.assert_close(target.squeeze(-1), seeded(bellman.mixed_target, batch))
    batch["state_value"] = torch.ones(7, 1, dtype=torch.float64)
    torch.manual_seed(4)
    torch.testing.assert_close(estimator(batch)["advantage"], target - 1.0)
    assert not target.requires_grad


MASKED = (("next", "reward"), "observation", ("next", "observation"), "action", "state_action_value", "dynamics_ratio")


@pytest.mark.parametrize("name", [*LOSSES, "weighted_sac"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_masked_rows_may_hold_anything(name, value):
    """Without the mend, NaN times a weight of zero is NaN in the gradients."""
    parts, batch = Parts(), full_batch()
    if name == "weighted_sac":
        sac = SACLoss(parts.actor, parts.qvalues, reduction="none", scalar_output_mode="exclude")
        loss = ImportanceWeightedLoss(sac)
    else:
        loss = LOSSES[name](parts)
    loss.loss_mask_key = "valid"
    batch["valid"] = torch.arange(7)[:, None] != 2
    batch["dynamics_ratio"] = torch.ones(7, dtype=torch.float64)
    seeded(loss, batch)  # a ratio loss has no noise that depends on the values
    found = []
    for given in (batch, batch.clone()):
        for key in MASKED if given is not batch else ():
            given[key][2] = value
        loss.zero_grad()
        terms = seeded(loss, given)
        sum(term.sum() for key, term in terms.items() if key.startswith("loss")).backward()
        found.append([p.grad.clone() for p in loss.parameters() if p.grad is not None])
    assert all(gradient.isfinite().all() for gradient in found[1])
    torch.testing.assert_close(*found)


def test_the_td_error_of_masked_batches_is_written_into_the_batch(batch):
    for loss in (Parts().bellman(), Parts().h2o_plus(), ConservativeLoss(Parts().sac())):
        loss.loss_mask_key, given = "valid", batch.copy()
        given["valid"] = torch.arange(7) != 2
        loss(given)
        assert given["td_error"].isfinite().all()


def test_messages_name_the_whole_key(batch):
    for key in (("next", "reward"), ("next", "terminated")):
        with pytest.raises(KeyError, match=rf"reads {re.escape(repr(key))} and finds"):
            Parts().bellman()(batch.exclude(key))


def test_exploration_keys_can_be_renamed(batch):
    expected = seeded(Parts().bellman(), batch)["loss_qvalue"]
    loss = Parts().bellman()
    loss.set_keys(log_prob=("own", "log_prob"), alpha="beta", exploration_bonus="bonus")
    torch.testing.assert_close(seeded(loss, batch)["loss_qvalue"], expected)
    own = TensorDictModule(lambda log_prob, beta: -beta * log_prob, in_keys=["lp", "beta"], out_keys=["bonus"])
    other = Parts().bellman(exploration=own)
    other.set_keys(log_prob="lp", alpha="beta", exploration_bonus="bonus")
    torch.testing.assert_close(seeded(other, batch)["loss_qvalue"], expected)
    states = TensorDict(lp=torch.ones(2), beta=torch.ones(2), batch_size=2)
    assert EntropyBonus(log_prob="lp", alpha="beta", exploration_bonus="b")(states)["b"].tolist() == [-1.0, -1.0]


def test_settings_of_the_whole_reach_its_parts(batch):
    loss = Parts().h2o_plus()
    loss.use_prioritized_weights = False
    assert all(part.use_prioritized_weights is False for part in loss._parts)
    loss.gamma, loss.mixing = 0.5, 0.2
    assert (loss.bellman_loss.gamma, loss.bellman_loss.mixing) == (0.5, pytest.approx(0.2))


def test_the_authors_trained_scale_of_the_log_std_starts_as_ours():
    torch.manual_seed(0)
    spec = Parts().actor.spec["action"]
    theirs = make_actor(OBSERVATION_DIM, spec, trainable_log_std=True)
    _, scale, _ = theirs(observation=torch.randn(100, OBSERVATION_DIM))
    torch.testing.assert_close(scale, torch.full_like(scale, -1.0).exp(), rtol=0.1, atol=0.0)
    assert {"multiplier", "offset"} <= {name.rsplit(".", 1)[-1] for name, _ in theirs.named_parameters()}
    parts = Parts(dtype=torch.float32)
    loss = H2OPlusLoss(MixedBellmanLoss(theirs, parts.qvalues, mixing=0.0))
    loss(make_batch(dtype=torch.float32))["loss_actor"].backward()
    assert all(leaf.grad is not None for leaf in loss.actor_network_params.values(True, True))


def test_the_authors_second_discriminator_also_trains_the_first(batch):
    estimator = Parts().estimator
    estimator.detach_residual = False
    loss = DynamicsRatioLoss(estimator)
    loss(batch)["loss_ratio_sas"].backward()
    assert all(parameter.grad.any() for parameter in estimator.sa_network.parameters())
