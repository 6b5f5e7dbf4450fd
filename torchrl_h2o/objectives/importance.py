"""Weight each row of any TorchRL loss by the dynamics ratio."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_h2o.objectives.batch_checks import one_per_row, require_boolean, require_rows
from torchrl_h2o.objectives.loss_wrapper import LossWrapper


class ImportanceWeightedLoss(LossWrapper):
    """Multiply every row's terms of a TorchRL loss by a weight from the batch.

    If the batch has ``real``, rows marked True keep weight 1, as in Eq. (8): measured rows need no correction. Only
    terms named ``loss...`` are weighted, and gradients do not pass through the weights. With weights of one, the result
    is that of ``loss`` with ``reduction="mean"``, also with the weights of a prioritised replay buffer. ``SoftUpdate``
    accepts this loss and updates the targets of ``loss``.

    Args:
        loss (LossModule): built with ``reduction="none"`` (TorchRL's SACLoss and IQLLoss also need
            ``scalar_output_mode="exclude"``).
        key (NestedKey, optional): the weights, ``[*B]`` or ``[*B, 1]``. Defaults to ``"dynamics_ratio"``.

    Keyword Args:
        terms (sequence of str, optional): the weighted terms, such as ``["loss_qvalue"]`` for only the Bellman
            error. Defaults to every term named ``loss...``. Terms are ``[*B]`` or, of an ensemble, ``[N, *B]``.
        reduction (str, optional): ``"none"`` | ``"mean"`` | ``"sum"`` of the weighted terms over all rows.
            Defaults to ``"mean"``.

    Raises:
        ValueError: if ``loss`` reduces its terms, writes none named ``loss...``, or does not write one of ``terms``.
        KeyError: if the batch has no weights.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eq. (8), the weight P / P̂.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SACLoss, SoftUpdate
        >>> from torchrl_h2o.objectives import make_actor, make_qvalue
        >>> actor = make_actor(observation_dim=3, action_spec=Bounded(-1, 1, (1,)))
        >>> sac = SACLoss(actor, make_qvalue(3, 1), reduction="none", scalar_output_mode="exclude")
        >>> loss = ImportanceWeightedLoss(sac)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> step = {"done": torch.zeros(4, 1, dtype=torch.bool), "terminated": torch.zeros(4, 1, dtype=torch.bool)}
        >>> batch = TensorDict(observation=torch.randn(4, 3), action=torch.rand(4, 1), dynamics_ratio=torch.rand(4),
        ...                    next=TensorDict(observation=torch.randn(4, 3), reward=torch.randn(4, 1), **step),
        ...                    batch_size=4)
        >>> loss(batch)["loss_qvalue"].backward()
    """

    loss: LossModule

    def __init__(
        self,
        loss: LossModule,
        key: NestedKey = "dynamics_ratio",
        *,
        terms: Sequence[str] | None = None,
        reduction: str = "mean",
    ) -> None:
        super().__init__(loss, reduction=reduction)
        if getattr(loss, "reduction", None) != "none":
            raise ValueError(
                f"{type(loss).__name__} reduces its terms ({getattr(loss, 'reduction', None)!r}) before they could be "
                "weighted: build it with reduction='none'."
            )
        self.key = key
        there = self._written_keys()
        if not there:
            raise ValueError(f"{type(loss).__name__} has no term named 'loss...' to weigh, but only {loss.out_keys}.")
        self.terms = tuple(there if terms is None else terms)
        if unknown := set(self.terms) - set(there):
            names = ", ".join(map(str, unknown))
            raise ValueError(f"{type(loss).__name__} has no {names} to weigh, but {', '.join(map(str, there))}")

    def _read_keys(self) -> Iterable[NestedKey]:
        return *self.loss.in_keys, self.key

    def _optional_keys(self) -> Iterable[NestedKey]:
        return (self.tensor_keys.real, self.tensor_keys.priority_weight)

    def _written_keys(self) -> Iterable[NestedKey]:
        return tuple(key for key in self.loss.out_keys if str(key).startswith("loss"))

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        weights, terms = self._weights(batch), self._terms_inside(batch, tensordict)
        one, scale = torch.ones_like(weights), self._scale_of_mean(batch, weights)
        weighted = {cast(str, key): weights if key in self.terms else one for key in self._written_keys()}
        return self._output({k: scale * self._reduced(k, terms[k], w, batch) for k, w in weighted.items()}, tensordict)

    def _reduced(self, name: NestedKey, term: Tensor, weights: Tensor, batch: TensorDictBase) -> Tensor:
        """Multiply a term by the weights ``[*B]`` and reduce it."""
        rows, ndim = weights.shape, weights.ndim
        if not ndim:
            return self._reduce_loss(term * weights, batch)
        # TorchRL stacks the networks of an ensemble in front of the batch, [N, *B]. Masks are expanded at the end.
        ensemble = term.ndim > ndim and term.shape[-ndim:] == rows
        first, last = tuple(range(ndim)), tuple(range(-ndim, 0))
        term = term.movedim(last, first) if ensemble else term
        if term.shape[:ndim] != rows:
            raise ValueError(
                f"{type(self.loss).__name__} writes {name!r} with the shape {list(term.shape)}, in which there is no "
                f"batch of the shape {list(rows)}."
            )
        reduced = self._reduce_loss(term * weights.reshape(*rows, *(1,) * (term.ndim - ndim)), batch)
        return reduced.movedim(first, last) if ensemble and self.reduction == "none" else reduced

    def _scale_of_mean(self, batch: TensorDictBase, weights: Tensor) -> Tensor | float:
        """One over the mean priority weight, by which TorchRL's losses divide their mean if they have one."""
        if self.reduction != "mean" or not hasattr(self.loss.tensor_keys, "priority_weight"):
            return 1.0
        priority = self.loss._maybe_get_priority_weight(batch)
        if priority is None:
            return 1.0
        key = self.tensor_keys.priority_weight
        return 1.0 / self._reduce_loss(one_per_row(priority, weights.shape, key, type(self).__name__), batch)

    def _weights(self, tensordict: TensorDictBase) -> Tensor:
        weights = tensordict.get(self.key, None)
        if weights is None:
            raise KeyError(
                f"the batch has no weights at {self.key!r}: call a DynamicsRatioEstimator on it first, or name "
                "their key."
            )
        require_rows(weights, type(self).__name__)
        if tensordict.ndim:
            weights = one_per_row(weights, tensordict.batch_size, self.key, type(self).__name__)
        elif weights.ndim > 1 and weights.shape[-1] == 1:  # called with tensors: the shape of the batch is not known
            weights = weights.squeeze(-1)
        real = tensordict.get(self.tensor_keys.real, None)
        if real is not None:
            real = require_boolean(real, self.tensor_keys.real, type(self).__name__)
            weights = torch.where(self._expand_loss_mask(real, weights), 1.0, weights)
        return weights.detach()
