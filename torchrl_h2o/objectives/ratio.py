"""Dynamics ratio P(s'|s,a) / P̂(s'|s,a) from two discriminators, Eq. (9), and the loss that trains them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.nn import functional as F

from torchrl_h2o.objectives.hybrid_loss import HybridLoss, Rows
from torchrl_h2o.objectives.network_calls import NetworkCalls


class DynamicsRatioEstimator(TensorDictModuleBase):
    r"""Dynamics ratio of a transition, real over simulated, from two classifiers of real and simulated data.

    .. math::
        \frac{P}{\hat P}=\frac{p(real|s,a,s')}{1-p(real|s,a,s')}\Big/\frac{p(real|s,a)}{1-p(real|s,a)}

    Reads a transition and writes two entries, so it can also be the transform of a replay buffer. Both entries are
    constants without gradients; :class:`DynamicsRatioLoss` trains the networks.

    Args:
        sa_network (TensorDictModule): reads observation and action, writes logits ``[*B, 2]``, (real, simulated).
        sas_network (TensorDictModule): the same, and reads ``("next", "observation")`` too.

    Keyword Args:
        logit_bound (float or None, optional): replaces each logit by ``bound * tanh(logit)``, so that the log-ratio
            with ``residual`` lies within ``[-2 * bound, 2 * bound]``. ``None`` sets no bound. Defaults to 2.0.
        residual (bool, optional): whether the first network's logits are added to the second's, so that the second
            learns only the contribution of s'. Defaults to ``True``.
        detach_residual (bool, optional): whether the added logits are constants, so that each network is trained by
            its own loss. ``False`` reproduces the authors' code, where the second loss also trains the first network.
            Defaults to ``True``, because gradients of the second loss bias the p(real|s,a) that Eq. (9) needs.
        clamp (tuple of float or None, optional): bounds of ``dynamics_ratio``; ``log_dynamics_ratio`` is not clamped.
            ``None`` sets no bounds. Defaults to ``(1e-5, 1.0)``.
        out_keys (sequence of NestedKey, optional): keys of the two entries, ``[*B]`` each. Defaults to
            ``["log_dynamics_ratio", "dynamics_ratio"]``.

    Raises:
        ValueError: if the bound is not positive, or the clamp is not an interval of non-negative numbers.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eq. (9). Defaults other than ``detach_residual`` are
        those of the authors' published code.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import MLP
        >>> sa = TensorDictModule(MLP(4, 2), in_keys=["observation", "action"], out_keys=["sa_logits"])
        >>> sas = TensorDictModule(MLP(7, 2), out_keys=["sas_logits"],
        ...                        in_keys=["observation", "action", ("next", "observation")])
        >>> estimator = DynamicsRatioEstimator(sa, sas)
        >>> batch = TensorDict(observation=torch.randn(5, 3), action=torch.randn(5, 1),
        ...                    next=TensorDict(observation=torch.randn(5, 3)), batch_size=5)
        >>> estimator(batch)["dynamics_ratio"].shape
        torch.Size([5])
    """

    # TorchRL annotates these as lists of flat keys.
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(
        self,
        sa_network: TensorDictModule,
        sas_network: TensorDictModule,
        *,
        logit_bound: float | None = 2.0,
        residual: bool = True,
        detach_residual: bool = True,
        clamp: tuple[float, float] | None = (1e-5, 1.0),
        out_keys: Sequence[NestedKey] = ("log_dynamics_ratio", "dynamics_ratio"),
    ) -> None:
        if logit_bound is not None and not logit_bound > 0:
            raise ValueError(f"logit_bound must be positive or None (no bound), not {logit_bound}.")
        if clamp is not None and not 0 <= clamp[0] < clamp[1]:
            raise ValueError(f"clamp must be (low, high) with 0 <= low < high, or None, not {clamp}.")
        super().__init__()
        self.sa_network = sa_network
        self.sas_network = sas_network
        self.logit_bound = logit_bound
        self.residual = residual
        self.detach_residual = detach_residual
        self.clamp = clamp
        self.in_keys = list(dict.fromkeys((*sa_network.in_keys, *sas_network.in_keys)))
        self.out_keys = list(out_keys)

    def log_odds(
        self, tensordict: TensorDictBase, params: TensorDictBase | None = None, calls: NetworkCalls | None = None
    ) -> tuple[Tensor, Tensor]:
        """Compute the log-odds of real against simulated.

        Args:
            tensordict (TensorDictBase): transitions, ``[*B]``.
            params (TensorDictBase, optional): used instead of this module's parameters.
            calls (NetworkCalls, optional): runs the networks with ``params``. Defaults to TorchRL's method.

        Returns:
            The log-odds given (s, a) and given (s, a, s'), ``[*B]`` each. With ``residual`` the second includes the
            first.
        """
        calls = NetworkCalls() if calls is None else calls
        sa, sas = (self._network_log_odds(name, tensordict, params, calls) for name in ("sa_network", "sas_network"))
        if not self.residual:
            return sa, sas
        return sa, sas + (sa.detach() if self.detach_residual else sa)

    def _network_log_odds(
        self, name: str, tensordict: TensorDictBase, params: TensorDictBase | None, calls: NetworkCalls
    ) -> Tensor:
        network = getattr(self, name)
        if params is None:
            out = network(tensordict.select(*network.in_keys))
        else:
            out = calls.outputs(network, tensordict, params.get(name))
        logits = out.get(network.out_keys[0])
        if logits.shape[-1] != 2:
            raise ValueError(f"a discriminator must write two logits (real, simulated), not {logits.shape[-1]}.")
        if self.logit_bound is not None:
            logits = self.logit_bound * torch.tanh(logits)
        real, sim = logits.unbind(-1)
        return real - sim

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        log_ratio, ratio = self.ratio(tensordict)
        log_key, key = self.out_keys
        return tensordict.set(log_key, log_ratio).set(key, ratio)

    @torch.no_grad()
    def ratio(
        self, tensordict: TensorDictBase, params: TensorDictBase | None = None, calls: NetworkCalls | None = None
    ) -> tuple[Tensor, Tensor]:
        """Compute Eq. (9), with the arguments of :meth:`log_odds`.

        Returns:
            The log ratio and the clamped ratio, constants, ``[*B]`` each.
        """
        sa, sas = self.log_odds(tensordict, params, calls)
        log_ratio = sas - sa  # Eq. (9)
        ratio = log_ratio.exp()
        return log_ratio, ratio if self.clamp is None else ratio.clamp(*self.clamp)


class DynamicsRatioLoss(HybridLoss):
    """Cross-entropy of the two discriminators, with equal weight on both streams.

    In training mode, Gaussian noise is added to all inputs; after ``loss.eval()``, none is added. In evaluation mode,
    ``accuracy`` on a held-out batch therefore measures how well the discriminator detects the dynamics gap (0.5 is
    chance).

    By default each network is trained by its own loss, unlike in the authors' code; see ``detach_residual`` of
    :class:`DynamicsRatioEstimator`.

    Args:
        estimator (DynamicsRatioEstimator): holds the two networks.

    Keyword Args:
        input_noise (float or None, optional): standard deviation of the noise, in the unit of each input. 0 or
            ``None`` adds no noise. Defaults to 0.1.
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.HybridLoss`.

    Reads the estimator's inputs, ``real`` ``[*B]`` and, if present, ``priority_weight`` ``[*B]``. Returns
    ``loss_ratio_sa``, ``loss_ratio_sas``, and the accuracies of the two classifiers: ``accuracy_sa`` of the one that
    reads (s, a), ``accuracy`` of the one that reads (s, a, s'). Each is the mean of the two streams' accuracies.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eq. (9), after DARC (Eysenbach et al., 2020, https://arxiv.org/abs/2006.13916).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.objectives import make_dynamics_ratio_estimator
        >>> loss = DynamicsRatioLoss(make_dynamics_ratio_estimator(observation_dim=3, action_dim=1))
        >>> batch = TensorDict(observation=torch.randn(6, 3), action=torch.randn(6, 1), real=torch.arange(6) < 2,
        ...                    next=TensorDict(observation=torch.randn(6, 3)), batch_size=6)
        >>> losses = loss(batch)
        >>> (losses["loss_ratio_sa"] + losses["loss_ratio_sas"]).backward()
    """

    estimator: DynamicsRatioEstimator
    estimator_params: TensorDictParams
    target_estimator_params: TensorDictParams

    def __init__(
        self,
        estimator: DynamicsRatioEstimator,
        *,
        input_noise: float | None = 0.1,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction=reduction)
        if input_noise is not None and input_noise < 0:
            raise ValueError(f"input_noise is a standard deviation and cannot be {input_noise}; None is no noise.")
        # TorchRL accepts any compatible module, although it annotates a TensorDictModule.
        self.convert_to_functional(cast(TensorDictModule, estimator), "estimator", create_target_params=False)
        self.input_noise = input_noise

    def _read_keys(self) -> Iterable[NestedKey]:
        return *self.estimator.in_keys, self.tensor_keys.real

    def _written_keys(self) -> Iterable[NestedKey]:
        return "loss_ratio_sa", "loss_ratio_sas", "accuracy_sa", "accuracy"

    def dynamics_ratio(self, tensordict: TensorDictBase) -> Tensor:
        """Compute Eq. (9) with this loss's current parameters, as a constant, ``[*B]``."""
        return self.estimator.ratio(tensordict, self.estimator_params, self.calls)[1]

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        inputs, rows = tensordict.select(*self.estimator.in_keys), self._rows(tensordict)
        if self.training and self.input_noise:
            inputs = inputs.apply(self._noisy)
        sa, sas = self.estimator.log_odds(inputs, self.estimator_params, self.calls)
        return self._output(
            {
                "loss_ratio_sa": self._cross_entropy(sa, rows),
                "loss_ratio_sas": self._cross_entropy(sas, rows),
                "accuracy_sa": self._accuracy(sa, rows),
                "accuracy": self._accuracy(sas, rows),
            },
            tensordict,
        )

    def _noisy(self, x: Tensor) -> Tensor:
        # The same numbers as torch.randn_like. Compiled populations replace normal_ to supply recorded numbers.
        return x + cast(float, self.input_noise) * torch.empty_like(x).normal_()

    def _cross_entropy(self, log_odds: Tensor, rows: Rows) -> Tensor:
        terms = F.softplus(torch.where(rows.real, -log_odds, log_odds))  # -log p(own stream)
        return self._expectation(terms, rows)

    def _accuracy(self, log_odds: Tensor, rows: Rows) -> Tensor:
        hits = ((log_odds > 0) == rows.real).to(log_odds.dtype)
        return self._metric(hits, rows)
