"""Losses and their gradients as one compiled graph.

``torch.compile`` makes two graphs of a loss, one of its values and one of its gradients, between which autograd passes
tensors. With small networks this takes a quarter of an update's time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
import torch._dynamo.config
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_h2o.objectives import total_loss


class OneGraph:
    """Computes losses and their gradients in one compiled graph.

    ``total_loss(terms).backward()`` then only adds these gradients to ``grad`` of the parameters.

    Args:
        losses_of: maps batches to terms by name, ``[]`` each. Those named ``loss_*`` are differentiated.
        parameters: the parameters that the losses train.
        compile_function: ``torch.compile``, perhaps with options.

    Examples:
        >>> import torch
        >>> from torchrl_h2o.objectives import total_loss
        >>> from torchrl_h2o.training.one_graph import OneGraph
        >>> weight = torch.nn.Parameter(torch.tensor(2.0))
        >>> losses_of = OneGraph(lambda batch: {"loss_value": weight**2 * batch.sum()}, [weight])
        >>> with torch.compiler.set_stance("force_eager"):  # leave this line out to compile it
        ...     total_loss(losses_of(torch.ones(3))).backward()
        >>> weight.grad
        tensor(12.)
    """

    def __init__(
        self,
        losses_of: Callable,
        parameters: Iterable[nn.Parameter],
        compile_function: Callable[[Callable], Callable] = torch.compile,
    ) -> None:
        self._losses_of = losses_of
        self._parameters = [parameter for parameter in parameters if parameter.requires_grad]
        self._compiled = compile_function(self._differentiated)

    def __call__(self, *batches: TensorDictBase, **noise: Any) -> dict[str, Tensor]:
        """Computes the terms by name.

        Raises:
            ValueError: by ``backward``, if the terms named ``loss_*`` have unequal weights in what is differentiated.
            RuntimeError: by a second ``backward`` on the same terms.
        """
        with torch._dynamo.config.patch(trace_autograd_ops=True):  # torch.autograd.grad becomes a part of the graph
            terms, gradients = self._compiled(*batches, **noise)
        names = [name for name in terms if name.startswith("loss_")]
        losses = _Differentiated.apply(torch.stack([terms[name] for name in names]), gradients, *self._parameters)
        return {**terms, **dict(zip(names, losses.unbind(), strict=True))}

    def _differentiated(
        self, *batches: TensorDictBase, **noise: Any
    ) -> tuple[dict[str, Tensor], tuple[Tensor | None, ...]]:
        terms = self._losses_of(*batches, **noise)
        gradients = torch.autograd.grad(total_loss(terms), self._parameters, allow_unused=True)
        return {name: term.detach() for name, term in terms.items()}, gradients


class _Differentiated(torch.autograd.Function):
    """Losses, ``[K]``, with the gradients of their sum, which are known."""

    @staticmethod
    def forward(ctx: Any, losses: Tensor, gradients: tuple[Tensor | None, ...], *parameters: Tensor) -> Tensor:
        ctx.gradients = gradients
        return losses.view_as(losses)

    @staticmethod
    def backward(ctx: Any, *weights: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.gradients is None:
            raise RuntimeError(
                "these losses are differentiated a second time, and their gradients are not kept after the first: "
                "compute the losses again, or use compiled=false with backward(retain_graph=True)"
            )
        first, *others = weights[0].tolist()
        if any(other != first for other in others):
            raise ValueError(
                "compiled losses are differentiated as their sum, total_loss(terms): to weight one of them, do so in "
                "the loss itself, or use compiled=false"
            )
        gradients, ctx.gradients = ctx.gradients, None
        return None, None, *(g if first == 1.0 or g is None else g * first for g in gradients)
