"""Eq. (7) as TorchRL's TD(0) estimator, and its discount from the arguments of ``make_value_estimator``."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import TD0Estimator, ValueEstimatorBase

ValueType = ValueEstimators | ValueEstimatorBase | type[ValueEstimatorBase] | None


class MixedTD0Estimator(TD0Estimator):
    """TD(0) estimate whose next value is the mixture of Eq. (7), :math:`λV(s')+(1-λ)E[\\hat Q(s',a')-β\\log π(a'|s')]`.

    Args:
        gamma (Tensor): γ, ``[]``.
        next_value (callable): computes the mixture, ``[*B]``, in the next states of a batch.
    """

    def __init__(self, gamma: Tensor, next_value: Callable[[TensorDictBase], Tensor]) -> None:
        # TorchRL accepts None, although it annotates a module.
        super().__init__(gamma=float(gamma), value_network=cast(TensorDictModule, None))
        self.gamma = gamma
        self._mixture = next_value

    @torch.no_grad()
    def value_estimate(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None = None,
        next_value: Tensor | None = None,
        **kwargs,
    ) -> Tensor:
        """Compute the target of Q(s, a), ``[*B, 1]``, as a constant."""
        if next_value is None:
            next_value = self._mixture(tensordict).unsqueeze(-1)
        return super().value_estimate(tensordict, target_params, next_value, **kwargs)


def one_step_discount(value_type: ValueType, hyperparams: dict, default: float) -> float:
    """Return γ of a TD(0) estimator.

    Args:
        value_type: a ``ValueEstimators`` member, an estimator's class or instance, or None for TD(0).
        hyperparams: ``gamma``; if ``value_type`` is a class, the arguments of its constructor.
        default: γ if ``hyperparams`` has none.

    Raises:
        NotImplementedError: if the estimator is not TD(0), because Eq. (7) defines a one-step target only.
        ValueError: if a TD(0) estimator changes the rewards.
        TypeError: for a hyperparameter that TD(0) does not have.
    """
    if isinstance(value_type, type) and issubclass(value_type, TD0Estimator):
        value_type = value_type(**{"gamma": default, "value_network": None, **hyperparams})
    known = (TD0Estimator.value_estimate, MixedTD0Estimator.value_estimate)
    if isinstance(value_type, TD0Estimator) and type(value_type).value_estimate in known:
        if value_type.average_rewards:
            raise ValueError(
                "average_rewards=True standardises rewards batch by batch, which Eq. (7) does not: normalise the "
                "rewards where they are stored, and pass average_rewards=False."
            )
        return float(value_type.gamma)
    if value_type not in (None, ValueEstimators.TD0):
        name = getattr(value_type, "__name__", None) or (
            type(value_type).__name__ if isinstance(value_type, ValueEstimatorBase) else value_type
        )
        raise NotImplementedError(
            f"Eq. (7) is a one-step target that mixes V(s') and Q(s', a'), so {name} does not apply: call "
            "make_value_estimator(gamma=...). For n-step returns put MultiStepTransform into the replay buffer; the "
            "loss reads its steps_to_next_obs."
        )
    hyperparams = {key: value for key, value in hyperparams.items() if key != "device"}
    gamma = float(hyperparams.pop("gamma", default))
    if hyperparams:
        raise TypeError(f"TD0 takes gamma only, not {sorted(hyperparams)}.")
    return gamma
