"""Checks of a batch where a loss reads it: boolean marks, one value per row, and the sizes of the networks' inputs.

The checks look at shapes and dtypes only. They take microseconds, run inside ``vmap`` and cost nothing when compiled,
because they are evaluated during tracing. Values such as NaN are checked once, where data enter: by the readers and by
:class:`~torchrl_h2o.data.HybridReplayBuffer`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP


@dataclass(frozen=True)
class NetworkInput:
    """Entries of a batch whose last dimensions have a known total size.

    Args:
        keys: entries that a perceptron reads side by side.
        width: sum of the sizes of their last dimensions.
    """

    keys: tuple[NestedKey, ...]
    width: int

    def check(self, values: Sequence[Tensor], reader: str, dtype: torch.dtype | None) -> None:
        """Check the entries of a batch.

        Args:
            values: the entries, ``[*B, width]`` in total.
            reader: name of the loss, for the message.
            dtype: dtype of the network's parameters, or None to accept any floating-point dtype.

        Raises:
            ValueError: for another total width, or another dtype.
        """
        for key, value in zip(self.keys, values, strict=True):
            any_float = dtype is None or torch.is_autocast_enabled(value.device.type)
            if value.dtype != dtype and not (any_float and value.is_floating_point()):
                expected = dtype or torch.get_default_dtype()
                raise ValueError(
                    f"{reader}: {key!r} is {value.dtype}, and its network was built for {expected}: convert the data "
                    f"with .to({expected}), or the loss with .to(...)."
                )
        width = sum(value.shape[-1] if value.ndim else 1 for value in values)
        if width == self.width:
            return
        found = " and ".join(f"{key!r} {list(v.shape)}" for key, v in zip(self.keys, values, strict=True))
        expected = (
            f"expected {[*values[0].shape[:-1], self.width]}"
            if len(values) == 1
            else f"last dimensions of {width} in total, expected {self.width}"
        )
        raise ValueError(
            f"{reader}: the batch has {found}, {expected}: the networks were built for another size. Build them from "
            "the specs of the environment that the batch comes from."
        )


def network_inputs(network: object, prefix: str | None = None) -> list[NetworkInput]:
    """Describe what a network reads if its first layer is linear, so that its size is known; else an empty list.

    Args:
        network: a TensorDict module, a sequence of alike modules, or None.
        prefix: key below which the network's input is in the batch, such as ``"next"``.
    """
    if isinstance(network, Sequence):
        network = network[0]
    if not isinstance(network, TensorDictModuleBase):
        return []
    keys, layer, concatenates = list(network.in_keys), cast(nn.Module, network), False
    while isinstance(layer, TensorDictModuleBase | nn.Sequential | nn.ModuleList):
        if isinstance(layer, TensorDictModuleBase):
            if list(layer.in_keys) != keys or not hasattr(layer, "module"):
                return []
            layer = cast(nn.Module, layer.module)
        else:
            if not len(layer):
                return []
            concatenates |= isinstance(layer, MLP)
            layer = layer[0]
    if not isinstance(layer, nn.Linear) or not layer.in_features or (len(keys) > 1 and not concatenates):
        return []  # in_features is 0 in a lazy layer before its first call
    placed = [cast(NestedKey, unravel_key(key if prefix is None else (prefix, key))) for key in keys]
    return [NetworkInput(tuple(placed), layer.in_features)]


def separated(inputs: Iterable[NetworkInput]) -> tuple[NetworkInput, ...]:
    """Subtract the inputs contained in other inputs, so that a message names as few entries as possible.

    Raises:
        ValueError: if two networks were built for different sizes of the same entries.

    Examples:
        >>> both = NetworkInput(("observation", "action"), 23)
        >>> [one.width for one in separated([both, NetworkInput(("observation",), 17)])]
        [17, 6]
    """
    smallest: list[NetworkInput] = []
    for one in sorted(dict.fromkeys(inputs), key=lambda one: len(one.keys)):
        keys, width = list(one.keys), one.width
        for part in smallest:
            if set(part.keys) <= set(keys):
                keys, width = [key for key in keys if key not in part.keys], width - part.width
        if (width <= 0) if keys else width:
            known = " and ".join(repr(key) for key in one.keys if key not in keys)
            raise ValueError(
                f"a network was built for {one.width} numbers of {' and '.join(map(repr, one.keys))}, while {known} "
                f"have {one.width - width} by the other networks or the action's spec: build all for the same sizes."
            )
        if keys:
            smallest.append(NetworkInput(tuple(keys), width))
    return tuple(smallest)


def entry(tensordict: TensorDictBase, key: NestedKey, reader: str) -> Tensor:
    """Return an entry of a batch, or raise a KeyError that names it."""
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"{reader} reads {key!r} and finds {sorted(tensordict.keys(True, True), key=str)}. Add it, or name the "
            "entry that holds it with set_keys."
        )
    return value


def require_boolean(value: Tensor, key: NestedKey, reader: str) -> Tensor:
    """Return a mark of rows, such as ``real`` or ``terminated``.

    Raises:
        ValueError: for another dtype. Converted, 0.5 and NaN would count as True.
    """
    if value.dtype != torch.bool:
        raise ValueError(
            f"{reader}: {key!r} is {value.dtype}, expected torch.bool: write batch[{key!r}] = batch[{key!r}].bool() "
            "after checking that every value is 0 or 1."
        )
    return value


def one_per_row(value: Tensor, shape: torch.Size, key: NestedKey, reader: str) -> Tensor:
    """Return an entry with one value per row as ``[*B]``.

    Args:
        value: the entry, ``[*B]`` or ``[*B, 1]``. Of rows with several agents, ``[*B, agents]``, a value ``[*B]`` is
            for all agents.
        shape: the shape of the rows.
        key: the entry's key, for the message.
        reader: name of the loss, for the message.

    Raises:
        ValueError: for another shape, which could be broadcast without an error.
    """
    squeezed = value.squeeze(-1) if value.ndim > 1 and value.shape != shape else value
    if squeezed.shape == shape:
        return squeezed
    if 0 < squeezed.ndim < len(shape) and squeezed.shape == shape[: squeezed.ndim]:
        return squeezed.reshape(*squeezed.shape, *(1,) * (len(shape) - squeezed.ndim)).expand(shape)
    raise ValueError(
        f"{reader}: {key!r} has the shape {list(value.shape)}, expected one value per row, {list(shape)} or "
        f"{[*shape, 1]}."
    )


def require_rows(value: Tensor, reader: str) -> None:
    """Raise a ValueError for a batch without rows, because the mean over no rows is NaN."""
    if not value.numel():
        raise ValueError(f"{reader}: the batch has the shape {list(value.shape)}, so it is empty: give at least a row.")
