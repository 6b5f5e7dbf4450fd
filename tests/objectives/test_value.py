"""In-sample value losses: the formulas, their gradients, and which rows enter the loss."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.autograd import gradcheck

from tests.objectives import reference
from tests.objectives.conftest import Parts, make_batch
from torchrl_h2o.objectives import ExpectileValueLoss, ExponentialValueLoss, InSampleValueLoss, SparseValueLoss

BACKBONES = {
    "expectile": (ExpectileValueLoss, 0.8),
    "sparse": (SparseValueLoss, 1.7),
    "exponential": (ExponentialValueLoss, 1.3),
}
backbones = pytest.mark.parametrize("name", BACKBONES)


def make_loss(name, **kwargs):
    cls, parameter = BACKBONES[name]
    return cls(Parts().value, parameter, **kwargs)


def with_qvalue(batch):
    rng = torch.Generator().manual_seed(5)
    return batch.set("state_action_value", 3 * torch.randn(batch.shape, generator=rng, dtype=torch.float64))


@backbones
def test_value_loss_is_equation_4(name):
    loss, batch = make_loss(name), with_qvalue(make_batch())
    network = reference.layers(loss.value_network_params)
    expected = reference.mean(
        [
            reference.value_penalty(name, q.item() - reference.mlp(network, row["observation"])[0], BACKBONES[name][1])
            for row, q in zip(reference.rows(batch), batch["state_action_value"], strict=True)
            if row["real"]
        ]
    )
    assert loss(batch)["loss_value"].item() == pytest.approx(expected, rel=1e-12)


@backbones
def test_penalty_passes_gradcheck(name):
    y = torch.tensor([-4.0, -0.5, 0.3, 2.0, 5.0], dtype=torch.float64, requires_grad=True)
    assert gradcheck(make_loss(name).penalty, y)


@backbones
def test_value_loss_passes_gradcheck_through_the_network(name):
    loss, batch = make_loss(name), with_qvalue(make_batch())

    def of_observation(observation):
        return loss(batch.copy().set("observation", observation))["loss_value"]

    assert gradcheck(of_observation, batch["observation"].clone().requires_grad_())


@backbones
def test_value_loss_ignores_simulated_rows(name):
    loss, batch = make_loss(name), with_qvalue(make_batch())
    before = loss(batch)["loss_value"]
    batch["observation"][~batch["real"]] = float("inf")
    assert torch.equal(loss(batch)["loss_value"], before)


@backbones
def test_state_action_value_is_a_constant(name):
    batch = with_qvalue(make_batch())
    batch["state_action_value"].requires_grad_()
    make_loss(name)(batch)["loss_value"].backward()
    assert batch["state_action_value"].grad is None


EXPONENTIAL = ExponentialValueLoss(Parts(dtype=torch.float32).value)  # built once for all examples


@given(st.floats(width=32, allow_nan=False), st.sampled_from([1e-3, 1.0, 100.0]))
@settings(max_examples=100, deadline=None)
def test_exponential_loss_is_finite_for_any_advantage_in_float32(advantage, alpha):
    EXPONENTIAL.alpha = alpha
    y = torch.tensor([advantage] * 256, requires_grad=True)
    out = EXPONENTIAL.penalty(y).mean()
    out.backward()
    assert out.isfinite()
    assert y.grad.isfinite().all()


@given(st.floats(-30, 6.9), st.floats(0.1, 10))
def test_exponential_gradient_is_exact_where_it_is_not_clipped(z, alpha):
    EXPONENTIAL.alpha = alpha
    y = torch.tensor(z * alpha, dtype=torch.float64, requires_grad=True)
    EXPONENTIAL.penalty(y).backward()
    expected = (torch.exp(y.detach() / alpha) - 1) / alpha
    torch.testing.assert_close(y.grad, expected, rtol=1e-12, atol=1e-12)


def test_exponential_loss_is_its_tangent_beyond_its_clip():
    loss = ExponentialValueLoss(Parts().value, alpha=2.0, clip=3.0)
    y = torch.tensor([6.0, 7.0, 1e6], dtype=torch.float64, requires_grad=True)
    out = loss.penalty(y)
    out.sum().backward()
    slope = (torch.tensor(3.0, dtype=torch.float64).exp() - 1) / 2
    torch.testing.assert_close(y.grad, slope.expand(3))
    torch.testing.assert_close(out[1] - out[0], slope)


def test_a_backbone_of_one_s_own_is_one_method():
    class Mean(InSampleValueLoss):
        def penalty(self, advantage):
            return advantage**2

    batch = with_qvalue(make_batch())
    mean, half = Mean(Parts().value), ExpectileValueLoss(Parts().value, 0.5)
    torch.testing.assert_close(mean(batch)["loss_value"], 2 * half(batch)["loss_value"])


def test_a_batch_without_the_mark_says_how_to_mark_it():
    batch = TensorDict(
        observation=torch.zeros(2, 3, dtype=torch.float64), state_action_value=torch.zeros(2), batch_size=2
    )
    with pytest.raises(KeyError, match="Mark its rows"):
        make_loss("sparse")(batch)


@pytest.mark.parametrize(
    ("cls", "bad"), [(ExpectileValueLoss, 1.0), (SparseValueLoss, 0.0), (ExponentialValueLoss, -1.0)]
)
def test_a_parameter_out_of_range_is_refused(cls, bad):
    with pytest.raises(ValueError, match=str(bad)):
        cls(Parts().value, bad)
