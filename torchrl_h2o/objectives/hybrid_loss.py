"""Base class of the losses: the ``real`` mark, renameable keys, and expectations over the two streams.

The formulas of H2O+ are sums of expectations over two streams, the real data 𝒟 and the simulator's replay buffer B.
Each expectation is the mean over its own stream's rows, so neither the order of the rows nor the share of real rows in
a batch changes a loss.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _vmap_func

from torchrl_h2o.objectives.batch_checks import NetworkInput, entry, one_per_row, require_boolean, require_rows
from torchrl_h2o.objectives.perceptron import perceptron_output


class Rows:
    """The rows of each stream in a batch, and the weight of each row in the mean over its own stream.

    Args:
        real: mask of measured rows, ``[*B]``.
        sim: mask of simulated rows, ``[*B]``.
        either: mask of the rows of both streams; None if ``loss_mask_key`` excludes no row.
        priority: importance weights of a prioritised replay buffer, ``[*B]``; None if there are none.
        key: the entry that holds ``real``, for messages.
    """

    def __init__(
        self, real: Tensor, sim: Tensor, either: Tensor | None, priority: Tensor | None, key: NestedKey
    ) -> None:
        self.real, self.sim, self.either, self.priority, self.key = real, sim, either, priority, key
        self._like: dict[torch.Size, Rows] = {real.shape: self}
        self._weights: dict[tuple[torch.dtype, bool], Tensor] = {}

    def like(self, terms: Tensor) -> Rows:
        """Return the rows of ``terms``; of several agents, ``[*B, agents]``, all have the mark ``[*B]`` of their row.

        Raises:
            ValueError: if the marks do not fit the terms.
        """
        if terms.shape not in self._like:

            def spread(mask: Tensor) -> Tensor:
                return one_per_row(mask, terms.shape, self.key, "the loss")

            either, priority = (None if mask is None else spread(mask) for mask in (self.either, self.priority))
            self._like[terms.shape] = Rows(spread(self.real), spread(self.sim), either, priority, self.key)
        return self._like[terms.shape]

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
        return cast(Tensor, sum(rows.any().to(dtype) for rows in (self.real, self.sim))).clamp_min(1)


class HybridLoss(LossModule):
    """Base class of the losses over real (𝒟) and simulated (B) rows.

    A subclass lists the entries it reads in ``_read_keys`` and those it writes in ``_written_keys``, and reduces its
    per-row terms with :meth:`_expectation` or :meth:`_union_expectation`. TorchRL's ``loss_mask_key`` and
    ``use_prioritized_weights`` work as in TorchRL: with ``reduction="mean"`` the terms are weighted by
    ``priority_weight`` and divided by the sum of the weights, here within each stream. Rows that ``loss_mask_key``
    excludes may hold NaN.

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
    deactivate_vmap = False
    _constants: Mapping[str, set[tuple[str, ...]]] = {}  # by network, the parameters that other losses train
    _in_keys: list[NestedKey] | None
    _out_keys: list[NestedKey] | None
    _network_inputs: tuple[NetworkInput, ...] = ()  # what the networks read, as far as its size is known
    _checked_network: str | None = None  # the network whose dtype the batch must have

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
        """Entries that the loss requires: its ``in_keys``."""

    def _optional_keys(self) -> Iterable[NestedKey]:
        """Entries that the loss reads if the batch has them; as call arguments they follow the ``in_keys``."""
        return (self.tensor_keys.priority_weight,)

    @abstractmethod
    def _written_keys(self) -> Iterable[NestedKey]:
        """Entries that the loss returns: its ``out_keys``."""

    def _make_vmap(self) -> None:
        """Does nothing: ``vmap`` is applied at each call, with the ``vmap_randomness`` of that moment."""

    @property
    def in_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys(self._read_keys())) if self._in_keys is None else self._in_keys

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

    def _call(
        self, name: str, tensordict: TensorDictBase, params: TensorDictBase | None = None, *, frozen: bool = False
    ) -> TensorDictBase:
        """Run a network with parameters stored outside of it.

        Args:
            name: of the attribute that holds the network.
            tensordict: inputs, ``[*B]``. Other entries are ignored.
            params: parameters of one network, ``[]``, or of an ensemble, ``[N]``. Defaults to those of the loss.
            frozen: treat the parameters as constants, so that gradients reach the inputs only.

        Returns:
            A tensordict with the network's ``out_keys``, ``[*B]`` or ``[N, *B]``.
        """
        network, constants = getattr(self, name), self._constants.get(name)
        params = cast(TensorDictBase, getattr(self, f"{name}_params") if params is None else params)
        if frozen:
            params = params.detach()
        elif constants:
            separate = params.named_apply(lambda key, p: p.detach() if key in constants else p, nested_keys=True)
            params = cast(TensorDictBase, separate)
        inputs = tensordict.select(*network.in_keys)
        if (out := perceptron_output(network, inputs, params)) is not None:
            return out
        if params.ndim:
            modes = {"randomness": self.vmap_randomness, "pseudo_vmap": self.deactivate_vmap}
            return cast("Callable[..., TensorDictBase]", _vmap_func(network, (None, 0), **modes))(inputs, params)
        with params.to_module(network, preserve_module_state=False):
            return network(inputs)

    def _entry(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """Return a required entry, or raise a KeyError with its name."""
        return entry(tensordict, key, type(self).__name__)

    def _one_per_row(self, value: Tensor, rows: Tensor, key: NestedKey) -> Tensor:
        """Return an entry with one value per row in the shape of ``rows``, ``[*B]``."""
        return one_per_row(value, rows.shape, key, type(self).__name__)

    def _dtype_of(self, name: str) -> torch.dtype:
        """Dtype of a network's parameters.

        Raises:
            ValueError: if it has no parameters.
        """
        leaves = getattr(self, f"{name}_params").values(True, True)
        dtype = next((leaf.dtype for leaf in leaves if leaf.is_floating_point()), None)
        if dtype is None:
            raise ValueError(f"{type(self).__name__}: {name} has no parameters that could be trained.")
        return dtype

    def _masks(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Masks of TorchRL's ``loss_mask_key`` that the batch has."""
        masks = [tensordict.get(key, None) for key in self._loss_mask_keys()]
        return [mask for mask in masks if mask is not None]

    def _without_masked_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write zeros into the rows that ``loss_mask_key`` excludes: with a zero weight, NaN still gives NaN gradients.

        Returns:
            A copy, or the batch itself if no row is excluded.
        """
        masks = self._masks(tensordict)
        if not masks:
            return tensordict
        batch = tensordict.copy()
        for key in self._dispatch_keys:
            value = batch.get(key, None)
            if value is not None and value.is_floating_point():
                for mask in masks:
                    value = torch.where(self._expand_loss_mask(mask, value), value, 0.0)
                batch.set(key, value)
        return batch

    def _rows(self, tensordict: TensorDictBase) -> Rows:
        """Check the batch and sort its rows into streams; called once per forward."""
        key, name = self.tensor_keys.real, type(self).__name__
        if self._network_inputs:
            dtype = None if self._checked_network is None else self._dtype_of(self._checked_network)
            for one in self._network_inputs:
                one.check([self._entry(tensordict, key) for key in one.keys], name, dtype)
        real = tensordict.get(key, None)
        if real is None:
            raise KeyError(
                f"the batch has no entry {key!r}. Mark its rows with a boolean of the batch's shape (True for measured "
                "data), or rename the entry with set_keys(real=...)."
            )
        real = require_boolean(real, key, name)
        if real.ndim > tensordict.ndim and real.shape[-1] == 1:
            real = real.squeeze(-1)
        require_rows(real, name)
        sim, either = ~real, None
        for mask in self._masks(tensordict):
            valid = self._expand_loss_mask(mask, real)
            real, sim = real & valid, sim & valid
            either = real | sim
        priority = self._maybe_get_priority_weight(tensordict)
        if priority is not None:
            priority = self._one_per_row(priority, real, self.tensor_keys.priority_weight)
        return Rows(real, sim, either, priority, key)

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        # TorchRL's implementation looks the key up in ``keys()``, which does not contain nested keys.
        if self.use_prioritized_weights in (True, "auto"):
            return tensordict.get(self.tensor_keys.priority_weight, None)
        return None

    def _expectation(
        self,
        terms: Tensor,
        rows: Rows,
        stream: str | None = None,
        *,
        reduction: str | None = None,
        prioritised: bool = True,
    ) -> Tensor:
        """Add the means over both streams, :math:`E_𝒟[.] + E_B[.]`, or compute one of the two.

        Args:
            terms: one per row, ``[*B]``.
            rows: streams of the batch. A stream without rows contributes zero.
            stream: ``"real"`` or ``"sim"``, for one expectation only. Defaults to both streams.
            reduction: used instead of the loss's ``reduction``.
            prioritised: whether the terms are weighted by ``priority_weight``.
        """
        rows = rows.like(terms)
        among = getattr(rows, stream or "either")
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
        batch_size = tensordict.batch_size if self.reduction == "none" else torch.Size([])
        if any(term.shape[: len(batch_size)] != batch_size for term in losses.values()):
            batch_size = torch.Size([])  # the terms of an ensemble, [N, *B]
        out = TensorDict(losses, batch_size=batch_size)
        if torch.compiler.is_compiling():
            held = [module for module in self.modules() if isinstance(module, TensorDictParams)]
            self._clear_weakrefs(tensordict, out, *held)
        return out


def total_loss(terms: dict[str, Tensor]) -> Tensor:
    """Add the terms named ``loss*``. Their shape is ``[]`` for one run, ``[N]`` for a population of N runs."""
    return cast(Tensor, sum(term for name, term in terms.items() if name.startswith("loss")))
