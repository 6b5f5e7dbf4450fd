"""H2O's conservative term, Eq. (1): lower Q where the simulator is wrong, raise it on the real data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_h2o.objectives.hybrid_loss import Rows
from torchrl_h2o.objectives.loss_wrapper import LossWrapper
from torchrl_h2o.objectives.ratio import DynamicsRatioEstimator


class DynamicsDivergence(TensorDictModuleBase):
    r"""Estimate the simulator's error at (s, a), :math:`D_{KL}(\hat P\|P)`, from noisy next states.

    .. math::
        u(s,a)=\tfrac 1N\sum_i\log\frac{\hat P(s'_i|s,a)}{P(s'_i|s,a)},\qquad s'_i\sim\mathcal N(s',\sigma^2)

    :class:`ConservativeLoss` normalises u over the simulated rows of a batch. The result is ω of Eq. (1).

    Args:
        estimator (DynamicsRatioEstimator): trained by a :class:`DynamicsRatioLoss`.
        noise (Tensor or float): σ, in the observation's units, ``[observation_dim]`` or one number. For example the
            standard deviation of the real data's observations. The authors' σ is smaller: their code also counts the
            zeros in the part of the buffer reserved for simulated data, which is still empty at that moment.
        num_samples (int, optional): N. Defaults to 10, as in the authors' code.

    Keyword Args:
        clamp (tuple of float, optional): bounds of the estimate. Defaults to ``(1e-45, 10.0)``, as in the authors'
            code.
        out_keys (sequence of NestedKey, optional): key of the estimate, ``[*B]``, a constant. Defaults to
            ``["dynamics_divergence"]``.

    Raises:
        ValueError: if ``num_samples`` is below 1, or the lower bound is not positive (the loss takes its logarithm).

    Source:
        H2O (Niu et al., 2022, https://arxiv.org/abs/2206.13464), as restated in H2O+ (Niu et al., 2023,
        https://arxiv.org/abs/2309.12716) below Eq. (1). Constants of the authors' code.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.objectives import make_dynamics_ratio_estimator
        >>> divergence = DynamicsDivergence(make_dynamics_ratio_estimator(observation_dim=3, action_dim=1), noise=1.0)
        >>> batch = TensorDict(observation=torch.randn(5, 3), action=torch.randn(5, 1),
        ...                    next=TensorDict(observation=torch.randn(5, 3)), batch_size=5)
        >>> divergence(batch)["dynamics_divergence"].shape
        torch.Size([5])
    """

    # TorchRL annotates these as lists of flat keys.
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]
    noise: Tensor

    def __init__(
        self,
        estimator: DynamicsRatioEstimator,
        noise: Tensor | float,
        num_samples: int = 10,
        *,
        clamp: tuple[float, float] = (1e-45, 10.0),
        out_keys: Iterable[NestedKey] = ("dynamics_divergence",),
    ) -> None:
        if num_samples < 1:
            raise ValueError(f"num_samples is {num_samples}: a mean needs at least one next state.")
        if not 0 < clamp[0] < clamp[1]:
            raise ValueError(f"clamp must be (low, high) with 0 < low < high, not {clamp}.")
        super().__init__()
        self.estimator = estimator
        self.register_buffer("noise", torch.as_tensor(noise))
        self.num_samples = num_samples
        self.clamp = clamp
        self.in_keys = list(estimator.in_keys)
        self.out_keys = list(out_keys)
        self._next_keys = list(estimator.next_keys)

    @dispatch()
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        inputs = tensordict.select(*self.in_keys)
        samples = inputs.expand(self.num_samples, *inputs.batch_size).copy()
        for key in self._next_keys:
            value = samples.get(key)
            samples.set(key, value + self.noise.to(value) * torch.randn_like(value))
        log_ratio = self.estimator(samples).get(self.estimator.out_keys[0])
        return tensordict.set(self.out_keys[0], (-log_ratio.mean(0)).clamp(*self.clamp))


class ConservativeLoss(LossWrapper):
    r"""Add H2O's conservative term to any loss with a Q network.

    .. math::
        \alpha_c\Big(\log\sum_{s,a\sim B}\omega(s,a)e^{Q(s,a)}-E_{𝒟}[Q(s,a)]\Big)

    ω is the batch's ``dynamics_divergence``, written by :class:`DynamicsDivergence` and normalised over the simulated
    rows. The term, ``loss_conservative``, is summed over the ensemble and trains only Q. The method H2O adds this term
    to SAC on both streams, with the Bellman error weighted by the dynamics ratio; the example builds it.

    Args:
        loss (LossModule): a loss with a ``qvalue_network``, such as TorchRL's SAC, TD3 and IQL losses or a loss of
            this package.
        alpha_c (float, optional): weight of the term, at least 0. Defaults to 0.01, as in the authors' code.

    Raises:
        ValueError: if ``loss`` has no ``qvalue_network`` or a reduction other than "mean", or if α_c is negative.

    Reads the inputs of ``loss``, ``real`` ``[*B]`` and, if present, ``dynamics_divergence`` ``[*B]`` (default: equal
    weights). A stream without rows contributes zero.

    Source:
        H2O (Niu et al., 2022, https://arxiv.org/abs/2206.13464), as restated in H2O+ (Niu et al., 2023,
        https://arxiv.org/abs/2309.12716), Eq. (1).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_h2o.objectives import (DynamicsDivergence, H2OPlusLoss, MixedBellmanLoss,
        ...     make_actor, make_dynamics_ratio_estimator, make_qvalue)
        >>> actor, estimator = make_actor(3, Bounded(-1, 1, (1,))), make_dynamics_ratio_estimator(3, 1)
        >>> divergence = DynamicsDivergence(estimator, noise=1.0)
        >>> sac = H2OPlusLoss(MixedBellmanLoss(actor, [make_qvalue(3, 1), make_qvalue(3, 1)], mixing=0.0))
        >>> loss = ConservativeLoss(sac)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> batch = TensorDict(observation=torch.randn(8, 3), action=torch.rand(8, 1), real=torch.arange(8) < 4,
        ...                    next=TensorDict(observation=torch.randn(8, 3), reward=torch.randn(8, 1),
        ...                                    terminated=torch.zeros(8, 1, dtype=torch.bool)), batch_size=8)
        >>> losses = loss(divergence(estimator(batch)))  # the batch now has the ratio and ω
        >>> sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
    """

    @dataclass
    class _AcceptedKeys(LossWrapper._AcceptedKeys):
        """Keys that ``set_keys`` renames, in addition to those of the loss inside.

        Attributes:
            dynamics_divergence: ω before it is normalised. Defaults to ``"dynamics_divergence"``.
        """

        dynamics_divergence: NestedKey = "dynamics_divergence"

    tensor_keys: _AcceptedKeys
    loss: LossModule

    def __init__(self, loss: LossModule, alpha_c: float = 0.01) -> None:
        if not hasattr(loss, "qvalue_network"):
            raise ValueError(f"{type(loss).__name__} has no qvalue_network that a conservative term could lower.")
        if getattr(loss, "reduction", "mean") != "mean":
            raise ValueError(
                f"{type(loss).__name__} has reduction={loss.reduction!r}; the conservative term is one number per "
                "batch: build it with reduction='mean'."
            )
        if alpha_c < 0:
            raise ValueError(f"alpha_c is {alpha_c}: a negative weight would raise Q where the simulator is wrong.")
        super().__init__(loss)
        self.alpha_c = alpha_c

    @property
    def qvalue_network(self) -> Any:
        return self.loss.qvalue_network

    def _read_keys(self) -> Iterable[NestedKey]:
        return *self.loss.in_keys, self.tensor_keys.real

    def _optional_keys(self) -> Iterable[NestedKey]:
        inside: Any = self.loss
        optional = inside._optional_keys() if hasattr(inside, "_optional_keys") else ()
        return *optional, *super()._optional_keys(), self.tensor_keys.dynamics_divergence

    def _written_keys(self) -> Iterable[NestedKey]:
        return *self.loss.out_keys, "loss_conservative"

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        term = self.conservative_loss(batch, self._rows(batch))
        return self._output({**self._terms_inside(batch, tensordict), "loss_conservative": term}, tensordict)

    def conservative_loss(self, tensordict: TensorDictBase, rows: Rows) -> Tensor:
        """Compute the first bracket of Eq. (1), times α_c, ``[]``."""
        inside: Any = self.loss  # has a Q network, as the constructor checks
        qvalues = self._call("qvalue_network", tensordict).get(inside.tensor_keys.state_action_value).squeeze(-1)
        rows = rows.like(qvalues[0])
        of_sim = self._soft_maximum(qvalues, tensordict, rows).sum()
        return self.alpha_c * (of_sim - self._expectation(qvalues.sum(0), rows, "real"))  # Eq. (1)

    def _soft_maximum(self, qvalues: Tensor, tensordict: TensorDictBase, rows: Rows) -> Tensor:
        """log Σ ω e^Q over the simulated rows, ``[num_qvalue_nets]``; zero without such rows."""
        sim = rows.sim
        lowest = torch.finfo(qvalues.dtype).min  # with -inf, a batch without simulated rows would give NaN (-inf + inf)
        divergence = tensordict.get(self.tensor_keys.dynamics_divergence, None)
        logits = torch.zeros_like(qvalues[0])
        if divergence is not None:
            logits = self._one_per_row(divergence.detach(), sim, self.tensor_keys.dynamics_divergence).log()
        if rows.priority is not None:
            logits = logits + rows.priority.log()
        logits = torch.where(sim, logits, lowest).flatten()
        log_omega = logits - logits.logsumexp(0)
        terms = torch.where(sim.flatten(), qvalues.flatten(1) + log_omega, lowest)
        return torch.where(sim.any(), terms.logsumexp(-1), 0.0)
