"""Base class of losses that contain another loss and expose its keys, its discount and its target networks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_h2o.objectives.batch_checks import NetworkInput
from torchrl_h2o.objectives.hybrid_loss import HybridLoss


class LossWrapper(HybridLoss):
    """A loss around an inner loss. ``SoftUpdate``, ``make_value_estimator`` and ``set_keys`` apply to the inner loss.

    Args:
        loss (LossModule): the inner loss.

    Keyword Args:
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.HybridLoss`.
    """

    # Name of the attribute that holds the inner loss.
    _inside_name = "loss"

    def __init__(self, loss: LossModule, *, reduction: str = "mean") -> None:
        super().__init__(reduction=reduction)
        setattr(self, self._inside_name, loss)

    @property
    def _inside(self) -> LossModule:
        return cast(LossModule, self._inside_if_set)

    @property
    def _inside_if_set(self) -> LossModule | None:
        """The loss inside; None while the base class's constructor runs."""
        return self.__dict__.get("_modules", {}).get(self._inside_name)

    @property
    def _network_inputs(self) -> tuple[NetworkInput, ...]:
        return getattr(self._inside, "_network_inputs", ())

    @property
    def _checked_network(self) -> str | None:
        return getattr(self._inside, "_checked_network", None)

    @property
    def deactivate_vmap(self) -> bool:
        return getattr(self._inside, "deactivate_vmap", False)

    @property
    def _constants(self) -> Mapping[str, set[tuple[str, ...]]]:
        return getattr(self._inside, "_constants", {})

    def _terms_inside(self, batch: TensorDictBase, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Compute the terms of the inner loss, and copy the td error that it writes into ``batch``."""
        terms, key = dict(self._inside(batch).items()), getattr(self._inside.tensor_keys, "priority", None)
        if batch is not tensordict and key is not None and (error := batch.get(key, None)) is not None:
            tensordict.set(key, error)
        return terms

    @property
    def _parts(self) -> list[LossModule]:
        """Inner losses that receive the settings of this loss."""
        return [self._inside]

    def set_keys(self, **kwargs) -> None:
        """Rename the keys that this class reads, and all other keys in the inner loss."""
        inside = self._inside
        own = {key: value for key, value in kwargs.items() if hasattr(self.tensor_keys, key)}
        others = {k: v for k, v in kwargs.items() if k not in own or hasattr(inside.tensor_keys, k)}
        if own:
            super().set_keys(**own)
        if others:
            inside.set_keys(**others)

    def make_value_estimator(self, *args, **kwargs) -> LossWrapper:
        """Set the value estimator of the inner loss."""
        self._inside.make_value_estimator(*args, **kwargs)
        return self

    @property
    def value_estimator(self):
        """Value estimator of the inner loss."""
        return self._inside.value_estimator

    @property
    def vmap_randomness(self) -> str:
        return self._inside.vmap_randomness

    def set_vmap_randomness(self, value: str) -> None:
        for part in self._parts:
            part.set_vmap_randomness(value)

    @property
    def loss_mask_key(self) -> NestedKey | str | None:
        return self._loss_mask_key

    @loss_mask_key.setter
    def loss_mask_key(self, key: NestedKey | str | None) -> None:
        HybridLoss.loss_mask_key.__set__(self, key)
        for part in self._parts:
            part.loss_mask_key = key

    @property
    def use_prioritized_weights(self) -> str | bool:
        return self._inside.use_prioritized_weights

    @use_prioritized_weights.setter
    def use_prioritized_weights(self, value: str | bool) -> None:
        for part in self._parts:
            part.use_prioritized_weights = value

    def reset_parameters_recursive(self) -> None:
        for part in self._parts:
            part.reset_parameters_recursive()

    def _load_from_state_dict(self, *args, **kwargs) -> None:
        # TorchRL's losses register the buffer of an automatic target entropy at its first use. A state_dict contains
        # that buffer, so it must exist before the inner loss is loaded.
        if "_target_entropy" in self._inside.__dict__:
            _ = self._inside.target_entropy
        super()._load_from_state_dict(*args, **kwargs)

    # SoftUpdate finds the target networks of the inner losses through the property and the method below.
    @property
    def _has_update_associated(self) -> dict[str, bool]:
        inside = self._inside_if_set
        return {} if inside is None else inside._has_update_associated

    @_has_update_associated.setter
    def _has_update_associated(self, value: dict[str, bool]) -> None:
        """Does nothing: the inner loss keeps its own record."""

    def named_children(self) -> Iterator[tuple[str, nn.Module]]:
        yield from super().named_children()
        for part in self._parts:
            yield from ((name, module) for name, module in part.named_children() if name.startswith("target_"))

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_params") and (inside := self._inside_if_set) is not None:
            return getattr(inside, name)
        return super().__getattr__(name)
