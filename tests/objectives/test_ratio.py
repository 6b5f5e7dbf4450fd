"""Dynamics ratio: Eq. (9), its options, and the trained estimator compared with known ratios."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from tests.objectives import reference
from tests.objectives.conftest import CELLS, OBSERVATION_DIM, Parts, make_batch
from torchrl_h2o.objectives import (
    DynamicsDivergence,
    DynamicsRatioEstimator,
    DynamicsRatioLoss,
    DynamicsRewardCorrection,
    fit_change_scale,
    make_dynamics_ratio_estimator,
)


def log_odds(p):
    return math.log(p / (1 - p))


@pytest.mark.parametrize("bound", [2.0, None])
@pytest.mark.parametrize("residual", [True, False])
def test_log_ratio_is_equation_9(parts, batch, bound, residual):
    estimator = DynamicsRatioEstimator(
        parts.estimator.sa_network, parts.estimator.sas_network, logit_bound=bound, residual=residual
    )
    sa = reference.layers(TensorDict.from_module(estimator.sa_network))
    sas = reference.layers(TensorDict.from_module(estimator.sas_network))
    got = estimator(batch)
    for row, log_ratio, ratio in zip(
        reference.rows(batch), got["log_dynamics_ratio"], got["dynamics_ratio"], strict=True
    ):
        pair = row["observation"] + row["action"]
        added = reference.bounded(reference.mlp(sa, pair), bound) if residual else (0.0, 0.0)
        p_sa = reference.discriminator_probability(sa, pair, bound)
        p_sas = reference.discriminator_probability(sas, pair + row["next_observation"], bound, added)
        expected = ((1 - p_sa) / p_sa) / ((1 - p_sas) / p_sas)
        assert log_ratio.item() == pytest.approx(math.log(expected), rel=1e-9)
        assert ratio.item() == pytest.approx(min(max(expected, 1e-5), 1.0), rel=1e-9)


def test_losses_are_the_mean_cross_entropies_of_both_streams(parts, batch):
    loss = DynamicsRatioLoss(parts.estimator, input_noise=None)
    sa = reference.layers(TensorDict.from_module(parts.estimator.sa_network))
    sas = reference.layers(TensorDict.from_module(parts.estimator.sas_network))
    terms = {True: ([], []), False: ([], [])}
    for row in reference.rows(batch):
        pair = row["observation"] + row["action"]
        p_sa = reference.discriminator_probability(sa, pair, 2.0)
        added = reference.bounded(reference.mlp(sa, pair), 2.0)
        p_sas = reference.discriminator_probability(sas, pair + row["next_observation"], 2.0, added)
        for column, p in zip(terms[row["real"]], (p_sa, p_sas), strict=True):
            column.append(-math.log(p if row["real"] else 1 - p))
    got = loss(batch)
    for index, key in enumerate(("loss_ratio_sa", "loss_ratio_sas")):
        expected = reference.mean(terms[True][index]) + reference.mean(terms[False][index])
        assert got[key].item() == pytest.approx(expected, rel=1e-12)


def test_each_discriminator_is_trained_by_its_own_loss_alone(parts, batch):
    loss = DynamicsRatioLoss(parts.estimator)
    for key, own in (("loss_ratio_sa", "sa_network"), ("loss_ratio_sas", "sas_network")):
        loss.zero_grad()
        loss(batch)[key].backward()
        moved = {name for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
        assert moved
        assert all(f".{own}." in name for name in moved)


def test_input_noise_is_drawn_in_training_only(parts, batch):
    loss = DynamicsRatioLoss(parts.estimator)
    assert loss(batch)["loss_ratio_sas"] != loss(batch)["loss_ratio_sas"]
    loss.eval()
    assert loss(batch)["loss_ratio_sas"] == loss(batch)["loss_ratio_sas"]


def test_input_noise_has_the_asked_standard_deviation(parts):
    seen = []
    batch = make_batch(4000, 4000)
    parts.estimator.sas_network.register_forward_pre_hook(lambda module, args: seen.append(args[0].clone()))
    DynamicsRatioLoss(parts.estimator, input_noise=0.3)(batch)
    for key in ("observation", "action", ("next", "observation")):
        assert (seen[0][key] - batch[key]).std().item() == pytest.approx(0.3, rel=0.05)


NEXT = ("next", "observation")


def seen_by_sas_network(estimator, batch, **kwargs):
    seen = []
    estimator.sas_network.register_forward_pre_hook(lambda module, args: seen.append(args[0].clone()))
    DynamicsRatioLoss(estimator, **kwargs)(batch)
    return seen[0]


def test_noise_named_for_one_entry_leaves_the_others_alone(parts):
    batch = make_batch(4000, 4000)
    seen = seen_by_sas_network(parts.estimator, batch, input_noise={NEXT: 0.3})
    assert (seen[NEXT] - batch[NEXT]).std().item() == pytest.approx(0.3, rel=0.05)
    assert (seen["observation"] == batch["observation"]).all()
    assert (seen["action"] == batch["action"]).all()


def test_change_is_normalised_and_its_noise_is_in_the_same_unit():
    batch, scale = make_batch(4000, 4000), torch.tensor([0.5, 1.0, 20.0], dtype=torch.float64)
    change = (batch[NEXT] - batch["observation"]) / scale
    for noise in (None, {NEXT: 0.3}):
        estimator = make_dynamics_ratio_estimator(OBSERVATION_DIM, 2, CELLS, change_scale=scale).double()
        seen = seen_by_sas_network(estimator, batch, input_noise=noise)
        if noise is None:
            torch.testing.assert_close(seen[NEXT], change)
        else:
            spread = (seen[NEXT] - change).std(0)
            torch.testing.assert_close(spread, torch.full_like(spread, 0.3), rtol=0.05, atol=0.0)


def test_each_network_has_a_bound_of_its_own(parts):
    networks, batch = (parts.estimator.sa_network, parts.estimator.sas_network), make_batch()
    with torch.no_grad():
        for network in networks:
            network.module[-1].weight.mul_(100.0)
    free, both = (
        DynamicsRatioEstimator(*networks, logit_bound=bound, residual=False).log_odds(batch)
        for bound in ((None, 0.5), 0.5)
    )
    assert free[0].abs().max() > 5.0
    assert free[1].abs().max() <= 1.0
    assert both[0].abs().max() <= 1.0


def test_one_classifier_gives_its_log_odds_as_the_log_ratio(batch):
    estimator = make_dynamics_ratio_estimator(OBSERVATION_DIM, 2, CELLS, with_sa_network=False).double()
    loss = DynamicsRatioLoss(estimator)
    assert loss.out_keys == ["loss_ratio_sas", "accuracy"]
    assert set(loss(batch).keys()) == {"loss_ratio_sas", "accuracy"}
    logits = estimator.sas_network(batch.copy())["sas_logits"]
    expected = (2.0 * torch.tanh(logits)).diff(dim=-1).neg().squeeze(-1)
    torch.testing.assert_close(estimator(batch)["log_dynamics_ratio"], expected.detach())


@pytest.mark.parametrize("with_sa_network", [True, False])
def test_next_observation_under_another_key_gives_the_same_ratio_and_corrections(batch, with_sa_network):
    key, scale = ("next", "original_observation"), torch.full((OBSERVATION_DIM,), 0.5, dtype=torch.float64)
    moved = batch.clone().set(key, batch[NEXT])
    moved[NEXT] = torch.full_like(batch[NEXT], float("nan"))  # the state n steps later, which no discriminator reads
    results = []
    for name, rows in ((NEXT, batch), (key, moved)):
        torch.manual_seed(0)
        estimator = make_dynamics_ratio_estimator(
            OBSERVATION_DIM, 2, CELLS, next_observation=name, change_scale=scale, with_sa_network=with_sa_network
        ).double()
        loss = DynamicsRatioLoss(estimator, input_noise={name: 0.1})
        torch.manual_seed(1)
        results.append(
            [
                *loss(rows).values(),
                estimator(rows.clone())["dynamics_ratio"],
                DynamicsDivergence(estimator, noise=1.0)(rows.clone())["dynamics_divergence"],
                DynamicsRewardCorrection(estimator)(rows.clone())["next", "reward"],
            ]
        )
    for of_next, of_original in zip(*results, strict=True):
        torch.testing.assert_close(of_next, of_original)


def test_scale_of_a_constant_entry_is_one():
    rows = TensorDict(
        observation=torch.zeros(3, 2), next=TensorDict(observation=torch.tensor([[0.0, 1], [0, 3], [0, 5]]))
    )
    assert fit_change_scale(rows.auto_batch_size_()).tolist() == [1.0, 2.0]


def test_weight_penalty_is_half_the_squared_weights_times_lambda(parts, batch):
    plain, penalised = (
        DynamicsRatioLoss(parts.estimator, input_noise=None, weight_penalty=penalty)(batch) for penalty in (0.0, 0.4)
    )
    for name in ("sa", "sas"):
        network = getattr(parts.estimator, f"{name}_network")
        weights = sum(p.square().sum() for key, p in network.named_parameters() if key.endswith("weight"))
        added = penalised[f"loss_ratio_{name}"] - plain[f"loss_ratio_{name}"]
        assert added.item() == pytest.approx(0.2 * weights.item(), rel=1e-9)


@pytest.mark.parametrize(
    "bad", [{"input_noise": {"nothing": 0.1}}, {"input_noise": {NEXT: -0.1}}, {"weight_penalty": -1.0}]
)
def test_noise_and_penalties_that_cannot_be_are_refused(parts, bad):
    with pytest.raises(ValueError, match=r"input_noise|weight_penalty"):
        DynamicsRatioLoss(parts.estimator, **bad)


def test_ratio_is_a_constant(parts, batch):
    assert not parts.estimator(batch)["log_dynamics_ratio"].requires_grad


def test_accuracy_weighs_both_streams_the_same(parts):
    batch = make_batch(90, 10)
    estimator = parts.estimator
    with torch.no_grad():  # a classifier that predicts 'real' for every input
        for network in (estimator.sa_network, estimator.sas_network):
            network.module[-1].weight.zero_()
            network.module[-1].bias.copy_(torch.tensor([1.0, -1.0]))
    assert DynamicsRatioLoss(estimator)(batch)["accuracy"] == pytest.approx(0.5)


def gaussian_transitions(size, real_shift, sim_shift, rng, std=0.5):
    """s' = s + a + shift(s, a) + std * noise on the line; returns a batch with ``real`` and the true log ratio."""
    real = torch.arange(size) < size // 2
    observation = torch.randn(size, 1, generator=rng)
    action = torch.rand(size, 1, generator=rng) * 2 - 1
    action = torch.where(real[:, None], action + 0.3, action)  # the ratio must not depend on the policy
    means = [observation + action + shift * torch.sin(observation + action) for shift in (real_shift, sim_shift)]
    mean = torch.where(real[:, None], *means)
    following = mean + std * torch.randn(size, 1, generator=rng)
    truth = ((following - means[1]) ** 2 - (following - means[0]) ** 2).squeeze(-1) / (2 * std**2)
    following = TensorDict(observation=following, batch_size=size)
    return TensorDict(observation=observation, action=action, real=real, next=following, batch_size=size), truth


def trained_estimator(real_shift, sim_shift, steps=600):
    torch.manual_seed(0)
    rng = torch.Generator().manual_seed(1)
    estimator = make_dynamics_ratio_estimator(1, 1, (64, 64), logit_bound=None, clamp=None)
    loss = DynamicsRatioLoss(estimator, input_noise=None)
    optimiser = torch.optim.Adam(loss.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        batch, _ = gaussian_transitions(2048, real_shift, sim_shift, rng)
        losses = loss(batch)
        optimiser.zero_grad()
        (losses["loss_ratio_sa"] + losses["loss_ratio_sas"]).backward()
        optimiser.step()
        schedule.step()
    return estimator, gaussian_transitions(10_000, real_shift, sim_shift, rng)


@pytest.mark.slow
def test_trained_log_ratio_is_the_true_one_on_gaussian_dynamics():
    estimator, (batch, truth) = trained_estimator(real_shift=0.6, sim_shift=0.0)
    got = estimator(batch)["log_dynamics_ratio"]
    correlation = torch.corrcoef(torch.stack([got, truth]))[0, 1]
    slope = (got - got.mean()).mul(truth - truth.mean()).mean() / truth.var()
    assert correlation > 0.95
    assert slope == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_trained_ratio_is_one_where_the_dynamics_agree():
    estimator, (batch, _) = trained_estimator(real_shift=0.4, sim_shift=0.4, steps=300)
    log_ratio = estimator(batch)["log_dynamics_ratio"]
    assert log_ratio.abs().mean() < 0.1


def test_a_discriminator_without_two_logits_is_refused(batch):
    one = Parts(dtype=torch.float64).qvalues[0]
    with pytest.raises(ValueError, match="two logits"):
        DynamicsRatioEstimator(one, one)(batch)


@pytest.mark.parametrize("bad", [{"logit_bound": 0.0}, {"logit_bound": (None, -1.0)}, {"clamp": (1.0, 0.5)}])
def test_bounds_that_cannot_be_are_refused(bad):
    with pytest.raises(ValueError, match=r"logit_bound|clamp"):
        make_dynamics_ratio_estimator(OBSERVATION_DIM, 1, CELLS, **bad)


def test_a_delayed_ratio_is_that_of_the_averaged_discriminators(parts, batch):
    loss = DynamicsRatioLoss(parts.estimator, input_noise=None, delay_estimator=True)
    targets, before = SoftUpdate(loss, tau=0.25), loss.estimator_params.data.clone()
    first = loss.log_and_clamped_ratio(batch)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(torch.linspace(-0.5, 0.5, parameter.numel()).view_as(parameter))
    torch.testing.assert_close(loss.log_and_clamped_ratio(batch), first)  # the targets have not moved yet
    targets.step()
    average = before.lerp(loss.estimator_params.data, 0.25)
    with average.to_module(loss.estimator):
        torch.testing.assert_close(loss.log_and_clamped_ratio(batch), loss.estimator.ratio(batch))
    assert not torch.isclose(loss.log_and_clamped_ratio(batch)[0], first[0]).any()
