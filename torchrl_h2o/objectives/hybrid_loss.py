"""What every loss of this package needs, written once: the ``real`` mark, keys, and expectations over streams.

The formulas of H2O+ are sums of expectations over two streams, the real data 𝒟 and the simulator's
replay buffer B. Each expectation is the mean over that stream's own rows, so that neither the order of
the rows nor the share of real rows in a batch changes a loss.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule


class HybridLoss(LossModule):
    """Base of the losses over real (𝒟) and simulated (B) rows.

    A subclass lists what it reads in ``_read_keys`` and what it writes in ``_written_keys`` and reduces
    its per-row terms with one of :meth:`_real_mean` (:math:`E_𝒟`), :meth:`_sum_of_means`
    (:math:`E_𝒟 + E_B`) and :meth:`_mean_of_means` (:math:`E_{𝒟∪B}`). TorchRL's ``loss_mask_key`` is honoured.

    Args:
        reduction (str, optional): ``"mean"`` (default) takes each expectation over its own stream;
            ``"sum"`` adds all terms; ``"none"`` returns one term a row, of the batch's shape, and zero on
            the rows of a stream that the loss does not read.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` renames.

        Attributes:
            real: boolean of the batch's shape, True on rows of measured data. Defaults to ``"real"``.
        """

        real: NestedKey = "real"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _in_keys: list[NestedKey] | None
    _out_keys: list[NestedKey] | None

    def __init_subclass__(cls, **kwargs) -> None:
        super().__init_subclass__(**kwargs)
        cls.default_keys = cls._AcceptedKeys

    def __init__(self, *, reduction: str = "mean") -> None:
        self._in_keys = None
        self._out_keys = None
        super().__init__()
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', not {reduction!r}.")
        self.reduction = reduction

    @abstractmethod
    def _read_keys(self) -> Iterable[NestedKey]:
        """What the loss cannot do without: its ``in_keys``."""

    def _optional_keys(self) -> Iterable[NestedKey]:
        """What the loss reads if it is there: not in ``in_keys``, but dispatched like them, after them."""
        return ()

    @abstractmethod
    def _written_keys(self) -> Iterable[NestedKey]:
        """What the loss returns: its ``out_keys``."""

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """No loss here holds a value estimator: the targets are written out beside their equations."""

    @property
    def in_keys(self) -> list[NestedKey]:
        if self._in_keys is None:
            return list(dict.fromkeys(self._read_keys()))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    @property
    def _dispatch_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys((*self.in_keys, *self._optional_keys())))

    @property
    def out_keys(self) -> list[NestedKey]:
        return list(self._written_keys()) if self._out_keys is None else self._out_keys

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._out_keys = keys

    def _entry(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """An entry that the loss cannot do without."""
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(
                f"{type(self).__name__} reads {key!r} and finds {sorted(tensordict.keys(True, True), key=str)}. "
                "Add it, or name the entry that holds it with set_keys."
            )
        return value

    def _rows(self, terms: Tensor, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Real and simulated rows as two masks of the shape of ``terms``."""
        real = tensordict.get(self.tensor_keys.real, None)
        if real is None:
            raise KeyError(
                f"the batch has no entry {self.tensor_keys.real!r}. Mark its rows with a boolean of the batch's "
                "shape (True for measured data), or rename the entry with set_keys(real=...)."
            )
        real = self._expand_loss_mask(real.bool(), terms)
        sim = ~real
        for key in self._loss_mask_keys():
            valid = tensordict.get(key, None)
            if valid is not None:
                valid = self._expand_loss_mask(valid, terms)
                real, sim = real & valid, sim & valid
        return real, sim

    @staticmethod
    def _mean(terms: Tensor, rows: Tensor) -> Tensor:
        # Selected, not multiplied: 0 * inf is NaN. No row at all gives zero.
        return torch.where(rows, terms, 0.0).sum() / rows.sum().clamp_min(1)

    def _real_mean(self, terms: Tensor, tensordict: TensorDictBase) -> Tensor:
        """:math:`E_𝒟`: the mean over the real rows."""
        real, _ = self._rows(terms, tensordict)
        if self.reduction == "mean":
            return self._mean(terms, real)
        terms = torch.where(real, terms, 0.0)
        return terms.sum() if self.reduction == "sum" else terms

    def _sum_of_means(self, terms: Tensor, tensordict: TensorDictBase) -> Tensor:
        """:math:`E_𝒟 + E_B`: the mean over the real rows plus the mean over the simulated ones."""
        real, sim = self._rows(terms, tensordict)
        if self.reduction == "mean":
            return self._mean(terms, real) + self._mean(terms, sim)
        terms = torch.where(real | sim, terms, 0.0)
        return terms.sum() if self.reduction == "sum" else terms

    def _mean_of_means(self, terms: Tensor, tensordict: TensorDictBase, reduction: str | None = None) -> Tensor:
        """:math:`E_{𝒟∪B}`: both streams weigh the same, however many rows each has; one alone is that stream."""
        real, sim = self._rows(terms, tensordict)
        reduction = reduction or self.reduction
        if reduction == "mean":
            streams = real.any().to(terms.dtype) + sim.any().to(terms.dtype)
            return (self._mean(terms, real) + self._mean(terms, sim)) / streams.clamp_min(1)
        terms = torch.where(real | sim, terms, 0.0)
        return terms.sum() if reduction == "sum" else terms

    def _metric(self, terms: Tensor, tensordict: TensorDictBase) -> Tensor:
        """A figure to log: a mean whatever the losses' reduction, or one value a row beside one loss a row."""
        reduction = "none" if self.reduction == "none" else "mean"
        return self._mean_of_means(terms.detach(), tensordict, reduction)

    def _output(self, losses: dict[str, Tensor], tensordict: TensorDictBase) -> TensorDict:
        """The losses as TorchRL returns them: scalars, or one term a row with ``reduction="none"``."""
        batch_size = tensordict.batch_size if self.reduction == "none" else []
        out = TensorDict(losses, batch_size=batch_size)
        self._clear_weakrefs(tensordict, out, *(name for name, _ in self.named_children()))
        return out


def like_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """``tensor`` without the trailing singleton that ``rows`` lacks: ``[*B, 1]`` becomes ``[*B]``."""
    return tensor.squeeze(-1) if tensor.ndim > rows.ndim else tensor
