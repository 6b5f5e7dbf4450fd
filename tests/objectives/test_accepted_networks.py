"""Networks that TorchRL's losses accept: encoders, buffers, module lists, recurrence, shared parameters, agents."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Composite
from torchrl.modules import (
    MLP,
    Delta,
    NormalParamExtractor,
    OneHotCategorical,
    ProbabilisticActor,
    TanhDelta,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SoftUpdate

from tests.objectives.conftest import ACTION_DIM, CELLS, OBSERVATION_DIM, Parts, make_batch
from torchrl_h2o.objectives import (
    ConservativeLoss,
    DynamicsRatioEstimator,
    DynamicsRatioLoss,
    ExpectileValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    make_qvalue,
    total_loss,
)

SPEC = Bounded(-1, 1, (ACTION_DIM,), dtype=torch.float64)


def module(network, keys, out):
    return TensorDictModule(network.double(), in_keys=keys, out_keys=[out])


@pytest.mark.parametrize("width", [2, 6])
def test_a_discriminator_s_logits_are_its_last_entry(batch, width):
    keys = ["observation", "action", ("next", "observation")]
    encoder = module(nn.Linear(OBSERVATION_DIM, width), ["observation"], "hidden")
    sa = TensorDictSequential(encoder, module(MLP(width + ACTION_DIM, 2, num_cells=[4]), ["hidden", "action"], "sa"))
    sas = module(MLP(2 * OBSERVATION_DIM + ACTION_DIM, 2, num_cells=[4]), keys, "sas")
    estimator = DynamicsRatioEstimator(sa, sas, logit_bound=None)
    logits = sa(batch.copy())["sa"]
    torch.testing.assert_close(estimator.log_odds(batch)[0], logits[:, 0] - logits[:, 1])


class Normaliser(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.full((OBSERVATION_DIM,), 0.5))

    def forward(self, x):
        return x - self.mean


@pytest.mark.parametrize(
    "layer", [Normaliser, lambda: nn.BatchNorm1d(OBSERVATION_DIM)], ids=["normaliser", "batch norm"]
)
def test_v_may_have_buffers(batch, layer):
    parts = Parts()
    value = ValueOperator(
        nn.Sequential(layer(), MLP(OBSERVATION_DIM, 1, num_cells=[4])).double(), in_keys=["observation"]
    )
    loss = H2OPlusLoss(MixedBellmanLoss(parts.actor, parts.qvalues, value), ExpectileValueLoss(value))
    total_loss(loss(batch)).backward()
    assert all(p.grad is not None for p in loss.value_loss.parameters())
    read, trained = loss.bellman_loss.value_network_params, loss.value_loss.value_network_params
    assert all(read.get(key) is trained.get(key) for key in read.keys(True, True))


def test_a_module_list_of_q_networks_is_an_ensemble(batch):
    parts, others = Parts(), Parts()
    loss = MixedBellmanLoss(parts.actor, nn.ModuleList(parts.qvalues), mixing=0.0)
    expected = MixedBellmanLoss(others.actor, others.qvalues, mixing=0.0)
    for one in (loss, expected):
        torch.manual_seed(0)
        one.found = one(batch.copy())["loss_qvalue"]
    assert loss.found == expected.found


def test_a_q_network_without_parameters_is_named(parts):
    fixed = TensorDictModule(
        lambda o, a: o[..., :1], in_keys=["observation", "action"], out_keys=["state_action_value"]
    )
    with pytest.raises(ValueError, match="qvalue_network has no parameters"):
        MixedBellmanLoss(parts.actor, [fixed, fixed], mixing=0.0)


class Recurrent(nn.Module):
    def __init__(self):
        super().__init__()
        self.gru, self.head = nn.GRU(OBSERVATION_DIM + ACTION_DIM, 4, batch_first=True), nn.Linear(4, 1)

    def forward(self, observation, action):
        return self.head(self.gru(torch.cat([observation, action], -1).unsqueeze(-2))[0].squeeze(-2))


def test_without_vmap_q_networks_may_be_recurrent(batch):
    parts, keys = Parts(), ["observation", "action"]
    qvalues = [module(Recurrent(), keys, "state_action_value") for _ in range(2)]
    sac = H2OPlusLoss(MixedBellmanLoss(parts.actor, qvalues, mixing=0.0, deactivate_vmap=True))
    loss = ConservativeLoss(sac)
    total_loss(loss(batch)).backward()
    gradients = {name: p.grad for name, p in loss.named_parameters() if "qvalue_network" in name}
    assert all(gradient is not None for gradient in gradients.values())
    assert any("weight_ih" in name and gradient.any() for name, gradient in gradients.items())


@pytest.mark.parametrize("layer_norm", [False, True])
def test_matrix_products_vmap_and_a_loop_give_the_same(batch, layer_norm):
    found = []
    for deactivate_vmap, as_module in ((False, False), (False, True), (True, True)):
        torch.manual_seed(0)
        qvalues = [make_qvalue(OBSERVATION_DIM, ACTION_DIM, CELLS, layer_norm=layer_norm).double() for _ in range(2)]
        loss = MixedBellmanLoss(Parts().actor, qvalues, mixing=0.0, deactivate_vmap=deactivate_vmap)
        if as_module:
            loss.qvalue_network.register_forward_hook(lambda *_: None)
        torch.manual_seed(0)
        losses = loss(batch.copy())
        losses["loss_qvalue"].backward()
        found.append([losses["loss_qvalue"], *(p.grad for p in loss.qvalue_network_params.parameters())])
    for other in found[1:]:
        torch.testing.assert_close(found[0], other, rtol=1e-9, atol=1e-12)


def with_shared_trunk(**kwargs):
    torch.manual_seed(0)
    trunk = module(nn.Linear(OBSERVATION_DIM, 4), ["observation"], "hidden")
    head = module(nn.Sequential(nn.Linear(4, 2 * ACTION_DIM), NormalParamExtractor()), ["hidden"], "loc")
    head.out_keys = ["loc", "scale"]
    family = {"in_keys": ["loc", "scale"], "spec": SPEC, "distribution_class": TanhNormal}
    actor = ProbabilisticActor(TensorDictSequential(trunk, head), **family)
    q_head = {"in_keys": ["hidden", "action"], "out_keys": ["state_action_value"]}
    qvalues = [
        TensorDictSequential(trunk, TensorDictModule(MLP(4 + ACTION_DIM, 1, num_cells=[4]).double(), **q_head))
        for _ in range(2)
    ]
    value = TensorDictSequential(trunk, module(nn.Linear(4, 1), ["hidden"], "state_value"))
    loss = H2OPlusLoss(MixedBellmanLoss(actor, qvalues, value, **kwargs), ExpectileValueLoss(value))
    return loss, trunk.module.weight


def test_a_shared_trunk_is_trained_by_every_loss(batch):
    loss, weight = with_shared_trunk()
    for key in ("loss_actor", "loss_qvalue", "loss_value"):
        weight.grad = None
        loss(batch)[key].backward()
        assert weight.grad.any(), key
    assert sum(weight is p for p in loss.parameters()) == 1


def test_with_separate_losses_the_policy_alone_trains_a_shared_trunk_and_all_use_it(batch):
    loss, weight = with_shared_trunk(separate_losses=True)
    for key, trains in (("loss_qvalue", False), ("loss_value", False), ("loss_actor", True)):
        weight.grad = None
        loss(batch)[key].backward()
        assert (weight.grad is not None and bool(weight.grad.any())) == trains, key
    weight.grad = None
    ConservativeLoss(loss)(batch)["loss_conservative"].backward()
    assert weight.grad is None
    targets = SoftUpdate(loss, tau=0.5)
    with torch.no_grad():
        weight += 1.0
    targets.step()
    path = ("module", "0", "module", "weight")
    for params in (loss.qvalue_network_params[0], loss.qvalue_network_params[1], loss.value_network_params):
        torch.testing.assert_close(params[path].data, weight.data)
    torch.testing.assert_close(loss.target_qvalue_network_params[0][path].data, weight.data - 0.5)


AGENTS, FIELDS = 3, ("observation", "action", "reward", "terminated", "state_value", "state_action_value")


def of_agents():
    """The losses of three agents that share their networks, and the networks' parts with flat keys."""
    parts, keys = Parts(), {name: ("agents", name) for name in FIELDS}
    both = [keys["observation"], keys["action"]]
    network = TensorDictModule(
        parts.actor[0].module, in_keys=both[:1], out_keys=[("agents", "loc"), ("agents", "scale")]
    )
    spec = Composite(agents=Composite(action=Bounded(-1, 1, (AGENTS, ACTION_DIM)), shape=(AGENTS,)))
    actor = ProbabilisticActor(
        network,
        in_keys={"loc": ("agents", "loc"), "scale": ("agents", "scale")},
        out_keys=[keys["action"]],
        spec=spec,
        distribution_class=TanhNormal,
    )
    qvalues = [TensorDictModule(q.module, in_keys=both, out_keys=[keys["state_action_value"]]) for q in parts.qvalues]
    value = TensorDictModule(parts.value.module, in_keys=both[:1], out_keys=[keys["state_value"]])
    sas = TensorDictModule(parts.estimator.sas_network.module, in_keys=[*both, ("next", *both[0])], out_keys=["sas"])
    sa = TensorDictModule(parts.estimator.sa_network.module, in_keys=both, out_keys=["sa"])
    loss = H2OPlusLoss(
        MixedBellmanLoss(actor, qvalues, value),
        ExpectileValueLoss(value),
        DynamicsRatioLoss(DynamicsRatioEstimator(sa, sas), input_noise=None),
    )
    loss.set_keys(
        reward=keys["reward"],
        terminated=keys["terminated"],
        done=("agents", "done"),
        value=keys["state_value"],
        state_action_value=keys["state_action_value"],
        priority=("agents", "td_error"),
    )
    return loss


@pytest.mark.parametrize("marks_of_agents", [False, True])
def test_agents_that_share_networks_have_the_losses_of_as_many_rows(marks_of_agents):
    """The policy's noise of [4, 3] agents is that of 12 rows, so every loss is that of the flat batch."""
    loss, flat, count = of_agents(), make_batch(6, 6), 4
    assert loss.target_entropy == -ACTION_DIM
    real = flat["real"].reshape(count, AGENTS)

    def nested(name, source):
        return source[name].reshape(count, AGENTS, -1)

    agents = TensorDict({name: nested(name, flat) for name in FIELDS[:2]}, batch_size=[count, AGENTS])
    following = {name: nested(name, flat["next"]) for name in ("observation", "reward", "terminated")}
    batch = TensorDict(
        agents=agents, next=TensorDict(agents=TensorDict(following, batch_size=[count, AGENTS])), batch_size=count
    )
    if marks_of_agents:
        batch["agents", "real"] = real.unsqueeze(-1)
        loss.set_keys(real=("agents", "real"))
    else:
        batch["real"] = real[:, 0]
    plain = Parts().h2o_plus()
    plain.load_state_dict(loss.state_dict(), strict=False)
    plain.eval()
    for one, given in ((loss, batch), (plain, flat)):
        torch.manual_seed(5)
        one.found = one(given)
    for key in ("loss_actor", "loss_qvalue", "loss_value", "loss_ratio_sa", "loss_ratio_sas"):
        torch.testing.assert_close(loss.found[key], plain.found[key])
    assert batch["agents", "td_error"].shape == (count, AGENTS)


ARM = {"distribution_kwargs": {"distribution_map": {"arm": TanhNormal}, "name_map": {"arm": ("action", "arm")}}}


def policy(family, out_keys, **kwargs):
    network = TensorDictModule(nn.Linear(OBSERVATION_DIM, ACTION_DIM), in_keys=["observation"], out_keys=out_keys)
    return ProbabilisticActor(network, distribution_class=family, **{"in_keys": out_keys, "spec": SPEC, **kwargs})


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: policy(OneHotCategorical, ["logits"]), "OneHotCategorical"),
        (lambda: policy(torch.distributions.Categorical, ["logits"]), "Categorical"),
        (lambda: policy(Delta, ["param"]), "Delta"),
        (lambda: policy(TanhDelta, ["param"]), "TanhDelta"),
        (
            lambda: policy(CompositeDistribution, [("params", "arm", "loc")], spec=None, in_keys=["params"], **ARM),
            "Compo",
        ),
        (lambda: TensorDictModule(nn.Linear(3, 2), in_keys=["observation"], out_keys=["action"]), "no distribution"),
    ],
    ids=["one-hot", "categorical", "delta", "tanh delta", "composite", "deterministic"],
)
def test_a_policy_without_a_density_of_one_continuous_action_is_refused(parts, make, name):
    with pytest.raises(
        ValueError, match=rf"the policy has {name}.* such as TanhNormal.*ImportanceWeightedLoss"
    ) as error:
        MixedBellmanLoss(make(), parts.qvalues, mixing=0.0)
    assert "\n" not in str(error.value)
