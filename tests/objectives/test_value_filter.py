"""VGDF: models of the real dynamics, and the filter of simulated rows by the value to which reality would lead."""

import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded
from torchrl.modules import MLP

from tests.objectives.conftest import make_batch
from tests.objectives.test_reward_correction import two_streams
from torchrl_h2o.objectives import (
    DynamicsModelLoss,
    MixedBellmanLoss,
    ValueGuidedFilter,
    make_actor,
    make_dynamics_model,
    make_qvalue,
)


def filter_of(parts, share=0.5):
    return ValueGuidedFilter(parts.sac().bellman_loss, DynamicsModelLoss(parts.models), share)


def test_the_models_loss_is_the_negative_log_likelihood_of_real_rows(parts, batch):
    scale = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    loss = DynamicsModelLoss(parts.models, change_scale=scale)
    change = (batch["next", "observation"] - batch["observation"]) / scale
    expected = 0.0
    for model in parts.models:
        loc, raw = model(batch.copy())["change"].chunk(2, -1)
        std = (-5.0 + 5.25 * (1 + torch.tanh(raw)) / 2).exp()
        nats = -torch.distributions.Normal(loc, std).log_prob(change) - math.log(2 * math.pi) / 2
        expected += nats.mean(-1)[batch["real"]].mean()
    torch.testing.assert_close(loss(batch)["loss_dynamics"], expected)


def test_samples_are_next_observations_in_the_observation_s_units(parts, batch):
    loss = DynamicsModelLoss(parts.models, change_scale=torch.full((3,), 2.0))
    loc, log_std = loss.parameters_of_change(batch)
    torch.manual_seed(0)
    drawn = torch.stack([loss.sample(batch) for _ in range(4000)])
    torch.testing.assert_close(drawn.mean(0), batch["observation"] + 2.0 * loc, rtol=0.0, atol=0.15)
    torch.testing.assert_close(drawn.std(0), 2.0 * log_std.exp(), rtol=0.1, atol=0.0)


def test_the_proximity_is_the_likelihood_of_the_simulated_value_among_those_of_the_models(parts, batch):
    filtered = filter_of(parts)
    bellman = filtered.bellman_loss
    torch.manual_seed(5)
    proximity = filtered(batch.copy())["value_proximity"]

    def value(observation):
        states = batch.copy().set("observation", observation)
        states["action"] = bellman.sample_action(states)[0]
        return bellman.qvalues(states, bellman.target_qvalue_network_params).amin(0)

    torch.manual_seed(5)
    simulated = value(batch["next", "observation"])
    drawn = filtered.dynamics_loss.sample(batch)
    torch.manual_seed(5)  # the policy's noise is drawn before and after that of the models
    value(batch["next", "observation"]), filtered.dynamics_loss.sample(batch)
    states = batch.expand(3, 7).clone().set("observation", drawn)
    states["action"] = bellman.sample_action(states)[0]
    fictitious = bellman.qvalues(states, bellman.target_qvalue_network_params).amin(0)
    expected = torch.distributions.Normal(fictitious.mean(0), fictitious.std(0)).log_prob(simulated)
    torch.testing.assert_close(proximity, expected + math.log(2 * math.pi) / 2)
    assert not proximity.requires_grad


@pytest.mark.parametrize(("share", "kept"), [(0.25, 2), (0.5, 4), (1.0, 8), (0.01, 1)])
def test_the_share_of_simulated_rows_with_the_highest_proximity_is_kept_and_all_real_ones(parts, share, kept):
    batch = filter_of(parts, share)(make_batch(3, 8))
    real, weight, proximity = batch["real"], batch["dynamics_ratio"], batch["value_proximity"]
    assert (weight[real] == 1.0).all()
    assert set(weight.tolist()) <= {0.0, 1.0}
    assert weight[~real].sum() == kept
    lost = proximity[~real & (weight == 0)]
    assert not len(lost) or proximity[~real & (weight == 1)].min() >= lost.max()


def test_streams_may_be_missing(parts):
    filtered = filter_of(parts)
    assert filtered(make_batch(4, 0))["dynamics_ratio"].tolist() == [1.0] * 4
    assert filtered(make_batch(0, 4))["dynamics_ratio"].sum() == 2
    assert filtered(make_batch(0, 4).exclude("real"))["dynamics_ratio"].sum() == 2


def test_filtered_rows_do_not_train_q(parts, batch):
    filtered, loss = filter_of(parts, 0.3), parts.sac()
    batch = filtered(batch)
    lost = ~batch["real"] & (batch["dynamics_ratio"] == 0)
    assert lost.sum() == 2
    found = []
    for reward in (0.0, 100.0):
        batch["next", "reward"][lost] = reward
        torch.manual_seed(0)
        found.append(loss(batch.copy())["loss_qvalue"])
    assert found[0] == found[1]


def test_wrong_shares_and_single_models_are_refused(parts):
    with pytest.raises(ValueError, match="share must lie in"):
        filter_of(parts, share=0.0)
    with pytest.raises(ValueError, match="at least two models"):
        make_dynamics_model(3, 1, ensemble=1)
    two_means = TensorDictModule(MLP(5, 4, num_cells=[8]), in_keys=["observation", "action"], out_keys=["change"])
    with pytest.raises(ValueError, match=r"writes \[7, 2\] means"):
        DynamicsModelLoss(two_means)(make_batch(dtype=torch.float32))


@pytest.mark.slow
def test_a_gap_makes_simulated_values_unlikely_and_rows_of_a_right_simulator_are_preferred():
    """VGDF's premise: of rows from a right and from a wrong simulator, the filter keeps those of the right one."""
    torch.manual_seed(0)
    models = DynamicsModelLoss(make_dynamics_model(1, 1, (16, 16), ensemble=5))
    optimiser = torch.optim.Adam(models.parameters(), lr=3e-3)
    for _ in range(500):
        optimiser.zero_grad()
        models(two_streams(gap=0.0))["loss_dynamics"].backward()
        optimiser.step()
    actor, qvalues = make_actor(1, Bounded(-1, 1, (1,)), (16,)), make_qvalue(1, 1, (16,), ensemble=2)
    for qvalue in qvalues:
        torch.nn.init.normal_(qvalue.module[-1].weight)  # values that differ between states
    filtered = ValueGuidedFilter(MixedBellmanLoss(actor, qvalues, mixing=0.0), models, share=0.25)
    proximity, kept = [], []
    for gap in (0.0, 1.0, 2.0):
        simulators = [two_streams(g, 2000)[1000:] for g in (0.0, gap)]  # 1,000 rows of each
        rows = filtered(torch.cat(simulators))
        proximity.append(rows["value_proximity"][1000:].median().item())
        kept.append(rows["dynamics_ratio"][1000:].sum().item() / rows["dynamics_ratio"].sum().item())
    assert kept[0] == pytest.approx(0.5, abs=0.05)
    assert kept[2] < kept[1] < 0.35
    assert proximity[2] < proximity[1] < proximity[0] - 1.0
