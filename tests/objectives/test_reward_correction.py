"""DARC's reward: the correction of simulated steps, which is zero if the simulator is exact."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SACLoss

from tests.objectives import reference
from tests.objectives.conftest import Parts, make_batch
from torchrl_h2o.objectives import DynamicsRatioLoss, DynamicsRewardCorrection, make_dynamics_ratio_estimator


def log_ratio_of(estimator, row):
    """Eq. (9) from probabilities, in Python floats."""
    sa_network, sas_network = (reference.layers(TensorDict.from_module(n)) for n in networks(estimator))
    sa, sas = row["observation"] + row["action"], row["observation"] + row["action"] + row["next_observation"]
    added = reference.bounded(reference.mlp(sa_network, sa), 2.0)
    p_sa = reference.discriminator_probability(sa_network, sa, 2.0)
    p_sas = reference.discriminator_probability(sas_network, sas, 2.0, added)
    return math.log((1 - p_sa) / p_sa) - math.log((1 - p_sas) / p_sas)


def networks(estimator):
    return estimator.sa_network, estimator.sas_network


def without_gap(estimator):
    """Discriminators for which s' adds no information to (s, a)."""
    with torch.no_grad():
        for parameter in estimator.sas_network.parameters():
            parameter.zero_()
    return estimator


def test_simulated_steps_are_paid_the_log_ratio_too_and_real_ones_are_not(parts, batch):
    expected = [
        row["reward"] + (0.0 if row["real"] else 0.5 * log_ratio_of(parts.estimator, row))
        for row in reference.rows(batch)
    ]
    corrected = DynamicsRewardCorrection(parts.estimator, scale=0.5)(batch)
    assert corrected["next", "reward"].squeeze(-1).tolist() == pytest.approx(expected, rel=1e-10)


def test_a_clip_bounds_the_measure_before_it_is_scaled(parts, batch):
    measure = [log_ratio_of(parts.estimator, row) for row in reference.rows(batch)]
    expected = [
        row["reward"] + (0.0 if row["real"] else 0.5 * min(max(u, -0.1), 0.1))
        for row, u in zip(reference.rows(batch), measure, strict=True)
    ]
    assert max(map(abs, measure)) > 0.1
    corrected = DynamicsRewardCorrection(parts.estimator, scale=0.5, clip=0.1)(batch)
    assert corrected["next", "reward"].squeeze(-1).tolist() == pytest.approx(expected, rel=1e-10)


def test_any_module_that_measures_the_gap_corrects_rewards(parts, batch):
    plain = batch["next", "reward"].squeeze(-1).clone()
    corrected = DynamicsRewardCorrection(parts.representation, scale=-2.0)(batch)["next", "reward"].squeeze(-1)
    deviation = parts.representation(batch)["representation_deviation"]
    torch.testing.assert_close(corrected, plain - 2.0 * torch.where(batch["real"], 0.0, deviation))


def test_without_a_mark_every_step_is_simulated(parts, batch):
    expected = [row["reward"] + log_ratio_of(parts.estimator, row) for row in reference.rows(batch)]
    corrected = DynamicsRewardCorrection(parts.estimator)(batch.exclude("real"))
    assert corrected["next", "reward"].squeeze(-1).tolist() == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_an_n_step_row_is_corrected_once_for_each_of_its_steps(parts, batch, gamma):
    batch["steps_to_next_obs"] = 1 + torch.arange(len(batch))[:, None] % 3
    one_step = DynamicsRewardCorrection(parts.estimator)(batch.clone().exclude("steps_to_next_obs"))
    n_step = DynamicsRewardCorrection(parts.estimator, gamma=gamma)(batch.clone())
    counted = torch.tensor([sum(gamma**k for k in range(m)) for m in batch["steps_to_next_obs"].flatten()])
    correction = [td["next", "reward"].flatten() - batch["next", "reward"].flatten() for td in (n_step, one_step)]
    torch.testing.assert_close(correction[0], counted.to(correction[1]) * correction[1])


def test_where_dynamics_are_equal_darc_is_sac(batch):
    got = []
    for correct in (lambda td: td, DynamicsRewardCorrection(without_gap(Parts().estimator))):
        parts = Parts()
        loss = SACLoss(parts.actor, parts.qvalues, loss_function="l2")
        torch.manual_seed(3)
        got.append(loss(correct(batch.exclude("real"))))
    torch.testing.assert_close(*got, rtol=0.0, atol=0.0)


@pytest.mark.slow
def test_discriminators_that_have_learnt_correct_little_in_a_right_simulator_and_much_in_a_wrong_one():
    corrections = {}
    for gap in (0.0, 1.0):
        torch.manual_seed(0)
        estimator = make_dynamics_ratio_estimator(1, 1, (16, 16))
        loss = DynamicsRatioLoss(estimator)
        optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
        for _ in range(300):
            optimiser.zero_grad()
            losses = loss(two_streams(gap))
            (losses["loss_ratio_sa"] + losses["loss_ratio_sas"]).backward()
            optimiser.step()
        steps = two_streams(gap)
        before = steps["next", "reward"].clone()
        after = DynamicsRewardCorrection(estimator)(steps)["next", "reward"]
        corrections[gap] = (after - before)[~steps["real"]].mean().item()
    assert abs(corrections[0.0]) < 0.1
    assert corrections[1.0] < -0.5


def two_streams(gap, size=256):
    """s' = s + a + noise in both streams, plus ``gap`` in the simulator; the states also differ between the streams."""
    real = torch.arange(size) < size // 2
    observation = torch.randn(size, 1) + 0.5 * real[:, None]
    action = torch.randn(size, 1)
    after = observation + action + 0.3 * torch.randn(size, 1) + gap * ~real[:, None]
    then = TensorDict(observation=after, reward=torch.zeros(size, 1), batch_size=size)
    return TensorDict(observation=observation, action=action, real=real, next=then, batch_size=size)


def test_a_replay_buffer_takes_it_as_its_transform_and_keeps_what_it_stores(parts):
    batch = make_batch(0, 8).exclude("real")
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(8), transform=DynamicsRewardCorrection(parts.estimator), batch_size=8
    )
    buffer.extend(batch)
    sampled = buffer.sample()
    plain = sampled.clone()
    plain["next", "reward"] = sampled["next", "reward"] * 0
    difference = DynamicsRewardCorrection(parts.estimator)(plain)["next", "reward"]
    stored = buffer.storage[:]["next", "reward"]
    torch.testing.assert_close(stored, batch["next", "reward"], rtol=0.0, atol=0.0)
    original = sampled["next", "reward"] - difference
    assert torch.isclose(original, stored.T).any(-1).all()
    assert difference.abs().min() > 0


def test_the_correction_is_a_constant(parts, batch):
    corrected = DynamicsRewardCorrection(parts.estimator)(batch)
    assert not corrected["next", "reward"].requires_grad
