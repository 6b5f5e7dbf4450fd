"""A perceptron with ReLU, or an ensemble of them, as one node of the autograd graph.

Layer by layer, small networks spend as much time on the graph's bookkeeping and on fresh memory as on products. Written
out, an activation is clipped where it lies, and a gradient is masked by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


def relu_perceptron(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """What the last layer gives, with ReLU behind all others.

    Args:
        x: inputs, ``[B, in]``, which all members of an ensemble read.
        weights: of each layer, ``[out, in]``, or of an ensemble, ``[N, out, in]``.
        biases: of each layer, ``[out]`` or ``[N, out]``.

    Raises:
        RuntimeError: in a backward with ``create_graph=True``: there is no gradient of its gradient.

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
    """The activations behind each layer."""
    activations = []
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if weight.ndim == 2:
            x = F.linear(x, weight, bias)
        elif index == 0:  # one product for all members, as they read the same
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
        """The output, and the hidden activations, which backward needs."""
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
    def backward(ctx: Any, gradient: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True
            raise RuntimeError(
                "a perceptron that is one node of the graph has no gradient of its gradient; use "
                "layers of another type than nn.ReLU, or a hook on one, to have it layer by layer"
            )
        depth = ctx.depth
        of_input, of_weights, of_biases = None, [None] * depth, [None] * depth
        if gradient is None:
            return of_input, *of_weights, *of_biases
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
    """ReLU for compiled losses.

    For PyTorch's own the compiler keeps a mask of booleans, which CPUs write a number at a time. This one's gradient
    is masked by the sign of its output.
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
