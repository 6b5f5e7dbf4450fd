"""Mixed Bellman loss: Eqs. (7) and (8), their limits, and invariance to the order and composition of a batch."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from tests.objectives import reference
from tests.objectives.conftest import ACTION_DIM, make_batch
from torchrl_h2o.objectives import MixedBellmanLoss


@pytest.fixture(autouse=True)
def noise(monkeypatch):
    """Replaces the policy's noise by a function of the row, independent of the row's position in the batch."""
    from torchrl.modules import TanhNormal

    def of_rows(loc):
        return torch.sin(37 * loc).detach()

    def rsample_and_log_prob(self, sample_shape=()):
        base = self.base_dist.base_dist
        sample = base.loc + base.scale * of_rows(base.loc)
        action = torch.tanh(sample)
        return action, (base.log_prob(sample) - torch.log1p(-(action**2))).sum(-1)

    monkeypatch.setattr(TanhNormal, "rsample_and_log_prob", rsample_and_log_prob)
    return of_rows


def reference_loss(loss, batch, mixing, noise, gamma=0.99, alpha=1.0):
    """Eq. (8), computed row by row; also returns the targets."""
    actor = reference.layers(loss.actor_network_params)
    value = reference.layers(loss.value_network_params)
    qvalues, targets = (
        [reference.layers(params, member) for member in range(2)]
        for params in (loss.qvalue_network_params, loss.target_qvalue_network_params)
    )
    ratios = batch.get("dynamics_ratio", torch.ones(batch.shape)).tolist()
    errors, bellman = {True: [], False: []}, []
    for row, ratio in zip(reference.rows(batch), ratios, strict=True):
        loc = torch.tensor(reference.mlp(actor, row["next_observation"])[:ACTION_DIM], dtype=torch.float64)
        target = reference.mixed_target(row, mixing, gamma, alpha, actor, targets, value, noise(loc).tolist())
        bellman.append(target)
        weight = 1.0 if row["real"] else ratio
        squared = sum((reference.mlp(q, row["observation"] + row["action"])[0] - target) ** 2 for q in qvalues)
        errors[row["real"]].append(weight * squared)
    return reference.mean(errors[True]) + reference.mean(errors[False]), bellman


@pytest.mark.parametrize("mixing", [0.0, 0.1, 1.0])
def test_qvalue_loss_is_equation_8_on_the_target_7(parts, batch, noise, mixing):
    batch["dynamics_ratio"] = torch.linspace(0.1, 0.9, batch.shape[0], dtype=torch.float64)
    loss = parts.bellman(mixing=mixing, alpha_init=0.7)
    expected, targets = reference_loss(loss, batch, mixing, noise, alpha=0.7)
    assert loss(batch)["loss_qvalue"].item() == pytest.approx(expected, rel=1e-10)
    assert loss.mixed_target(batch).tolist() == pytest.approx(targets, rel=1e-10)


def test_mixing_one_is_the_in_sample_target_5(parts, batch):
    loss = parts.bellman(mixing=1.0)
    value = parts.value(batch["next"].select("observation"))["state_value"]
    alive = ~batch["next", "terminated"]
    expected = batch["next", "reward"] + 0.99 * alive * value
    torch.testing.assert_close(loss.mixed_target(batch), expected.squeeze(-1))


def test_mixing_zero_is_the_target_of_torchrl_s_sac_6(parts, batch):
    loss = parts.bellman(mixing=0.0)
    sac = SACLoss(parts.actor, parts.qvalues, alpha_init=1.0, loss_function="l2")
    sac.target_qvalue_network_params.data.copy_(loss.target_qvalue_network_params.data)
    sac.make_value_estimator(gamma=0.99)
    # TorchRL keeps gamma in float32
    torch.testing.assert_close(loss.mixed_target(batch), sac._compute_target_v2(batch), rtol=1e-6, atol=1e-6)


def test_mixing_zero_never_reads_the_value_network(parts, batch):
    loss = parts.bellman(mixing=0.0)
    before = loss.mixed_target(batch)
    with torch.no_grad():
        for parameter in parts.value.parameters():
            parameter.mul_(3.0)
    assert torch.equal(loss.mixed_target(batch), before)


def test_gamma_is_set_as_in_torchrl(parts, batch, noise):
    loss = parts.bellman(mixing=0.3)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.5)
    assert loss(batch)["loss_qvalue"].item() == pytest.approx(reference_loss(loss, batch, 0.3, noise, gamma=0.5)[0])
    with pytest.raises(NotImplementedError, match="one-step"):
        loss.make_value_estimator(ValueEstimators.TDLambda)


def test_ratio_one_is_the_unweighted_loss(parts, batch):
    loss = parts.bellman()
    unweighted = loss(batch)["loss_qvalue"]
    ones = batch.copy().set("dynamics_ratio", torch.ones(batch.shape, dtype=torch.float64))
    halves = batch.copy().set("dynamics_ratio", torch.full(batch.shape, 0.5, dtype=torch.float64))
    torch.testing.assert_close(loss(ones)["loss_qvalue"], unweighted)
    assert loss(halves)["loss_qvalue"] < unweighted


def test_the_ratio_of_a_real_row_does_not_count(parts, batch):
    loss = parts.bellman()
    batch["dynamics_ratio"] = torch.where(batch["real"], 1e6, 1.0)
    weighted = loss(batch)["loss_qvalue"]
    torch.testing.assert_close(weighted, loss(batch.exclude("dynamics_ratio"))["loss_qvalue"])


@pytest.mark.parametrize("build", ["bellman", "h2o_plus"])
def test_shuffling_rows_changes_nothing(parts, batch, build):
    loss = getattr(parts, build)().eval()
    order = torch.randperm(batch.shape[0], generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(loss(batch[order]), loss(batch))


@pytest.mark.parametrize("build", ["bellman", "h2o_plus"])
def test_the_share_of_real_rows_changes_nothing(parts, batch, build):
    loss = getattr(parts, build)().eval()
    real = batch[batch["real"]]
    torch.testing.assert_close(loss(torch.cat([batch, real, real])), loss(batch))


@pytest.mark.parametrize("build", ["bellman", "h2o_plus"])
@pytest.mark.parametrize("stream", [True, False])
def test_a_batch_of_one_stream_alone_is_finite(parts, batch, build, stream):
    loss = getattr(parts, build)()
    losses = loss(batch[batch["real"] == stream])
    sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
    assert all(value.isfinite().all() for value in losses.values())
    assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())


def test_terminated_states_do_not_bootstrap_and_truncated_ones_do(parts, batch):
    target = parts.bellman().mixed_target(batch)
    reward = batch["next", "reward"].squeeze(-1)
    terminated = batch["next", "terminated"].squeeze(-1)
    truncated = batch["next", "truncated"].squeeze(-1)
    assert terminated.any()
    assert truncated.any()
    assert torch.equal(target[terminated], reward[terminated])
    assert (target[truncated] != reward[truncated]).all()


def test_the_exploration_term_can_be_swapped(parts, batch):
    def novelty(observation, action):
        return 10 * observation[..., :1] + action[..., :1]

    bonus = TensorDictModule(novelty, in_keys=["observation", "action"], out_keys=["exploration_bonus"])
    none = TensorDictModule(lambda a: 0 * a[..., :1], in_keys=["action"], out_keys=["exploration_bonus"])
    base = parts.bellman(mixing=0.0, exploration=none)
    loss = MixedBellmanLoss(parts.actor, parts.qvalues, parts.value, mixing=0.0, exploration=bonus)
    loss.load_state_dict(base.state_dict())
    difference = loss.mixed_target(batch) - base.mixed_target(batch)
    alive = ~batch["next", "terminated"].squeeze(-1)
    action, _ = loss.sample_action(batch["next"])
    expected = 0.99 * novelty(batch["next", "observation"], action).squeeze(-1) * alive
    torch.testing.assert_close(difference, expected)


def test_only_the_q_network_gets_a_gradient(parts, batch):
    loss = parts.bellman()
    loss(batch)["loss_qvalue"].backward()
    moved = {name.split("_params")[0] for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved == {"qvalue_network"}


def test_td_error_is_written_for_prioritised_replay(parts, batch):
    loss = parts.bellman()
    loss(batch)
    error = loss.qvalues(batch, loss.qvalue_network_params) - loss.mixed_target(batch)
    torch.testing.assert_close(batch["td_error"], error.detach().abs().amax(0))


def test_priority_weights_are_normalised_within_each_stream(parts, batch):
    loss, rowwise = parts.bellman(), parts.bellman(reduction="none")
    rowwise.load_state_dict(loss.state_dict())
    terms, real = rowwise(batch.copy())["loss_qvalue"], batch["real"]
    weights = torch.linspace(0.1, 2.0, batch.shape[0], dtype=torch.float64)
    batch["priority_weight"] = weights
    expected = sum((terms * weights)[rows].sum() / weights[rows].sum() for rows in (real, ~real))
    torch.testing.assert_close(loss(batch.copy())["loss_qvalue"], expected)
    torch.testing.assert_close(rowwise(batch.copy())["loss_qvalue"], terms * weights)
    loss.use_prioritized_weights = False
    plain = sum(terms[rows].mean() for rows in (real, ~real))
    torch.testing.assert_close(loss(batch)["loss_qvalue"], plain)


def test_targets_move_only_through_softupdate(parts, batch):
    loss = MixedBellmanLoss(parts.actor, parts.qvalues, parts.value)
    targets = SoftUpdate(loss, tau=0.25)
    before = loss.target_qvalue_network_params.clone()
    optimiser = torch.optim.SGD(loss.parameters(), lr=0.1)
    loss(batch)["loss_qvalue"].backward()
    optimiser.step()
    assert (loss.target_qvalue_network_params == before).all()
    targets.step()
    expected = before.data * 0.75 + loss.qvalue_network_params.data * 0.25
    torch.testing.assert_close(loss.target_qvalue_network_params.data.to_dict(), expected.to_dict())


def test_masked_rows_do_not_count(parts, batch):
    loss = parts.bellman()
    whole = torch.cat([batch, make_batch(3, 5, seed=9)])
    whole["collector"] = TensorDict(mask=torch.arange(15)[:, None] < 7, batch_size=15)
    torch.testing.assert_close(loss(whole)["loss_qvalue"], loss(batch)["loss_qvalue"])


@pytest.mark.parametrize("bad", [{"mixing": 1.5}, {"alpha_init": 0.0}, {"reduction": "max"}])
def test_an_argument_out_of_range_is_refused(parts, bad):
    with pytest.raises(ValueError, match=next(iter(bad)).split("_init")[0]):
        MixedBellmanLoss(parts.actor, parts.qvalues, parts.value, **bad)
