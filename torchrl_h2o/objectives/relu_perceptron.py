"""A perceptron with ReLU, or an ensemble of perceptrons, as one node of the autograd graph.

If a small network is called layer by layer, the graph and memory allocation take as much time as the matrix products.
A single node applies ReLU in place, and masks gradients by the activations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


def relu_perceptron(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Apply linear layers with ReLU between them.

    Args:
        x: inputs, ``[B, in]``, shared by all members of an ensemble.
        weights: of each layer, ``[out, in]``, or of an ensemble, ``[N, out, in]``.
        biases: of each layer, ``[out]`` or ``[N, out]``.

    Raises:
        RuntimeError: in a backward pass with ``create_graph=True``; second derivatives are not implemented.

    Returns:
        ``[B, out]`` or ``[N, B, out]``.

    Examples:
        >>> import torch
        >>> relu_perceptron(torch.ones(3, 2), [torch.ones(2, 4, 2), torch.ones(2, 1, 4)], [torch.zeros(2, 4),
        ...     torch.zeros(2, 1)]).shape
        torch.Size([2, 3, 1])
    """
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (x, *weights, *biases)):
        return _ReluPerceptron.apply(x, *weights, *biases)[0]
    return _forward(x, weights, biases)[-1]


def _forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> list[Tensor]:
    """Output of each layer after its activation."""
    activations = []
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if weight.ndim == 2:
            x = F.linear(x, weight, bias)
        elif index == 0:  # all members have the same inputs, so one product computes them all
            x = F.linear(x, weight.flatten(0, 1), bias.flatten()).unflatten(-1, weight.shape[:2]).movedim(-2, 0)
        else:
            x = torch.baddbmm(bias.unsqueeze(-2), x, weight.mT)
        if index + 1 < len(weights):
            x = x.relu_()
        activations.append(x)
    return activations


class _ReluPerceptron(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, *params: Tensor) -> tuple[Tensor, ...]:
        """Return the output, and the hidden activations for the backward pass."""
        depth = len(params) // 2
        *hidden, output = _forward(x, params[:depth], params[depth:])
        return output, *hidden

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> None:
        ctx.depth = len(inputs) // 2
        ctx.mark_non_differentiable(*outputs[1:])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(inputs[0], *inputs[1 : 1 + ctx.depth], *outputs[1:])

    @staticmethod
    def backward(ctx: Any, of_output: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True
            raise RuntimeError(
                "an accelerated perceptron has no gradient of its gradient; do without accelerate(loss), or use "
                "another activation than nn.ReLU"
            )
        depth = ctx.depth
        of_input: Tensor | None = None
        of_weights: list[Tensor | None] = [None] * depth
        of_biases: list[Tensor | None] = [None] * depth
        if of_output is None:
            return of_input, *of_weights, *of_biases
        gradient: Tensor = of_output
        read = (ctx.saved_tensors[0], *ctx.saved_tensors[1 + depth :])
        weights = ctx.saved_tensors[1 : 1 + depth]
        for index in reversed(range(depth)):
            if ctx.needs_input_grad[1 + index]:
                of_weights[index] = gradient.mT @ read[index]
            if ctx.needs_input_grad[1 + depth + index]:
                of_biases[index] = gradient.sum(-2)
            if index:
                gradient = torch.ops.aten.threshold_backward(gradient @ weights[index], read[index], 0)
        if ctx.needs_input_grad[0]:
            gradient = gradient @ weights[0]
            of_input = gradient if weights[0].ndim == 2 else gradient.sum(0)
        return of_input, *of_weights, *of_biases


def relu(x: Tensor) -> Tensor:
    """Apply ReLU; faster than ``torch.relu`` in compiled losses.

    For ``torch.relu`` the compiler stores a boolean mask, which CPUs write one element at a time. This function masks
    the gradient by the sign of the output instead.
    """
    return _Relu.apply(x)


class _Relu(torch.autograd.Function):
    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.relu()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (output,) = ctx.saved_tensors
        return gradient * output.sign()
