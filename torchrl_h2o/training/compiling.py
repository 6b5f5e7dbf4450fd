"""Compiles losses with ``torch.compile`` where that is faster and possible.

Compiling takes half a minute. After it an update takes 4 to 10 ms less, mostly of Python, and draws the same random
numbers.
"""

from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException
from tqdm import tqdm

PAYS_FROM = 10_000  # updates; fewer do not make up for the time of compiling


def maybe_compiled(losses_of: Callable, compiled: bool | str, updates: int, *, pays: bool = True) -> Callable:
    """Compiles losses if that is asked for, or if it saves time.

    Args:
        losses_of: function of batches.
        compiled: True, False, or ``"auto"`` for compiled where that saves time.
        updates: length of the training, for ``"auto"``.
        pays: whether compiled losses are faster at all, for ``"auto"``.

    Returns:
        The losses, compiled at their first call. With ``"auto"`` on a machine without a compiler they stay uncompiled,
        which is reported.
    """
    chosen = pays and updates >= PAYS_FROM if compiled == "auto" else compiled
    return _CompiledAtFirstCall(losses_of, needed=compiled is True) if chosen else losses_of


def compiled(losses_of: Callable) -> Callable:
    """Compiles losses so that they draw the same random numbers as uncompiled ones."""
    return torch.compile(losses_of, options={"fallback_random": True})


class _CompiledAtFirstCall:
    """Reports why the first call takes long; falls back to uncompiled losses unless compiled ones are needed."""

    def __init__(self, losses_of: Callable, needed: bool) -> None:
        self._plain, self._needed = losses_of, needed
        self._chosen: Callable | None = None  # set at the first call

    def __call__(self, *batches: TensorDictBase) -> Mapping[str, Tensor]:
        if self._chosen is None:
            tqdm.write("compiling the losses, about half a minute (compiled=false does without)")
            self._chosen = compiled(self._plain)
            try:
                return self._chosen(*batches)
            except TorchDynamoException as error:  # such as no C++ compiler, or one without Python's headers
                if self._needed:
                    raise
                reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
                tqdm.write(f"they cannot be compiled here, and are slower as they are: {reason}")
                self._chosen = self._plain
        return self._chosen(*batches)
