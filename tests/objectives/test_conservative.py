"""H2O's objective, Eq. (1): its conservative term, its weights, and the objective without weights."""

import copy
import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.objectives import SACLoss, SoftUpdate

from tests.objectives import reference
from tests.objectives.conftest import Parts, make_batch
from tests.objectives.test_importance import iql, td3
from tests.objectives.test_reward_correction import log_ratio_of
from torchrl_h2o.objectives import ConservativeLoss, DynamicsDivergence, DynamicsRatioEstimator, ImportanceWeightedLoss

NO_BONUS = TensorDictModule(torch.zeros_like, in_keys=["_log_prob"], out_keys=["exploration_bonus"])


def h2o(parts, alpha_c=0.3, **kwargs):
    return ConservativeLoss(parts.sac(**kwargs), alpha_c=alpha_c)


def weighted(parts, batch):
    """Adds the entries that H2O's objective reads to a batch."""
    parts.estimator(batch)
    return batch.set("dynamics_divergence", torch.linspace(0.2, 3.0, batch.shape[0], dtype=torch.float64))


def conservative_term(loss, batch, alpha_c):
    """The bracket of Eq. (1) over all rows and members, in Python floats."""
    rows = reference.rows(batch)
    weights = [u for u, row in zip(batch["dynamics_divergence"].tolist(), rows, strict=True) if not row["real"]]
    total = 0.0
    for member in range(2):
        network = reference.layers(loss.qvalue_network_params, member)
        q = {real: [qvalue(network, row) for row in rows if row["real"] == real] for real in (True, False)}
        of_sim = math.log(sum(u / sum(weights) * math.exp(x) for u, x in zip(weights, q[False], strict=True)))
        total += of_sim - reference.mean(q[True])
    return alpha_c * total


def qvalue(network, row):
    return reference.mlp(network, row["observation"] + row["action"])[0]


def test_the_conservative_term_is_that_of_equation_1(parts, batch):
    loss = h2o(parts)
    batch = weighted(parts, batch)
    assert loss(batch)["loss_conservative"].item() == pytest.approx(conservative_term(loss, batch, 0.3), rel=1e-10)


def test_the_bellman_terms_are_those_of_equation_1(parts, batch):
    loss = h2o(parts, exploration=NO_BONUS)
    batch = weighted(parts, batch)
    torch.manual_seed(5)
    next_action, _ = loss.loss.bellman_loss.sample_action(batch["next"])
    targets = [reference.layers(loss.target_qvalue_network_params, member) for member in range(2)]
    errors = {True: [], False: []}
    for row, action, ratio in zip(
        reference.rows(batch), next_action.tolist(), batch["dynamics_ratio"].tolist(), strict=True
    ):
        after = min(reference.mlp(net, row["next_observation"] + action)[0] for net in targets)
        target = row["reward"] + (0.0 if row["terminated"] else 0.99 * after)
        for member in range(2):
            network = reference.layers(loss.qvalue_network_params, member)
            error = (qvalue(network, row) - target) ** 2
            errors[row["real"]].append(error if row["real"] else ratio * error)
    torch.manual_seed(5)
    expected = 2 * (reference.mean(errors[True]) + reference.mean(errors[False]))
    assert loss(batch)["loss_qvalue"].item() == pytest.approx(expected, rel=1e-6)


def test_the_divergence_is_the_mean_log_ratio_at_noisy_next_states_clamped(parts, batch):
    with torch.no_grad():  # ratios of the rows lie above, below and between the bounds
        parts.estimator.sas_network.module[-1].weight *= 0.2
        parts.estimator.sas_network.module[-1].bias[:] = torch.tensor([-0.2, 0.2])
    noise = torch.tensor([0.1, 1.0, 3.0], dtype=torch.float64)
    divergence = DynamicsDivergence(parts.estimator, noise, num_samples=4, clamp=(0.1, 0.4))
    torch.manual_seed(7)
    got = divergence(batch)["dynamics_divergence"].tolist()
    torch.manual_seed(7)
    drawn = torch.randn(4, *batch["next", "observation"].shape, dtype=torch.float64)
    drawn = batch["next", "observation"] + noise * drawn
    expected = []
    for index, row in enumerate(reference.rows(batch)):
        logs = [log_ratio_of(parts.estimator, row | {"next_observation": s}) for s in drawn[:, index].tolist()]
        expected.append(min(max(-reference.mean(logs), 0.1), 0.4))
    assert got == pytest.approx(expected, rel=1e-9)
    assert min(got) == 0.1
    assert max(got) == 0.4
    assert any(0.1 < u < 0.4 for u in got)


def test_next_states_are_noisy_whatever_their_key_is(parts, batch):
    sas = parts.estimator.sas_network
    with torch.no_grad():  # ratios differ between rows
        sas.module[-1].bias[:] = torch.tensor([-2.0, 2.0])
    flat = TensorDictModule(sas.module, in_keys=["observation", "action", "next_observation"], out_keys=sas.out_keys)
    batch["next_observation"] = batch["next", "observation"].clone()
    divergences = []
    for estimator in (parts.estimator, DynamicsRatioEstimator(parts.estimator.sa_network, flat)):
        torch.manual_seed(7)
        divergence = DynamicsDivergence(estimator, noise=1.0, clamp=(1e-9, 1e9))
        divergences.append(divergence(batch.copy())["dynamics_divergence"])
    torch.testing.assert_close(*divergences)
    assert divergences[0].unique().numel() > 1


def test_without_the_term_and_the_ratio_h2o_is_sac_on_both_streams(batch):
    parts, others = Parts(), Parts()
    loss = h2o(parts, alpha_c=0.0)
    sac = SACLoss(others.actor, others.qvalues, loss_function="l2", reduction="none", scalar_output_mode="exclude")
    sac.load_state_dict(loss.loss.bellman_loss.state_dict(), strict=False)
    torch.manual_seed(2)
    got = loss(batch.copy())
    torch.manual_seed(2)
    terms = sac(batch.copy())
    real = batch["real"]
    streams = {key: terms[key][real].mean() + terms[key][~real].mean() for key in terms.keys()}
    torch.testing.assert_close(got["loss_qvalue"], streams["loss_qvalue"])
    torch.testing.assert_close(got["loss_actor"], streams["loss_actor"] / 2)
    torch.testing.assert_close(got["loss_alpha"], streams["loss_alpha"] / 2)
    assert got["loss_conservative"] == 0.0


def test_the_term_moves_q_alone_down_in_the_simulator_and_up_on_the_data(parts, batch):
    loss = h2o(parts)
    loss(weighted(parts, batch))["loss_conservative"].backward()
    moved = {name for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved
    assert all("qvalue_network" in name for name in moved)
    before = q_of_streams(loss, batch)
    with torch.no_grad():
        for parameter in loss.parameters():
            if parameter.grad is not None:
                parameter -= 0.01 * parameter.grad
    after = q_of_streams(loss, batch)
    assert after[0] > before[0]
    assert after[1] < before[1]


def q_of_streams(loss, batch):
    qvalues = loss.loss.bellman_loss.qvalues(batch, loss.qvalue_network_params).mean(0)
    return qvalues[batch["real"]].mean().item(), qvalues[~batch["real"]].mean().item()


@pytest.mark.parametrize(("num_real", "num_sim"), [(5, 0), (0, 5)])
def test_a_batch_of_one_stream_has_that_stream_s_part_and_finite_gradients(parts, num_real, num_sim):
    loss = h2o(parts)
    term = loss(weighted(parts, make_batch(num_real, num_sim)))["loss_conservative"]
    term.backward()
    assert term.isfinite()
    assert all(p.grad is None or p.grad.isfinite().all() for p in loss.parameters())


def test_neither_order_nor_share_of_rows_changes_the_term(parts, batch):
    loss = h2o(parts)
    batch = weighted(parts, batch)
    expected = loss(batch)["loss_conservative"]
    shuffled = batch[torch.randperm(len(batch), generator=torch.Generator().manual_seed(1))]
    torch.testing.assert_close(loss(shuffled)["loss_conservative"], expected)
    more_real = torch.cat([batch[batch["real"]], batch])
    torch.testing.assert_close(loss(more_real)["loss_conservative"], expected)
    torch.testing.assert_close(loss(batch.unsqueeze(0))["loss_conservative"], expected)


def test_rows_weigh_the_same_where_nobody_wrote_a_divergence(parts, batch):
    loss = h2o(parts)
    even = batch.copy().set("dynamics_divergence", torch.full(batch.shape, 0.7, dtype=torch.float64))
    torch.testing.assert_close(loss(batch)["loss_conservative"], loss(even)["loss_conservative"])


@pytest.mark.parametrize("build", [lambda p: SACLoss(p.actor, p.qvalues), td3, iql])
def test_any_loss_with_a_q_network_takes_the_term(build, batch):
    parts = Parts()
    inside = build(parts)
    inside.reduction = "mean"
    loss = ConservativeLoss(inside, alpha_c=0.3)
    losses = loss(weighted(parts, batch))
    assert {"loss_conservative", "loss_qvalue", "loss_actor"} <= set(losses.keys())
    assert losses["loss_conservative"].item() == pytest.approx(conservative_term(loss, batch, 0.3), rel=1e-10)


def test_copies_state_dicts_discount_and_targets_are_a_loss_s(parts, batch):
    loss, batch = h2o(parts), weighted(parts, batch)
    expected = seeded(loss, batch)
    torch.testing.assert_close(seeded(copy.deepcopy(loss), batch), expected)
    other = h2o(Parts(seed=1))
    other.load_state_dict(loss.state_dict())
    torch.testing.assert_close(seeded(other, batch), expected)
    loss.make_value_estimator(gamma=0.5)
    assert loss.loss.gamma == 0.5
    before = loss.loss.target_qvalue_network_params.clone()
    SoftUpdate(loss, tau=0.5).step()
    assert (loss.loss.target_qvalue_network_params != before).any()


@pytest.mark.slow
def test_the_compiled_term_is_the_eager_one(parts, batch):
    loss, batch = h2o(parts), weighted(parts, batch)
    torch._dynamo.reset()

    def term(td):
        return loss.conservative_loss(td, loss._rows(td))

    compiled = torch.compile(term, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(batch), term(batch))


def seeded(loss, batch):
    torch.manual_seed(11)
    return loss(batch.copy())


def test_renamed_keys_reach_both(parts, batch):
    batch = weighted(parts, batch)
    expected = seeded(h2o(parts), batch)
    loss = h2o(Parts())
    loss.set_keys(real="measured", reward="pay", dynamics_divergence="gap")
    batch.rename_key_("real", "measured")
    batch.rename_key_("dynamics_divergence", "gap")
    batch["next"].rename_key_("reward", "pay")
    torch.testing.assert_close(seeded(loss, batch), expected)


def test_dispatch_takes_the_divergence(parts, batch):
    loss = h2o(parts)
    batch = weighted(parts, batch)
    expected = loss(batch)["loss_conservative"]
    loss.select_out_keys("loss_conservative")
    tensors = {
        "_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss._dispatch_keys if k in batch.keys(True)
    }
    torch.testing.assert_close(loss(**tensors), expected)


def test_what_cannot_be_is_refused(parts):
    with pytest.raises(ValueError, match="no qvalue_network"):
        ConservativeLoss(ImportanceWeightedLoss(td3(parts)))
    with pytest.raises(ValueError, match="reduction='mean'"):
        ConservativeLoss(td3(parts))
    with pytest.raises(ValueError, match=r"alpha_c is -0\.1"):
        ConservativeLoss(parts.sac(), alpha_c=-0.1)
    with pytest.raises(ValueError, match="at least one"):
        DynamicsDivergence(parts.estimator, 1.0, num_samples=0)
    with pytest.raises(ValueError, match="0 < low"):
        DynamicsDivergence(parts.estimator, 1.0, clamp=(0.0, 1.0))
