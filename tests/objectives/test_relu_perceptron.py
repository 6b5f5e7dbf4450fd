"""The perceptron as a single node of the autograd graph: values, gradients, and stacking with vmap."""

import itertools

import pytest
import torch
from torch import nn

from torchrl_h2o.objectives.relu_perceptron import relu_perceptron

SIZES = (3, 8, 8, 2)


def parameters(*members):
    torch.manual_seed(0)
    weights = [torch.randn(*members, out, size, dtype=torch.float64) for size, out in itertools.pairwise(SIZES)]
    biases = [torch.randn(*members, out, dtype=torch.float64) for out in SIZES[1:]]
    return [tensor.requires_grad_() for tensor in (*weights, *biases)]


def call(x, *params):
    return relu_perceptron(x, params[:3], params[3:])


@pytest.fixture
def x():
    return torch.randn(5, 3, dtype=torch.float64, requires_grad=True)


def test_it_is_linear_layers_with_relu_between_them(x):
    params = parameters()
    layers = [nn.Linear(size, out, dtype=torch.float64) for size, out in itertools.pairwise(SIZES)]
    for layer, weight, bias in zip(layers, params[:3], params[3:], strict=True):
        layer.weight, layer.bias = nn.Parameter(weight), nn.Parameter(bias)
    expected = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])(x)
    torch.testing.assert_close(call(x, *params), expected)
    with torch.no_grad():
        torch.testing.assert_close(call(x, *params), expected)


@pytest.mark.parametrize("members", [(), (2,)], ids=["one", "ensemble"])
def test_gradients_are_those_of_finite_differences(x, members):
    assert torch.autograd.gradcheck(call, (x, *parameters(*members)))


@pytest.mark.parametrize("members", [(), (2,)], ids=["one", "ensemble"])
def test_what_is_frozen_gets_no_gradient_and_lets_it_through(x, members):
    params = parameters(*members)
    call(x, *(tensor.detach() for tensor in params)).sum().backward()
    assert x.grad.any()
    assert all(tensor.grad is None for tensor in params)


@pytest.mark.parametrize("members", [(), (2,)], ids=["one", "ensemble"])
def test_it_is_stacked_by_vmap(x, members):
    runs = [[tensor.detach().clone().requires_grad_() for tensor in parameters(*members)] for _ in range(3)]
    for number, params in enumerate(runs):
        for tensor in params:
            tensor.data += number
    xs = torch.randn(3, 5, 3, dtype=torch.float64)
    expected = torch.stack([call(own, *params) for own, params in zip(xs, runs, strict=True)])
    stacked = [torch.stack(own).detach().requires_grad_() for own in zip(*runs, strict=True)]
    got = torch.vmap(call)(xs, *stacked)
    torch.testing.assert_close(got, expected)
    got.square().sum().backward()
    expected.square().sum().backward()
    for own, tensor in zip(zip(*runs, strict=True), stacked, strict=True):
        torch.testing.assert_close(tensor.grad, torch.stack([run.grad for run in own]))


def test_gradients_of_gradients_are_refused(x):
    with pytest.raises(RuntimeError, match="no gradient of its gradient"):
        torch.autograd.grad(call(x, *parameters()).sum(), x, create_graph=True)
