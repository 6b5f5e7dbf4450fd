"""Losses by torch.compile, where that pays and where it can be done.

It takes half a minute. After that an update takes 4 to 10 ms less, mostly of Python, and draws the same random numbers.
"""

from collections.abc import Callable, Mapping

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException
from tqdm import tqdm

PAYS_FROM = 10_000  # updates


def maybe_compiled(cfg: DictConfig, losses_of: Callable, *, pays: bool = True) -> Callable:
    """Losses as ``compiled`` asks for them: compiled, as they are, or for ``auto`` compiled where that pays.

    Args:
        cfg: the run's configuration.
        losses_of: of batches.
        pays: whether compiled losses are faster, once they are compiled.

    Returns:
        The same losses. For ``auto`` they stay as they are on a machine that cannot compile them, and say so.
    """
    chosen = cfg.get("compiled", False)  # a run of an earlier version says nothing of it
    if chosen == "auto":
        chosen = pays and cfg.updates >= PAYS_FROM
    return _Announced(losses_of, needed=cfg.compiled is True) if chosen else losses_of


def compiled(losses_of: Callable) -> Callable:
    """Losses that are compiled at their first call, and draw the random numbers of those that are not."""
    return torch.compile(losses_of, options={"fallback_random": True})


class _Announced:
    """Compiled losses that say what takes so long; where it cannot be done, and need not, the losses as they are."""

    def __init__(self, losses_of: Callable, needed: bool) -> None:
        self._plain, self._needed = losses_of, needed
        self._chosen: Callable | None = None  # until the first call

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
