"""Detects a training that has diverged: a loss or a parameter that is NaN or infinite."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn


class DivergenceError(ArithmeticError):
    """Losses or parameters of a training are no longer finite.

    Args:
        message: the text of the error: the cause, the update and the advice.
        why: the cause alone, such as ``loss_qvalue is nan at update 1,234``, for the run's summary.
        updates: number of updates that were completed before.
    """

    def __init__(self, message: str, why: str, updates: int) -> None:
        super().__init__(message)
        self.why, self.updates = why, updates

    @property
    def failure(self) -> dict:
        """The entries of a failed run's summary: the number of updates before, and the reason."""
        return {"updates": self.updates, "why": self.why}

    def __reduce__(self) -> tuple:  # launchers send it from another process
        return type(self), (str(self), self.why, self.updates)


def not_finite_losses(terms: Mapping[str, Tensor]) -> str | None:
    """Name the losses that are not finite, with their values; None if all are.

    Args:
        terms: losses of an update, ``[]``; of these, the ones named ``loss_*`` are looked at.

    Examples:
        >>> not_finite_losses({"loss_qvalue": torch.tensor(float("nan")), "loss_actor": torch.tensor(1.0)})
        'loss_qvalue is nan'
    """
    bad = [
        f"{name} is {value}"
        for name, term in terms.items()
        if name.startswith("loss_") and not math.isfinite(value := term.item())
    ]
    return ", ".join(bad) or None


@torch.no_grad()
def are_finite(modules: Iterable[nn.Module]) -> bool:
    """Whether all parameters of some modules are finite."""
    finite: dict[torch.device, list[Tensor]] = {}
    for parameter in (parameter for module in modules for parameter in module.parameters()):
        finite.setdefault(parameter.device, []).append(parameter.isfinite().all())
    return all(bool(torch.stack(some).all()) for some in finite.values())
