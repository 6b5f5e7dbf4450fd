"""Trainings without random numbers, which members of a population draw in another order than single runs."""

import torch
from torch.overrides import TorchFunctionMode


class FixedNumbers(TorchFunctionMode):
    """Replaces what torch's global generator draws: normal numbers by zeros, uniform ones by evenly spaced ones.

    Drawn row numbers are then evenly spaced as well, and the same in ``PopulationReplay``, which makes them of
    ``torch.rand``, as in ``HybridReplayBuffer``, which uses ``torch.randint``.
    """

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in (torch.Tensor.normal_, torch.randn_like):
            return torch.zeros_like(args[0])
        if func is torch.rand:
            return evenly_spaced(args[-1]).expand(args).to(kwargs.get("dtype"))
        if func is torch.randint and args[1] and kwargs.get("generator") is None:  # a single one may be a seed
            high, size = args
            return (evenly_spaced(size[-1]) * high).long().expand(size)
        return func(*args, **kwargs)


def evenly_spaced(count):
    """Numbers between 0 and 1, ``[count]``."""
    return (torch.arange(count, dtype=torch.double) + 0.5) / count
