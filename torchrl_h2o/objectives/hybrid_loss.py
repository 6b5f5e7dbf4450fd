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


class Rows:
    """Which rows of a batch belong to which stream, and what each weighs in a mean over its own.

    Args:
        real: the rows of measured data, a mask ``[*B]``.
        sim: the simulated rows.
        either: the rows of any stream; None for all, if ``loss_mask_key`` excludes none.
    """

    def __init__(self, real: Tensor, sim: Tensor, either: Tensor | None) -> None:
        self.real, self.sim, self.either = real, sim, either
        self._weights: dict[torch.dtype, Tensor] = {}
        self._streams: dict[torch.dtype, Tensor] = {}

    def first(self, number: int) -> Rows:
        """The first rows of a flat batch alone."""
        return Rows(self.real[:number], self.sim[:number], None if self.either is None else self.either[:number])

    def weights(self, dtype: torch.dtype) -> Tensor:
        """One over the number of rows in each row's own stream, ``[*B]``."""
        if dtype not in self._weights:
            n_real, n_sim = (rows.sum(dtype=dtype).clamp_min(1.0) for rows in (self.real, self.sim))
            self._weights[dtype] = self.real / n_real + self.sim / n_sim
        return self._weights[dtype]

    def streams(self, dtype: torch.dtype) -> Tensor:
        """How many of the two streams have rows, at least one, ``[]``."""
        if dtype not in self._streams:
            self._streams[dtype] = sum(rows.any().to(dtype) for rows in (self.real, self.sim)).clamp_min(1)
        return self._streams[dtype]


class HybridLoss(LossModule):
    """Base of the losses over real (𝒟) and simulated (B) rows.

    A subclass lists what it reads in ``_read_keys`` and what it writes in ``_written_keys``, and reduces its per-row
    terms with :meth:`_expectation` over the rows of one stream or of both, or :meth:`_union_expectation`. TorchRL's
    ``loss_mask_key`` is honoured.

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
            noise: standard normal numbers that the loss then does not draw itself, see :meth:`draw_noise`. Defaults
                to ``"noise"``.
        """

        real: NestedKey = "real"
        noise: NestedKey = "noise"

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

    def _rows(self, tensordict: TensorDictBase) -> Rows:
        """Which rows of the batch belong to which stream; found once a forward and handed on."""
        real = tensordict.get(self.tensor_keys.real, None)
        if real is None:
            raise KeyError(
                f"the batch has no entry {self.tensor_keys.real!r}. Mark its rows with a boolean of the batch's "
                "shape (True for measured data), or rename the entry with set_keys(real=...)."
            )
        real = real.bool()
        if real.ndim > tensordict.ndim:
            real = real.squeeze(-1)
        sim, either = ~real, None
        for key in self._loss_mask_keys():
            valid = tensordict.get(key, None)
            if valid is not None:
                valid = self._expand_loss_mask(valid, real)
                real, sim = real & valid, sim & valid
                either = real | sim
        return Rows(real, sim, either)

    def draw_noise(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDict:
        """The standard normal numbers that a forward on this batch draws, in its order.

        A forward on a batch that has them under ``noise`` draws nothing, and returns what the generator would have
        made it return. So random numbers can come from elsewhere: from the stream of each member of a population.

        Args:
            tensordict: the batch, ``[*B]``.
            generator: torch's global one if it is None.
        """
        return TensorDict({}, batch_size=tensordict.batch_size)

    def _given_noise(self, tensordict: TensorDictBase, name: str) -> Tensor | TensorDictBase | None:
        noise = tensordict.get(self.tensor_keys.noise, None)
        return None if noise is None else noise.get(name, None)

    def _expectation(
        self, terms: Tensor, rows: Rows, among: Tensor | None = None, *, reduction: str | None = None
    ) -> Tensor:
        """The sum over streams of the mean of the terms over each: :math:`E_𝒟[.] + E_B[.]`, or one of the two.

        Args:
            terms: one a row, ``[*B]``.
            rows: of the batch. A stream without any contributes zero.
            among: ``rows.real`` or ``rows.sim``, for one expectation alone.
            reduction: instead of the loss's own.
        """
        among = rows.either if among is None else among
        # Selected, not multiplied: 0 * inf is NaN.
        selected = terms if among is None else terms.masked_fill(~among, 0.0)
        reduction = reduction or self.reduction
        if reduction == "none":
            return selected
        return (selected * rows.weights(terms.dtype) if reduction == "mean" else selected).sum()

    def _union_expectation(self, terms: Tensor, rows: Rows, reduction: str | None = None) -> Tensor:
        """:math:`E_{𝒟∪B}[.]`: both streams weigh the same, however many rows each has; one alone is that stream."""
        total = self._expectation(terms, rows, reduction=reduction)
        return total / rows.streams(terms.dtype) if (reduction or self.reduction) == "mean" else total

    def _metric(self, terms: Tensor, rows: Rows) -> Tensor:
        """A figure to log: a mean whatever the losses' reduction, or one value a row beside one loss a row."""
        return self._union_expectation(terms.detach(), rows, "none" if self.reduction == "none" else "mean")

    def _output(self, losses: dict[str, Tensor], tensordict: TensorDictBase) -> TensorDict:
        """The losses as TorchRL returns them: scalars, or one term a row with ``reduction="none"``."""
        batch_size = tensordict.batch_size if self.reduction == "none" else []
        out = TensorDict(losses, batch_size=batch_size)
        self._clear_weakrefs(tensordict, out, *(name for name, _ in self.named_children()))
        return out


def normal_like(tensor: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """What ``torch.randn_like`` draws, from a generator."""
    return torch.empty_like(tensor).normal_(generator=generator)


def like_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """``tensor`` without the trailing singleton that ``rows`` lacks: ``[*B, 1]`` becomes ``[*B]``."""
    return tensor.squeeze(-1) if tensor.ndim > rows.ndim else tensor


def total_loss(terms: dict[str, Tensor]) -> Tensor:
    """The sum of the terms named ``loss_*``: of one run, ``[]``, or of each member of a population, ``[N]``."""
    return sum(term for name, term in terms.items() if name.startswith("loss_"))
