"""Base of the losses that go around another one: its keys, its discount and its target networks show through."""

from __future__ import annotations

from collections.abc import Iterator

from torch import nn
from torchrl.objectives import LossModule

from torchrl_h2o.objectives.hybrid_loss import HybridLoss


class LossWrapper(HybridLoss):
    """A loss around a loss. ``SoftUpdate`` and ``make_value_estimator`` work on it as on the one inside.

    Args:
        loss (LossModule): the loss inside, held once.

    Keyword Args:
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.hybrid_loss.HybridLoss`.
    """

    def __init__(self, loss: LossModule, *, reduction: str = "mean") -> None:
        super().__init__(reduction=reduction)
        self.loss = loss

    def set_keys(self, **kwargs) -> None:
        """Renames the keys that this class reads itself, and every other one in the loss inside."""
        own = {key: value for key, value in kwargs.items() if hasattr(self.tensor_keys, key)}
        inside = {k: v for k, v in kwargs.items() if k not in own or hasattr(self.loss.tensor_keys, k)}
        if own:
            super().set_keys(**own)
        if inside:
            self.loss.set_keys(**inside)

    def make_value_estimator(self, *args, **kwargs) -> None:
        """That of the loss inside."""
        self.loss.make_value_estimator(*args, **kwargs)

    # What follows lets SoftUpdate find the targets of the loss inside.
    @property
    def _has_update_associated(self) -> dict[str, bool]:
        return self.loss._has_update_associated if "loss" in self._modules else {}

    @_has_update_associated.setter
    def _has_update_associated(self, value: dict[str, bool]) -> None:
        """The loss inside keeps its own."""

    def named_children(self) -> Iterator[tuple[str, nn.Module]]:
        yield from super().named_children()
        yield from ((n, m) for n, m in self.loss.named_children() if n.startswith("target_"))

    def __getattr__(self, name: str):
        if name.endswith("_params"):
            return getattr(self.loss, name)
        return super().__getattr__(name)
