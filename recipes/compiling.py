"""Losses by torch.compile, where that pays and where it can be done.

It takes half a minute. After that an update takes 4 to 10 ms less, mostly of Python, and draws the same random numbers.
"""

from collections.abc import Callable

import torch
from omegaconf import DictConfig
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
        return _compiled_if_possible(losses_of) if pays and cfg.updates >= PAYS_FROM else losses_of
    return compiled(losses_of) if chosen else losses_of


def compiled(losses_of: Callable) -> Callable:
    """Losses that are compiled at their first call, and draw the random numbers of those that are not."""
    return torch.compile(losses_of, options={"fallback_random": True})


def _compiled_if_possible(losses_of: Callable) -> Callable:
    chosen = compiled(losses_of)
    is_first = True

    def call(*batches):
        nonlocal chosen, is_first
        if not is_first:
            return chosen(*batches)
        is_first = False
        try:
            return chosen(*batches)
        except TorchDynamoException as error:  # such as no C++ compiler, or one without Python's headers
            reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
            tqdm.write(f"the losses cannot be compiled here, and are slower as they are: {reason}")
            chosen = losses_of
            return chosen(*batches)

    return call
