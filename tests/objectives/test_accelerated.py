"""Networks evaluated as modules or as matrix products: values and gradients agree."""

import pytest
import torch
from tensordict import TensorDict, TensorDictParams, from_modules
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator

from tests.objectives.conftest import Parts, make_batch
from torchrl_h2o.objectives import accelerate, make_actor
from torchrl_h2o.objectives.accelerated import PerceptronCalls
from torchrl_h2o.objectives.network_calls import NetworkCalls

KEYS = ["observation", "action"]
both_ways = pytest.mark.parametrize("calls", [NetworkCalls(), PerceptronCalls()], ids=["modules", "products"])


def qvalue(**kwargs):
    return ValueOperator(MLP(5, 1, num_cells=[8, 8], **kwargs), in_keys=KEYS)


def two_headed():
    trunk = nn.Sequential(MLP(3, 8, num_cells=[8]), nn.ReLU(), nn.Linear(8, 2, bias=False))
    return TensorDictModule(trunk, in_keys=["observation"], out_keys=["out"])


NETWORKS = {
    "perceptron": qvalue,
    "tanh": lambda: qvalue(activation_class=nn.Tanh),
    "sequential without a bias": two_headed,
    "normalised": lambda: qvalue(norm_class=nn.LayerNorm, norm_kwargs={"normalized_shape": 8}),
}


def transitions(*batch_size):
    return TensorDict(
        observation=torch.randn(*batch_size, 3),
        action=torch.randn(*batch_size, 2),
        other=torch.ones(batch_size),
        batch_size=batch_size,
    )


@pytest.mark.parametrize("batch_size", [(), (5,), (4, 3)], ids=str)
@pytest.mark.parametrize("name", NETWORKS)
@both_ways
def test_an_ensemble_gives_what_its_members_give(calls, name, batch_size):
    members, batch = [NETWORKS[name]() for _ in range(3)], transitions(*batch_size)
    params = from_modules(*members, as_module=True)
    out = calls.outputs(members[0], batch, params)
    (key,) = members[0].out_keys
    assert out.batch_size == (3, *batch_size)
    expected = torch.stack([member(batch.copy())[key] for member in members])
    torch.testing.assert_close(out[key], expected)
    out[key].square().sum().backward()
    expected.square().sum().backward()
    for path, gradient in params.items(True, True):
        own = torch.stack([TensorDict.from_module(member).get(path).grad for member in members])
        torch.testing.assert_close(gradient.grad, own)


@pytest.mark.parametrize("name", NETWORKS)
@both_ways
def test_one_network_runs_with_other_parameters_than_its_own(calls, name):
    network, other, batch = NETWORKS[name](), NETWORKS[name](), transitions(4)
    (key,) = network.out_keys
    got = calls.outputs(network, batch, TensorDictParams(TensorDict.from_module(other)))[key]
    torch.testing.assert_close(got, other(batch.copy())[key])
    assert not torch.allclose(got, network(batch.copy())[key])


@pytest.mark.parametrize("name", NETWORKS)
@both_ways
def test_a_frozen_network_lets_gradients_through_and_gets_none(calls, name):
    network, batch = NETWORKS[name](), transitions(4)
    params = TensorDictParams(TensorDict.from_module(network))
    batch["observation"].requires_grad_()
    (key,) = network.out_keys
    calls.outputs(network, batch, params, frozen=True)[key].square().sum().backward()
    assert batch["observation"].grad.any()
    assert all(leaf.grad is None for leaf in params.values(True, True))


@pytest.mark.parametrize("name", NETWORKS)
@both_ways
def test_mixed_precision_is_near_the_network_s_own(calls, name):
    network, batch = NETWORKS[name](), transitions(4)
    params = TensorDictParams(TensorDict.from_module(network))
    (key,) = network.out_keys
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got, expected = calls.outputs(network, batch, params)[key], network(batch.copy())[key]
    torch.testing.assert_close(got.float(), expected.float(), rtol=0.02, atol=0.01)
    got.float().square().sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in params.values(True, True))


@pytest.mark.parametrize("name", NETWORKS)
def test_the_last_layer_has_full_precision(name):
    network, batch = NETWORKS[name](), transitions(4)
    *_, bias = (layer.bias for layer in network.modules() if isinstance(layer, nn.Linear))
    if bias is not None:
        with torch.no_grad():
            bias.fill_(1001.0)  # between 1000 and 1004, which are neighbours in bfloat16
    params = TensorDictParams(TensorDict.from_module(network))
    (key,) = network.out_keys
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = PerceptronCalls().outputs(network, batch, params)[key]
    assert got.dtype == torch.float32
    torch.testing.assert_close(got, network(batch)[key], rtol=1e-6, atol=0.05)


@both_ways
def test_a_hook_is_called(calls):
    network, batch = qvalue(), transitions(4)
    network.module[0].register_forward_hook(lambda module, inputs, output: output + 1.0)
    got = calls.outputs(network, batch, TensorDictParams(TensorDict.from_module(network)))["state_action_value"]
    torch.testing.assert_close(got, network(batch.copy())["state_action_value"])


@both_ways
def test_a_policy_with_other_parameters(calls):
    actor, other = (make_actor(3, Bounded(-2, 2, (2,)), (8, 8)) for _ in range(2))
    batch = transitions(6)
    got = calls.distribution(actor, batch, TensorDictParams(TensorDict.from_module(other)))
    expected = other.get_dist(batch.select("observation"))
    action = 1.9 * torch.rand(6, 2)
    torch.testing.assert_close(got.log_prob(action), expected.log_prob(action))


@pytest.mark.parametrize("build", ["bellman", "h2o_plus", "sac"])
def test_accelerated_losses_have_the_same_numbers_and_gradients(build):
    found = []
    for change in (lambda loss: loss, accelerate):
        loss = change(getattr(Parts(), build)())
        torch.manual_seed(3)
        terms = loss(make_batch())
        sum(value for name, value in terms.items() if name.startswith("loss_")).backward()
        found.append((terms.detach(), {n: p.grad for n, p in loss.named_parameters() if p.grad is not None}))
    assert found[0][1].keys() == found[1][1].keys()
    torch.testing.assert_close(found[0][0], found[1][0])
    torch.testing.assert_close(found[0][1], found[1][1])


def test_acceleration_reaches_every_loss_of_a_tree():
    loss = accelerate(Parts().h2o_plus())
    assert all(
        isinstance(part.calls, PerceptronCalls) for part in (loss, loss.bellman_loss, loss.value_loss, loss.ratio_loss)
    )
