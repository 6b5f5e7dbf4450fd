"""Base class of the losses: the ``real`` mark, renameable keys, and expectations over the two streams.

The formulas of H2O+ are sums of expectations over two streams, the real data 𝒟 and the simulator's replay buffer B.
Each expectation is the mean over its own stream's rows, so neither the order of the rows nor the share of real rows in
a batch changes a loss.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_h2o.objectives.batch_checks import NetworkInput, one_per_row, require_boolean, require_rows
from torchrl_h2o.objectives.network_calls import NetworkCalls


class Rows:
    """The rows of each stream in a batch, and the weight of each row in the mean over its own stream.

    Args:
        real: mask of measured rows, ``[*B]``.
        sim: mask of simulated rows, ``[*B]``.
        either: mask of the rows of both streams; None if ``loss_mask_key`` excludes no row.
        priority: importance weights of a prioritised replay buffer, ``[*B]``; None if there are none.
    """

    def __init__(self, real: Tensor, sim: Tensor, either: Tensor | None, priority: Tensor | None = None) -> None:
        self.real, self.sim, self.either, self.priority = real, sim, either, priority
        self._weights: dict[tuple[torch.dtype, bool], Tensor] = {}
        self._streams: dict[torch.dtype, Tensor] = {}

    def weights(self, dtype: torch.dtype, *, prioritised: bool = True) -> Tensor:
        """Weights that sum to one over each stream, ``[*B]``: equal, or proportional to ``priority``."""
        priority = self.priority if prioritised else None
        key = dtype, priority is not None
        if key not in self._weights:
            streams = [rows.to(dtype) for rows in (self.real, self.sim)]
            if priority is not None:
                # torch.where instead of a product with the mask, because 0 * inf is NaN.
                streams = [torch.where(rows > 0, priority.to(dtype), 0.0) for rows in streams]
            totals = [rows.sum() for rows in streams]
            self._weights[key] = sum(
                rows / torch.where(total > 0, total, 1.0) for rows, total in zip(streams, totals, strict=True)
            )
        return self._weights[key]

    def streams(self, dtype: torch.dtype) -> Tensor:
        """Number of streams that have rows, clamped to at least 1, ``[]``."""
        if dtype not in self._streams:
            count = cast(Tensor, sum(rows.any().to(dtype) for rows in (self.real, self.sim)))
            self._streams[dtype] = count.clamp_min(1)
        return self._streams[dtype]


class HybridLoss(LossModule):
    """Base class of the losses over real (𝒟) and simulated (B) rows.

    A subclass lists the entries it reads in ``_read_keys`` and those it writes in ``_written_keys``, and reduces its
    per-row terms with :meth:`_expectation` or :meth:`_union_expectation`. TorchRL's ``loss_mask_key`` and
    ``use_prioritized_weights`` work as in TorchRL: with ``reduction="mean"`` the terms are weighted by
    ``priority_weight`` and divided by the sum of the weights, here within each stream.

    Args:
        reduction (str, optional): ``"mean"`` (default) takes each expectation over its own stream;
            ``"sum"`` adds all terms; ``"none"`` returns one term per row, ``[*B]``, with zeros on the rows of a stream
            that the loss does not use.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` renames.

        Attributes:
            real: boolean of the batch's shape, True on rows of measured data. Defaults to ``"real"``.
            priority_weight: importance weights of a prioritised replay buffer, ``[*B]``, optional. Defaults to
                ``"priority_weight"``.
        """

        real: NestedKey = "real"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _in_keys: list[NestedKey] | None
    _out_keys: list[NestedKey] | None
    _network_inputs: tuple[NetworkInput, ...] = ()  # what the networks read, as far as its size is known

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
        self.calls = NetworkCalls()

    @abstractmethod
    def _read_keys(self) -> Iterable[NestedKey]:
        """Entries that the loss requires: its ``in_keys``."""

    def _optional_keys(self) -> Iterable[NestedKey]:
        """Entries that the loss reads if the batch has them; as call arguments they follow the ``in_keys``."""
        return (self.tensor_keys.priority_weight,)

    @abstractmethod
    def _written_keys(self) -> Iterable[NestedKey]:
        """Entries that the loss returns: its ``out_keys``."""

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """Does nothing: these losses compute their targets themselves and hold no value estimator."""

    @property
    def value_estimator(self) -> None:
        """Not available: these losses compute their targets themselves."""
        raise NotImplementedError(
            f"{type(self).__name__} holds no value estimator: it computes its targets itself. gamma is set by "
            "make_value_estimator(gamma=...)."
        )

    def _make_vmap(self) -> None:
        """Does nothing: ``vmap`` is applied at each call, with the ``vmap_randomness`` of that moment."""

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
        """Return a required entry, or raise a KeyError with its name."""
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(
                f"{type(self).__name__} reads {key!r} and finds {sorted(tensordict.keys(True, True), key=str)}. "
                "Add it, or name the entry that holds it with set_keys."
            )
        return value

    def _one_per_row(self, value: Tensor, rows: Tensor, key: NestedKey) -> Tensor:
        """Return an entry with one value per row in the shape of ``rows``, ``[*B]``."""
        return one_per_row(value, rows.shape, key, type(self).__name__)

    def _network_dtype(self) -> torch.dtype | None:
        """Dtype of the networks' parameters; None if the loss holds no network itself."""
        return None

    def _check_network_inputs(self, tensordict: TensorDictBase) -> None:
        if self._network_inputs:
            dtype = self._network_dtype()
            for one in self._network_inputs:
                one.check([self._entry(tensordict, key) for key in one.keys], type(self).__name__, dtype)

    def _rows(self, tensordict: TensorDictBase) -> Rows:
        """Check the batch and sort its rows into streams; called once per forward."""
        self._check_network_inputs(tensordict)
        real = tensordict.get(self.tensor_keys.real, None)
        if real is None:
            raise KeyError(
                f"the batch has no entry {self.tensor_keys.real!r}. Mark its rows with a boolean of the batch's "
                "shape (True for measured data), or rename the entry with set_keys(real=...)."
            )
        real = require_boolean(real, self.tensor_keys.real, type(self).__name__)
        if tensordict.ndim:
            real = one_per_row(real, tensordict.batch_size, self.tensor_keys.real, type(self).__name__)
        elif real.ndim:  # called with tensors: the shape of the batch is not known
            real = real.squeeze(-1)
        require_rows(real, type(self).__name__)
        sim, either = ~real, None
        for key in self._loss_mask_keys():
            valid = tensordict.get(key, None)
            if valid is not None:
                valid = self._expand_loss_mask(valid, real)
                real, sim = real & valid, sim & valid
                either = real | sim
        priority = self._maybe_get_priority_weight(tensordict)
        if priority is not None:
            priority = self._one_per_row(priority, real, self.tensor_keys.priority_weight)
        return Rows(real, sim, either, priority)

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        # TorchRL's implementation looks the key up in ``keys()``, which does not contain nested keys.
        if self.use_prioritized_weights in (True, "auto"):
            return tensordict.get(self.tensor_keys.priority_weight, None)
        return None

    def _expectation(
        self,
        terms: Tensor,
        rows: Rows,
        among: Tensor | None = None,
        *,
        reduction: str | None = None,
        prioritised: bool = True,
    ) -> Tensor:
        """Add the means over both streams, :math:`E_𝒟[.] + E_B[.]`, or compute one of the two.

        Args:
            terms: one per row, ``[*B]``.
            rows: streams of the batch. A stream without rows contributes zero.
            among: ``rows.real`` or ``rows.sim``, for one expectation only. Defaults to both streams.
            reduction: used instead of the loss's ``reduction``.
            prioritised: whether the terms are weighted by ``priority_weight``.
        """
        among = rows.either if among is None else among
        # masked_fill instead of a product with the mask, because 0 * inf is NaN.
        selected = terms if among is None else terms.masked_fill(~among, 0.0)
        reduction = reduction or self.reduction
        if reduction == "mean":
            return (selected * rows.weights(terms.dtype, prioritised=prioritised)).sum()
        if prioritised and rows.priority is not None:
            selected = selected * rows.priority
        return selected if reduction == "none" else selected.sum()

    def _union_expectation(
        self, terms: Tensor, rows: Rows, reduction: str | None = None, *, prioritised: bool = True
    ) -> Tensor:
        """Compute :math:`E_{𝒟∪B}[.]`: the average of the two streams' means, or the mean of the only stream."""
        total = self._expectation(terms, rows, reduction=reduction, prioritised=prioritised)
        return total / rows.streams(terms.dtype) if (reduction or self.reduction) == "mean" else total

    def _metric(self, terms: Tensor, rows: Rows) -> Tensor:
        """Reduce a logged quantity: the unweighted mean, or one value per row with ``reduction="none"``."""
        reduction = "none" if self.reduction == "none" else "mean"
        return self._union_expectation(terms.detach(), rows, reduction, prioritised=False)

    def _output(self, losses: dict[str, Tensor], tensordict: TensorDictBase) -> TensorDict:
        """Pack the losses as TorchRL does: scalars, or one term per row with ``reduction="none"``."""
        batch_size = tensordict.batch_size if self.reduction == "none" else []
        out = TensorDict(losses, batch_size=batch_size)
        if torch.compiler.is_compiling():
            held = [module for module in self.modules() if isinstance(module, TensorDictParams)]
            self._clear_weakrefs(tensordict, out, *held)
        return out


def total_loss(terms: dict[str, Tensor]) -> Tensor:
    """Add the terms named ``loss_*``. Their shape is ``[]`` for one run, ``[N]`` for a population of N runs."""
    return cast(Tensor, sum(term for name, term in terms.items() if name.startswith("loss_")))
