"""Compiles losses with ``torch.compile`` where that is possible and faster.

Compilation takes half a minute, and a few seconds where an earlier process has compiled the same losses. Afterwards an
update takes 4 to 10 ms less, mostly time spent in Python, and draws the same random numbers.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch._dynamo.exc import TorchDynamoException
from tqdm import tqdm

from torchrl_h2o.training.one_graph import OneGraph

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
            graph, which is faster, see :class:`~torchrl_h2o.training.one_graph.OneGraph`.
    """
    compile_function = partial(torch.compile, options={"fallback_random": True})
    return compile_function(losses_of) if parameters is None else OneGraph(losses_of, parameters, compile_function)


class _CompiledAtFirstCall:
    """Compiles losses at the first call, with a message; uses uncompiled ones if that fails, unless ``needed``."""

    def __init__(self, losses_of: Callable, parameters: Iterable[nn.Parameter] | None, needed: bool) -> None:
        self._plain, self._parameters, self._needed = losses_of, parameters, needed
        self._chosen: Callable | None = None  # set at the first call

    def __call__(self, *batches: TensorDictBase, **noise: Any) -> Mapping[str, Tensor]:
        if self._chosen is None:
            tqdm.write("compiling the losses, half a minute the first time (compiled=false skips this)")
            # torch compiles a function at most eight times; without this, later runs in the same process would be slow
            torch.compiler.reset()
            self._chosen = compiled(self._plain, self._parameters)
            try:
                return self._chosen(*batches, **noise)
            except TorchDynamoException as error:  # for example without a C++ compiler or Python's header files
                if self._needed:
                    raise
                reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
                tqdm.write(f"the losses cannot be compiled here; the slower uncompiled ones are used: {reason}")
                self._chosen = self._plain
        return self._chosen(*batches, **noise)
