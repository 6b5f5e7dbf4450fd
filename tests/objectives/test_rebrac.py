"""ReBRAC's loss: TorchRL's TD3+BC, with a target of Q that is lowered away from the actions of the data."""

import pytest
import torch
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate, TD3BCLoss

from tests.objectives.conftest import ACTION_DIM, Parts, make_batch
from torchrl_h2o.objectives import ReBRACLoss

GAMMA = 0.9


def built(loss_class, **kwargs):
    parts, spec = Parts(), Bounded(-1, 1, (ACTION_DIM,), dtype=torch.float64)
    loss = loss_class(parts.actor, parts.qvalues, action_spec=spec, loss_function="l2", **kwargs)
    loss.make_value_estimator(gamma=GAMMA)
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    return loss


def with_next_action(batch):
    return batch.set(("next", "action"), torch.linspace(-1, 1, 2 * len(batch), dtype=torch.float64).reshape(-1, 2))


def terms_and_gradients(loss, batch):
    torch.manual_seed(3)
    terms = loss(batch.copy())
    (terms["loss_actor"] + terms["loss_qvalue"]).backward()
    return terms.detach(), {name: p.grad for name, p in loss.named_parameters() if p.grad is not None}


def test_without_a_penalty_it_is_torchrl_s_loss(batch):
    for got, expected in zip(
        terms_and_gradients(built(ReBRACLoss), batch), terms_and_gradients(built(TD3BCLoss), batch), strict=True
    ):
        torch.testing.assert_close(got, expected, rtol=0.0, atol=0.0)
    assert ("next", "action") not in built(ReBRACLoss).in_keys


@pytest.mark.parametrize("steps", [1, 3])
def test_the_target_is_lowered_by_the_discounted_distance_of_the_next_action_from_the_data_s(batch, steps):
    with_next_action(batch)["steps_to_next_obs"] = torch.full((len(batch), 1), steps)
    loss = built(ReBRACLoss, critic_penalty=2.0, policy_noise=0.0)
    plain, penalised = (terms_and_gradients(one, batch)[0] for one in (built(TD3BCLoss, policy_noise=0.0), loss))
    action = loss.actor_network(batch["next"].select("observation"))["action"]
    distance = (action - batch["next", "action"]).square().sum(-1).detach()
    expected = torch.where(batch["next", "terminated"].squeeze(-1), 0.0, 2.0 * GAMMA**steps * distance)
    torch.testing.assert_close(plain["target_value"] - penalised["target_value"], expected)
    torch.testing.assert_close(plain["loss_actor"], penalised["loss_actor"])


def test_the_penalty_has_the_noise_of_the_target_policy_within_the_action_s_bounds(batch):
    batch = with_next_action(batch)
    loss = built(ReBRACLoss, critic_penalty=1.0, policy_noise=100.0, noise_clip=50.0)
    torch.manual_seed(0)
    reward = loss._penalised(batch)["next", "reward"]
    at_bounds = torch.stack([(s - batch["next", "action"]).square() for s in (-1.0, 1.0)])
    distance = (batch["next", "reward"] - reward) / GAMMA
    found = torch.cartesian_prod(torch.arange(2), torch.arange(2))
    sums = torch.stack([at_bounds[i, :, 0] + at_bounds[j, :, 1] for i, j in found.tolist()])
    goes_on = ~batch["next", "terminated"].squeeze(-1)
    assert torch.isclose(sums, distance.T).any(0)[goes_on].all()


def test_keys_are_renamed_and_dispatched(batch):
    batch = with_next_action(batch)
    loss = built(ReBRACLoss, critic_penalty=1.0, policy_noise=0.0)
    assert ("next", "action") in loss.in_keys
    expected = loss(batch.copy())["loss_qvalue"]
    tensors = {"_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss.in_keys}
    torch.testing.assert_close(loss(**tensors)[loss.out_keys.index("loss_qvalue")], expected)
    loss.set_keys(reward="pay", terminated="over")
    batch["next"].rename_key_("reward", "pay").rename_key_("terminated", "over")
    torch.testing.assert_close(loss(batch)["loss_qvalue"], expected)
    with pytest.raises(ValueError, match="critic_penalty is -1"):
        built(ReBRACLoss, critic_penalty=-1)


def test_it_drives_a_training_step():
    loss, batch = built(ReBRACLoss, critic_penalty=1.0), with_next_action(make_batch())
    targets, optimiser = SoftUpdate(loss, tau=0.1), torch.optim.Adam(loss.parameters(), lr=1e-3)
    before = [p.clone() for p in loss.parameters()]
    terms_and_gradients(loss, batch)
    optimiser.step()
    targets.step()
    assert any((p != q).any() for p, q in zip(before, loss.parameters(), strict=True))
