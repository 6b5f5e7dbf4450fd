"""Compiles losses and their gradients into one graph with ``torch.compile``, where that is possible and faster.

Compilation takes half a minute, and a few seconds where an earlier process has compiled the same losses. Afterwards an
update takes 4 to 10 ms less, mostly time spent in Python, and draws the same random numbers. ``torch.compile`` alone
makes two graphs of a loss, one of its values and one of its gradients, between which autograd passes tensors: with
small networks, a quarter of an update's time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
import torch._dynamo.config
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch._dynamo.exc import TorchDynamoException
from tqdm import tqdm

from torchrl_h2o.objectives import total_loss
from torchrl_h2o.training.interrupts import interruptible

PAYS_FROM = 10_000  # updates; in shorter trainings compilation takes longer than it saves


def maybe_compiled(
    losses_of: Callable,
    compiled: bool | str,
    updates: int,
    *,
    parameters: Iterable[nn.Parameter] | None = None,
    pays: bool = True,
) -> Callable:
    """Compiles losses if requested, or if that saves time.

    Args:
        losses_of: function that maps batches to losses.
        compiled: True, False, or ``"auto"`` to compile where that saves time.
        updates: number of updates of the training, for ``"auto"``.
        parameters: the parameters that the losses train, see :func:`compiled`.
        pays: whether compiled losses are faster than uncompiled ones, for ``"auto"``.

    Returns:
        The function, to be compiled at its first call if chosen. With ``"auto"``, if compilation fails, a message is
        written and the function stays uncompiled.
    """
    chosen = pays and updates >= PAYS_FROM if compiled == "auto" else compiled
    return _CompiledAtFirstCall(losses_of, parameters, needed=compiled is True) if chosen else losses_of


def compiled(losses_of: Callable, parameters: Iterable[nn.Parameter] | None = None) -> Callable:
    """Compiles losses that draw the same random numbers as uncompiled ones.

    The compiler stores its results in its cache folder (``TORCHINDUCTOR_CACHE_DIR``), so that the next process with the
    same losses and sizes only traces them.

    Args:
        losses_of: function that maps batches to losses.
        parameters: the parameters that the losses train. With them, the losses and the gradients of their sum are one
            graph, which is faster, see :class:`OneGraph`. TorchRL's SAC, IQL and CQL store tensors of their forward
            pass, which prevents that.
    """
    compile_function = partial(torch.compile, options={"fallback_random": True})
    return compile_function(losses_of) if parameters is None else OneGraph(losses_of, parameters, compile_function)


class _CompiledAtFirstCall:
    """Compiles losses at the first call, with a message; uses uncompiled ones if that fails, unless ``needed``."""

    def __init__(self, losses_of: Callable, parameters: Iterable[nn.Parameter] | None, needed: bool) -> None:
        self._plain, self._parameters, self._needed = losses_of, parameters, needed
        self._chosen: Callable | None = None  # set at the first call

    def __call__(self, *batches: TensorDictBase) -> Mapping[str, Tensor]:
        if self._chosen is None:
            tqdm.write("compiling the losses, half a minute the first time (compiled=false skips this)")
            # torch compiles a function at most eight times; without this, later runs in the same process would be slow
            torch.compiler.reset()
            self._chosen = compiled(self._plain, self._parameters)
            try:
                with interruptible():  # otherwise Ctrl-C could be taken for a compiler that does not work
                    return self._chosen(*batches)
            except TorchDynamoException as error:  # for example without a C++ compiler or Python's header files
                if self._needed:
                    raise
                reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
                tqdm.write(f"the losses cannot be compiled here; the slower uncompiled ones are used: {reason}")
                self._chosen = self._plain
        return self._chosen(*batches)


class OneGraph:
    """Computes losses and their gradients in one compiled graph.

    ``total_loss(terms).backward()`` then only adds these gradients to ``grad`` of the parameters.

    Args:
        losses_of: maps batches to terms by name, ``[]`` each. Those named ``loss_*`` are differentiated.
        parameters: the parameters that the losses train.
        compile_function: ``torch.compile``, perhaps with options.

    Examples:
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

    def __call__(self, *batches: TensorDictBase) -> dict[str, Tensor]:
        """Computes the terms by name.

        Raises:
            ValueError: by ``backward``, if the terms named ``loss_*`` have unequal weights in what is differentiated.
            RuntimeError: by a second ``backward`` on the same terms.
        """
        with torch._dynamo.config.patch(trace_autograd_ops=True):  # torch.autograd.grad becomes a part of the graph
            terms, gradients = self._compiled(*batches)
        names = [name for name in terms if name.startswith("loss_")]
        losses = _Differentiated.apply(torch.stack([terms[name] for name in names]), gradients, *self._parameters)
        return {**terms, **dict(zip(names, losses.unbind(), strict=True))}

    def _differentiated(self, *batches: TensorDictBase) -> tuple[dict[str, Tensor], tuple[Tensor | None, ...]]:
        terms = self._losses_of(*batches)
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
