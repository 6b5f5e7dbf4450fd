"""In-sample state-value losses, Eq. (4): regress V(s) on Q(s, a) at the actions in the data.

The three backbones differ in their ``penalty``, a function of the advantage y = Q(s, a) - V(s).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor

from torchrl_h2o.objectives.batch_checks import network_inputs, separated
from torchrl_h2o.objectives.hybrid_loss import HybridLoss, Rows


class InSampleValueLoss(HybridLoss):
    r"""Base class of the in-sample value loss :math:`\min_V E_{(s,a)\sim 𝒟}\,L^f_V(Q(s,a)-V(s))`.

    To add a backbone, derive a class and define :meth:`penalty`, the function :math:`L^f_V`.

    Args:
        value_network (TensorDictModule): V(s); writes ``"state_value"``, ``[*B, 1]``.

    Keyword Args:
        reduction (str, optional): ``"none"`` | ``"mean"`` | ``"sum"``. Defaults to ``"mean"``, the mean over the
            real rows. Simulated rows have no effect.

    Reads the network's inputs, ``state_action_value`` ``[*B]`` or ``[*B, 1]`` (target Q at the action in the data, used
    as a constant), ``real`` ``[*B]`` and, if present, ``priority_weight`` ``[*B]``. Returns ``loss_value``.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eq. (4), after SQL and EQL (Xu et al., 2023, https://arxiv.org/abs/2303.15810).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl_h2o.objectives import InSampleValueLoss
        >>> class HuberValueLoss(InSampleValueLoss):
        ...     def penalty(self, advantage):
        ...         return torch.nn.functional.huber_loss(advantage, torch.zeros_like(advantage), reduction="none")
        >>> loss = HuberValueLoss(ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"]))
        >>> batch = TensorDict(observation=torch.randn(4, 3), state_action_value=torch.randn(4, 1),
        ...                    real=torch.tensor([True, True, False, False]), batch_size=4)
        >>> loss(batch)["loss_value"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys(HybridLoss._AcceptedKeys):
        """Keys that ``set_keys`` renames.

        Attributes:
            value: V(s). Defaults to ``"state_value"``.
            state_action_value: target Q at the action in the data. Defaults to ``"state_action_value"``.
        """

        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"

    tensor_keys: _AcceptedKeys
    _checked_network = "value_network"
    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(self, value_network: TensorDictModule, *, reduction: str = "mean") -> None:
        super().__init__(reduction=reduction)
        self._network_inputs = separated(network_inputs(value_network))
        self.convert_to_functional(value_network, "value_network", create_target_params=False)

    @abstractmethod
    def penalty(self, advantage: Tensor) -> Tensor:
        """Compute :math:`L^f_V(y)` of the advantage y, elementwise: ``[*B]`` to ``[*B]``."""

    def _read_keys(self) -> Iterable[NestedKey]:
        return (
            *self.value_network.in_keys,
            self.tensor_keys.state_action_value,
            self.tensor_keys.real,
        )

    def _written_keys(self) -> Iterable[NestedKey]:
        return ("loss_value",)

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        return self._output({"loss_value": self.value_loss(batch, self._rows(batch))}, tensordict)

    def value_loss(self, tensordict: TensorDictBase, rows: Rows) -> Tensor:
        """Compute the reduced loss of Eq. (4)."""
        out = self._call("value_network", tensordict)
        value = self._entry(out, self.tensor_keys.value).squeeze(-1)
        qvalue = self._entry(tensordict, self.tensor_keys.state_action_value).detach()
        qvalue = self._one_per_row(qvalue, value, self.tensor_keys.state_action_value)
        return self._expectation(self.penalty(qvalue - value), rows, "real")  # Eq. (4)


class ExpectileValueLoss(InSampleValueLoss):
    r"""IQL's expectile loss :math:`|\tau-1(y<0)|\,y^2`.

    Args:
        value_network (TensorDictModule): V(s); writes ``"state_value"``, ``[*B, 1]``.
        expectile (float, optional): :math:`\tau` in (0, 1). With 0.5, V is the mean of Q over the actions in the data;
            values near 1 approach the maximum. Defaults to 0.7, as in IQL. The authors' code uses 0.5, and 0.9 in its
            script for the wheel-legged robot.

    Keyword Args:
        reduction (str, optional): see :class:`InSampleValueLoss`.

    Raises:
        ValueError: if ``expectile`` is not inside (0, 1).

    Source:
        H2O+ (Niu et al., 2023), Eq. (4) and its table; IQL (Kostrikov et al., 2021,
        https://arxiv.org/abs/2110.06169), Eq. (5).

    Examples:
        >>> import torch
        >>> from torchrl.modules import ValueOperator
        >>> loss = ExpectileValueLoss(ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"]), expectile=0.9)
        >>> loss.penalty(torch.tensor([-1.0, 0.0, 2.0]))
        tensor([0.1000, 0.0000, 3.6000])
    """

    def __init__(self, value_network: TensorDictModule, expectile: float = 0.7, *, reduction: str = "mean") -> None:
        if not 0 < expectile < 1:
            raise ValueError(f"expectile must lie inside (0, 1), not {expectile}; 0.5 is the mean.")
        super().__init__(value_network, reduction=reduction)
        self.expectile = expectile

    def penalty(self, advantage: Tensor) -> Tensor:
        return (self.expectile - (advantage < 0).to(advantage.dtype)).abs() * advantage**2


class SparseValueLoss(InSampleValueLoss):
    r"""SQL's loss :math:`1(1+y/2\alpha>0)\,(1+y/2\alpha)^2-y/\alpha`.

    Args:
        value_network (TensorDictModule): V(s); writes ``"state_value"``, ``[*B, 1]``.
        alpha (float, optional): temperature, in units of the return. With small values V approaches the maximum of Q
            over the actions in the data, with large values the mean. Defaults to 1.0.

    Keyword Args:
        reduction (str, optional): see :class:`InSampleValueLoss`.

    Raises:
        ValueError: if ``alpha`` is not positive.

    Source:
        H2O+ (Niu et al., 2023), Eq. (4) and its table, f = x - 1; SQL (Xu et al., 2023, https://arxiv.org/abs/2303.15810).

    Examples:
        >>> import torch
        >>> from torchrl.modules import ValueOperator
        >>> loss = SparseValueLoss(ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"]), alpha=1.0)
        >>> loss.penalty(torch.tensor([-4.0, 0.0, 2.0]))
        tensor([4., 1., 2.])
    """

    def __init__(self, value_network: TensorDictModule, alpha: float = 1.0, *, reduction: str = "mean") -> None:
        _check_alpha(alpha)
        super().__init__(value_network, reduction=reduction)
        self.alpha = alpha

    def penalty(self, advantage: Tensor) -> Tensor:
        return (1 + advantage / (2 * self.alpha)).clamp_min(0) ** 2 - advantage / self.alpha


class ExponentialValueLoss(InSampleValueLoss):
    r"""EQL's and XQL's loss :math:`\exp(y/\alpha)-y/\alpha`, finite for any advantage.

    For :math:`y/\alpha` above ``clip``, the exponential is replaced by its tangent at ``clip``: value and gradient stay
    finite and keep their sign, so an outlier still raises V. Below ``clip``, value and gradient are exact.

    Args:
        value_network (TensorDictModule): V(s); writes ``"state_value"``, ``[*B, 1]``.
        alpha (float, optional): temperature, in units of the return. With small values V approaches the maximum of Q
            over the actions in the data, with large values the mean. Defaults to 1.0.
        clip (float, optional): value of :math:`y/\alpha` above which the tangent is used. Defaults to 7.0, as in XQL.

    Keyword Args:
        reduction (str, optional): see :class:`InSampleValueLoss`.

    Raises:
        ValueError: if ``alpha`` is not positive, or ``clip`` is outside (0, 20].

    Source:
        H2O+ (Niu et al., 2023), Eq. (4) and its table, f = log x; EQL (Xu et al., 2023,
        https://arxiv.org/abs/2303.15810); XQL (Garg et al., 2023, https://arxiv.org/abs/2301.02328).

    Examples:
        >>> import torch
        >>> from torchrl.modules import ValueOperator
        >>> loss = ExponentialValueLoss(ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"]), alpha=2.0)
        >>> loss.penalty(torch.tensor([-4.0, 0.0, 2.0]))
        tensor([2.1353, 1.0000, 1.7183])
        >>> loss.penalty(torch.tensor([1e38, float("inf")])).isfinite()
        tensor([True, True])
    """

    # Bound of |y / alpha|, beyond which the loss is constant, so that the sum over a batch stays in float32's range.
    _BOUND = 1e25

    def __init__(
        self,
        value_network: TensorDictModule,
        alpha: float = 1.0,
        clip: float = 7.0,
        *,
        reduction: str = "mean",
    ) -> None:
        _check_alpha(alpha)
        if not 0 < clip <= 20:
            raise ValueError(
                f"clip must lie in (0, 20], not {clip}: beyond exp(20) the sum over a batch may overflow float32."
            )
        super().__init__(value_network, reduction=reduction)
        self.alpha = alpha
        self.clip = clip

    def penalty(self, advantage: Tensor) -> Tensor:
        y = (advantage / self.alpha).clamp(-self._BOUND, self._BOUND)
        exact = y.clamp_max(self.clip)
        return torch.exp(exact) * (1 + (y - exact)) - y


def _check_alpha(alpha: float) -> None:
    if not alpha > 0:
        raise ValueError(f"alpha must be positive, not {alpha}; it divides the advantage.")
