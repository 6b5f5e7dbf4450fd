"""H2O+ as a whole: Eq. (10), beta, which loss moves which parameters, and exchange of its parts."""

import copy

import pytest
import torch
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from tests.objectives import reference
from tests.objectives.conftest import ACTION_DIM, Parts, make_batch
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    SparseValueLoss,
    make_dynamics_ratio_estimator,
    total_loss,
)

OWNERS = {
    "loss_actor": "bellman_loss.actor_network",
    "loss_qvalue": "bellman_loss.qvalue_network",
    "loss_value": "bellman_loss.value_network",  # shared with value_loss
    "loss_alpha": "bellman_loss.log_alpha",
    "loss_ratio_sa": "ratio_loss.estimator_params.sa_network",
    "loss_ratio_sas": "ratio_loss.estimator_params.sas_network",
}


@pytest.mark.parametrize("key", OWNERS)
def test_each_network_is_moved_by_the_loss_that_is_for_it_alone(parts, batch, key):
    loss = parts.h2o_plus()
    loss(batch)[key].backward()
    moved = {name for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved
    assert all(name.startswith(OWNERS[key]) for name in moved)


def test_every_parameter_is_in_the_optimiser_once_and_gets_a_gradient(parts, batch):
    loss = parts.h2o_plus()
    parameters = list(loss.parameters())
    assert len({p.data_ptr() for p in parameters}) == len(parameters)
    sum(v for k, v in loss(batch).items() if k.startswith("loss_")).backward()
    assert all(p.grad is not None for p in parameters)
    stacked_q = sum(p.numel() for q in parts.qvalues for p in q.parameters())
    others = sum(p.numel() for m in (parts.actor, parts.value, parts.estimator) for p in m.parameters())
    assert sum(p.numel() for p in parameters) == stacked_q + others + 1  # log_alpha


def test_only_the_shared_value_network_stands_twice_in_the_state_dict(parts):
    state = parts.h2o_plus().state_dict()
    pointers = {}
    for name, value in state.items():
        if isinstance(value, torch.Tensor):
            pointers.setdefault(value.data_ptr(), []).append(name)
    assert all("value_network" in name for names in pointers.values() if len(names) > 1 for name in names)


@pytest.mark.parametrize("change", [lambda loss: loss.double(), copy.deepcopy])
def test_v_stays_shared_when_the_loss_is_converted_or_copied(change):
    loss = change(Parts(dtype=torch.float32).h2o_plus())
    read, trained = loss.bellman_loss.value_network_params, loss.value_loss.value_network_params
    assert all(read.get(key) is trained.get(key) for key in read.keys(True, True))


def test_losses_of_different_value_networks_are_refused(parts):
    bellman_loss = MixedBellmanLoss(parts.actor, parts.qvalues, parts.value)
    with pytest.raises(ValueError, match="built from the same module"):
        H2OPlusLoss(bellman_loss, ExpectileValueLoss(copy.deepcopy(parts.value)))
    with pytest.raises(ValueError, match="built from the same module"):
        H2OPlusLoss(bellman_loss)


def test_the_discriminators_may_have_a_batch_of_their_own(parts, batch):
    loss, pairs = parts.h2o_plus().eval(), make_batch(5, 2, seed=9)
    own, other = loss.ratio_loss(pairs), loss.ratio_loss(batch)
    torch.manual_seed(2)
    together = loss(batch)
    torch.manual_seed(2)
    apart = loss(batch, pairs)
    for name in ("loss_ratio_sa", "loss_ratio_sas", "accuracy", "accuracy_sa"):
        torch.testing.assert_close(apart[name], own[name])
        torch.testing.assert_close(together[name], other[name])
    for name in ("loss_qvalue", "loss_actor", "loss_value", "dynamics_ratio"):
        torch.testing.assert_close(apart[name], together[name])
    with pytest.raises(ValueError, match="pass a ratio_loss"):
        Parts().h2o_plus(ratio=False)(batch, pairs)


def test_an_unweighted_loss_trains_the_discriminators_and_ignores_ratios(parts, batch):
    loss, plain = parts.h2o_plus(weighted=False).eval(), Parts().h2o_plus(ratio=False)
    plain.load_state_dict({k: v for k, v in loss.state_dict().items() if not k.startswith("ratio_loss")})
    torch.manual_seed(2)
    expected = plain(batch.copy())
    torch.manual_seed(2)
    got = loss(batch.copy().set("dynamics_ratio", torch.full(batch.shape, 0.3, dtype=torch.float64)))
    torch.testing.assert_close(got["loss_qvalue"], expected["loss_qvalue"])
    got["loss_ratio_sas"].backward()
    assert any(p.grad is not None and p.grad.any() for p in loss.ratio_loss.parameters())


def test_actor_and_alpha_losses_are_equation_10(parts, batch):
    loss = parts.h2o_plus(alpha_init=0.3)
    torch.manual_seed(4)
    action, log_prob = loss.bellman_loss.sample_action(batch)
    actor = reference.layers(loss.actor_network_params)
    qvalues = [reference.layers(loss.qvalue_network_params, member) for member in range(2)]
    terms, entropies = {True: [], False: []}, {True: [], False: []}
    for row, a, lp in zip(reference.rows(batch), action.tolist(), log_prob.tolist(), strict=True):
        loc, log_std = (reference.mlp(actor, row["observation"])[i::] for i in (0, ACTION_DIM))
        noise = [
            (torch.atanh(torch.tensor(x, dtype=torch.float64)).item() - m) / torch.tensor(s).exp().item()
            for x, m, s in zip(a, loc, log_std, strict=False)
        ]
        again, expected_log_prob = reference.policy(actor, row["observation"], noise)
        assert lp == pytest.approx(expected_log_prob, rel=1e-5)
        q = min(reference.mlp(net, row["observation"] + again)[0] for net in qvalues)
        terms[row["real"]].append(0.3 * expected_log_prob - q)
        entropies[row["real"]].append(expected_log_prob)
    torch.manual_seed(4)
    got, sampled = loss.actor_terms(batch, loss._rows(batch))
    expected = (reference.mean(terms[True]) + reference.mean(terms[False])) / 2
    assert got["loss_actor"].item() == pytest.approx(expected, rel=1e-5)
    mean_log_prob = (reference.mean(entropies[True]) + reference.mean(entropies[False])) / 2
    expected_alpha = -loss.log_alpha.item() * (mean_log_prob - ACTION_DIM)
    assert loss.alpha_loss(sampled, loss._rows(batch)).item() == pytest.approx(expected_alpha, rel=1e-5)


def test_cloning_weighs_the_policy_s_loss_by_q_and_adds_its_distance_from_the_real_actions(batch):
    found = []
    for cloning in (None, 5.0):
        loss = Parts().sac(cloning=cloning)
        torch.manual_seed(4)
        found.append(loss.actor_terms(batch, loss._rows(batch))[0])
    torch.manual_seed(4)
    action, _ = loss.bellman_loss.sample_action(batch)
    states = batch.copy().set("action", action)
    size = loss.bellman_loss.qvalues(states, loss.qvalue_network_params).amin(0).abs()
    size = (size[batch["real"]].mean() + size[~batch["real"]].mean()) / 2
    torch.testing.assert_close(found[1]["loss_actor"], 5.0 / size * found[0]["loss_actor"])
    torch.testing.assert_close(found[1]["loss_cloning"], (action - batch["action"])[batch["real"]].square().mean())
    with pytest.raises(ValueError, match="cloning must be positive"):
        Parts().sac(cloning=0.0)


def test_alpha_grows_while_the_entropy_is_below_its_target(parts, batch):
    for target, sign in ((100.0, -1), (-100.0, 1)):
        loss = parts.h2o_plus(target_entropy=target)
        loss(batch)["loss_alpha"].backward()
        assert loss.log_alpha.grad.sign() == sign


def test_the_logged_entropy_is_minus_the_mean_log_probability(parts, batch):
    loss = parts.h2o_plus(ratio=False)
    torch.manual_seed(3)
    loss.bellman_loss.mixed_target(batch)
    _, log_prob = loss.actor_terms(batch, loss._rows(batch))
    torch.manual_seed(3)
    expected = -(log_prob[batch["real"]].mean() + log_prob[~batch["real"]].mean()) / 2
    torch.testing.assert_close(loss(batch)["entropy"], expected)


def test_a_fixed_alpha_is_no_parameter(parts, batch):
    loss = parts.h2o_plus(fixed_alpha=True, alpha_init=0.2)
    assert "log_alpha" not in dict(loss.named_parameters())
    assert loss(batch)["alpha"] == pytest.approx(0.2)


def test_value_is_regressed_on_the_smaller_target_q_of_the_real_actions(parts, batch):
    loss = parts.h2o_plus(lambda v: ExpectileValueLoss(v, 0.8))
    value = reference.layers(loss.value_network_params)
    targets = [reference.layers(loss.target_qvalue_network_params, member) for member in range(2)]
    expected = reference.mean(
        [
            reference.value_penalty(
                "expectile",
                min(reference.mlp(q, row["observation"] + row["action"])[0] for q in targets)
                - reference.mlp(value, row["observation"])[0],
                0.8,
            )
            for row in reference.rows(batch)
            if row["real"]
        ]
    )
    assert loss(batch)["loss_value"].item() == pytest.approx(expected, rel=1e-10)


def test_the_loss_s_own_ratio_weighs_the_simulated_rows(parts, batch):
    parts.estimator.clamp = None
    own, given = parts.h2o_plus(), Parts().h2o_plus(ratio=False)
    given.load_state_dict({k: v for k, v in own.state_dict().items() if not k.startswith("ratio_loss")})
    losses = own(batch)
    assert "dynamics_ratio" not in batch.keys()  # a stored ratio would be used as weight in the next call
    ratio = parts.estimator(batch.copy())["dynamics_ratio"]
    assert losses["dynamics_ratio"].item() == pytest.approx(ratio[~batch["real"]].mean().item())
    torch.manual_seed(2)
    unweighted = given(batch.copy())["loss_qvalue"]
    torch.manual_seed(2)
    weighted = given(batch.copy().set("dynamics_ratio", ratio))["loss_qvalue"]
    assert weighted != unweighted
    own.ratio_loss.eval()  # without input noise the policy's samples are the same in both calls
    torch.manual_seed(2)
    torch.testing.assert_close(own(batch)["loss_qvalue"], weighted)


@pytest.mark.parametrize("backbone", [ExpectileValueLoss, SparseValueLoss, ExponentialValueLoss])
def test_swapping_the_backbone_is_one_argument(parts, batch, backbone):
    loss = parts.h2o_plus(backbone)
    before = loss(batch)["loss_value"]
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before.backward()
    optimiser.step()
    assert loss(batch)["loss_value"] < before


def test_without_a_value_loss_it_is_mixing_zero_without_v(batch):
    with_v, without_v = Parts().h2o_plus(ratio=False, mixing=0.0), Parts().sac()
    got = []
    for loss in (with_v, without_v):
        torch.manual_seed(3)
        got.append(loss(batch.copy()))
    torch.testing.assert_close(got[1], got[0].exclude("loss_value"))
    assert "loss_value" not in got[1].keys()
    assert not any("value_loss" in name for name, _ in without_v.named_parameters())


def test_without_a_value_loss_mixing_has_nothing_to_weigh(parts):
    with pytest.raises(ValueError, match=r"no value network: pass one, or mixing=0\.0"):
        MixedBellmanLoss(parts.actor, parts.qvalues, mixing=0.1)


def test_an_update_moves_every_network_and_the_targets_follow(parts, batch):
    loss = parts.h2o_plus()
    targets = SoftUpdate(loss, tau=0.005)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before = {k: v.clone() for k, v in loss.state_dict().items() if isinstance(v, torch.Tensor)}
    sum(v for k, v in loss(batch).items() if k.startswith("loss_")).backward()
    optimiser.step()
    targets.step()
    fixed = {"bellman_loss.mixing", "bellman_loss.gamma", "target_entropy"}
    still = {k for k, v in loss.state_dict().items() if k in before and torch.equal(v, before[k])}
    assert still <= fixed


def test_the_automatic_target_entropy_is_minus_the_action_s_size(parts):
    assert parts.h2o_plus().target_entropy == -float(ACTION_DIM)


def test_an_automatic_target_entropy_needs_the_action_s_spec(parts):
    actor = ProbabilisticActor(parts.actor[0], in_keys=["loc", "scale"], distribution_class=TanhNormal)
    with pytest.raises(ValueError, match="spec"):
        H2OPlusLoss(MixedBellmanLoss(actor, parts.qvalues, mixing=0.0))


def test_mean_ratio_and_effective_sample_size_are_those_of_the_simulated_rows(parts, batch):
    losses = parts.h2o_plus()(batch)
    estimated = parts.estimator(batch.copy())
    ratio, weight = (estimated[~batch["real"]][key] for key in ("log_dynamics_ratio", "dynamics_ratio"))
    assert losses["unclamped_ratio"].item() == pytest.approx(ratio.exp().mean().item())
    size = weight.sum() ** 2 / weight.square().sum() / len(weight)
    assert losses["effective_sample_size"].item() == pytest.approx(size.item())
    only_real = parts.h2o_plus()(batch[batch["real"]])
    assert only_real["effective_sample_size"] == only_real["unclamped_ratio"] == 0.0


def test_one_classifier_trained_on_pairs_takes_the_place_of_two(parts, batch):
    estimator = make_dynamics_ratio_estimator(3, 2, (8, 8), with_sa_network=False).double()
    bellman = MixedBellmanLoss(parts.actor, parts.qvalues, parts.value)
    loss = H2OPlusLoss(bellman, ExpectileValueLoss(parts.value), DynamicsRatioLoss(estimator))
    pairs = batch.select("observation", "action", "real", ("next", "observation"))
    losses = loss(batch, pairs)
    assert set(losses.keys()) == set(loss.out_keys)
    total_loss(losses).backward()
    assert all(p.grad.any() for p in loss.ratio_loss.parameters())


def test_the_target_networks_of_q_and_of_a_delayed_ratio_are_updated_together(parts, batch):
    loss = parts.h2o_plus(delay_estimator=True)
    targets = SoftUpdate(loss, tau=0.5)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(1.0)
    targets.step()
    for path in (("bellman_loss", "qvalue_network"), ("ratio_loss", "estimator")):
        part = getattr(loss, path[0])
        online, target = (getattr(part, f"{prefix}{path[1]}_params") for prefix in ("", "target_"))
        torch.testing.assert_close((online - target).data, torch.full_like(online.data, 0.5))
    torch.testing.assert_close(
        loss(batch)["unclamped_ratio"],
        loss.ratio_loss.log_and_clamped_ratio(batch[~batch["real"]])[0].exp().mean(),
    )
