"""Dynamics ratio P(s'|s,a) / P̂(s'|s,a) from two discriminators, Eq. (9), and the loss that trains them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.nn import functional as F

from torchrl_h2o.objectives.batch_checks import entry, network_inputs, separated
from torchrl_h2o.objectives.hybrid_loss import HybridLoss, Rows

Bound = float | None


class DynamicsRatioEstimator(TensorDictModuleBase):
    r"""Dynamics ratio of a transition, real over simulated, from two classifiers of real and simulated data.

    .. math::
        \frac{P}{\hat P}=\frac{p(real|s,a,s')}{1-p(real|s,a,s')}\Big/\frac{p(real|s,a)}{1-p(real|s,a)}

    Reads a transition and writes two entries, so it can also be the transform of a replay buffer. Both entries are
    constants without gradients; :class:`DynamicsRatioLoss` trains the networks.

    Without ``sa_network`` the log-odds of the one classifier on (s, a, s') are the log-ratio. This is the dynamics
    ratio if the classifier is trained on real and simulated transitions with the same (s, a), because then
    p(real|s, a) is 1/2; see :class:`~torchrl_h2o.data.PairedTransitions`.

    Args:
        sa_network (TensorDictModule or None): reads observation and action, writes logits ``[*B, 2]``, (real,
            simulated), as its last entry.
        sas_network (TensorDictModule): the same, and reads the next observation too.

    Keyword Args:
        logit_bound (float, None or a pair of these, optional): replaces each logit by ``bound * tanh(logit)``, so that
            the log-ratio with ``residual`` lies within ``[-2 * bound, 2 * bound]``. ``None`` sets no bound. A pair
            gives the bounds of ``sa_network`` and ``sas_network``. Defaults to 2.0.
        residual (bool, optional): whether the first network's logits are added to the second's, so that the second
            learns only the contribution of s'. Defaults to ``True``.
        detach_residual (bool, optional): whether the added logits are constants, so that each network is trained by
            its own loss. ``False`` reproduces the authors' code, where the second loss also trains the first network.
            Defaults to ``True``, because gradients of the second loss bias the p(real|s,a) that Eq. (9) needs.
        clamp (tuple of float or None, optional): bounds of ``dynamics_ratio``; ``log_dynamics_ratio`` is not clamped.
            ``None`` sets no bounds. Defaults to ``(1e-5, 1.0)``.
        change_scale (Tensor, optional): ``[observation_dim]``. If given, ``sas_network`` receives the normalised change
            of the observation, ``(s' - s) / change_scale``, instead of s'; for example the standard deviation of the
            change, :func:`fit_change_scale`. By default it receives s'.
        observation (NestedKey, optional): entry that holds s, for the change. Defaults to ``"observation"``.
        next_observation (NestedKey, optional): entry that holds s'. Defaults to ``("next", "observation")``.
        out_keys (sequence of NestedKey, optional): keys of the two entries, ``[*B]`` each. Defaults to
            ``["log_dynamics_ratio", "dynamics_ratio"]``.

    Raises:
        ValueError: if a bound or a scale is not positive, the clamp is not an interval of non-negative numbers, or
            ``sas_network`` does not read the next observation.

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
    change_scale: Tensor | None

    def __init__(
        self,
        sa_network: TensorDictModule | None,
        sas_network: TensorDictModule,
        *,
        logit_bound: Bound | tuple[Bound, Bound] = 2.0,
        residual: bool = True,
        detach_residual: bool = True,
        clamp: tuple[float, float] | None = (1e-5, 1.0),
        change_scale: Tensor | None = None,
        observation: NestedKey = "observation",
        next_observation: NestedKey = ("next", "observation"),
        out_keys: Sequence[NestedKey] = ("log_dynamics_ratio", "dynamics_ratio"),
    ) -> None:
        bounds = tuple(logit_bound) if isinstance(logit_bound, Sequence) else (logit_bound, logit_bound)
        if len(bounds) != 2 or any(bound is not None and not bound > 0 for bound in bounds):
            raise ValueError(f"logit_bound must be positive or None (no bound), or a pair of these, not {logit_bound}.")
        if clamp is not None and not 0 <= clamp[0] < clamp[1]:
            raise ValueError(f"clamp must be (low, high) with 0 <= low < high, or None, not {clamp}.")
        if change_scale is not None and not bool((change_scale > 0).all()):
            raise ValueError(f"change_scale must be positive in every dimension, not {change_scale}.")
        super().__init__()
        self.sa_network = sa_network
        self.sas_network = sas_network
        self.logit_bound = logit_bound
        self._bounds: dict[str, Bound] = {"sa_network": bounds[0], "sas_network": bounds[1]}
        self.residual = residual
        self.detach_residual = detach_residual
        self.clamp = clamp
        self.observation, self.next_observation = unravel_key(observation), unravel_key(next_observation)
        self.register_buffer("change_scale", change_scale)
        self.network_inputs = separated([*network_inputs(sa_network), *network_inputs(sas_network)])
        read_by_sa = [] if sa_network is None else sa_network.in_keys
        self.in_keys = list(dict.fromkeys((*read_by_sa, *sas_network.in_keys)))
        self.out_keys = list(out_keys)
        self.next_keys = [key for key in sas_network.in_keys if key not in read_by_sa]
        if sa_network is None:
            self.next_keys = [self.next_observation]
        if (sa_network is None or change_scale is not None) and self.next_observation not in sas_network.in_keys:
            raise ValueError(
                f"next_observation is {self.next_observation!r} and sas_network reads {sas_network.in_keys}: name the "
                "entry that holds s' in both."
            )

    def log_odds(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Compute the log-odds of real against simulated.

        Args:
            tensordict (TensorDictBase): transitions, ``[*B]``.

        Returns:
            The log-odds given (s, a) and given (s, a, s'), ``[*B]`` each. With ``residual`` the second includes the
            first. Without ``sa_network`` the first are zero.
        """
        with_change = tensordict
        if self.change_scale is not None:  # sas_network reads the normalised change of the observation instead of s'
            change = tensordict.get(self.next_observation) - tensordict.get(self.observation)
            with_change = tensordict.select(*self.in_keys).set(self.next_observation, change / self.change_scale)
        sas = self._network_log_odds("sas_network", with_change)
        if self.sa_network is None:
            return torch.zeros_like(sas), sas
        sa = self._network_log_odds("sa_network", tensordict)
        if not self.residual:
            return sa, sas
        return sa, sas + (sa.detach() if self.detach_residual else sa)

    def _network_log_odds(self, name: str, tensordict: TensorDictBase) -> Tensor:
        network, bound = getattr(self, name), self._bounds[name]
        logits = network(tensordict.select(*network.in_keys)).get(network.out_keys[-1])  # after those of an encoder
        if logits.shape[-1] != 2:
            raise ValueError(f"{name} must write two logits (real, simulated) last, not {logits.shape[-1]}.")
        if bound is not None:
            logits = bound * torch.tanh(logits)
        real, sim = logits.unbind(-1)
        return real - sim

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        name = "DynamicsRatioEstimator"
        for one in self.network_inputs:
            one.check([entry(tensordict, key, name) for key in one.keys], name, None)
        log_ratio, ratio = self.ratio(tensordict)
        log_key, key = self.out_keys
        return tensordict.set(log_key, log_ratio).set(key, ratio)

    @torch.no_grad()
    def ratio(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Compute Eq. (9) of transitions ``[*B]``.

        Returns:
            The log ratio and the clamped ratio, constants, ``[*B]`` each.
        """
        sa, sas = self.log_odds(tensordict)
        log_ratio = sas - sa  # Eq. (9)
        ratio = log_ratio.exp()
        return log_ratio, ratio if self.clamp is None else ratio.clamp(*self.clamp)


def fit_change_scale(
    transitions: TensorDictBase,
    observation: NestedKey = "observation",
    next_observation: NestedKey = ("next", "observation"),
) -> Tensor:
    """Measure the standard deviation of s' - s, the ``change_scale`` of :class:`DynamicsRatioEstimator`.

    Args:
        transitions (TensorDictBase): measured transitions, ``[T]``.
        observation (NestedKey, optional): entry that holds s.
        next_observation (NestedKey, optional): entry that holds s' of the next step, not of n steps later.

    Returns:
        Tensor: ``[observation_dim]``, in the unit of each observation; 1 for an entry that never changes.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> steps = TensorDict(observation=torch.zeros(2, 1), next=TensorDict(observation=torch.tensor([[1.0], [3.0]])))
        >>> fit_change_scale(steps.auto_batch_size_())
        tensor([1.4142])
    """
    change = cast(Tensor, transitions.get(next_observation)) - cast(Tensor, transitions.get(observation))
    scale = change.std(0)
    return torch.where(scale > 0, scale, 1.0)


class DynamicsRatioLoss(HybridLoss):
    r"""Cross-entropy of the two discriminators, with equal weight on both streams.

    In training mode, Gaussian noise is added to the inputs, by default to all of them (see ``input_noise``); after
    ``loss.eval()``, none is added. In evaluation mode, ``accuracy`` on a held-out batch therefore measures how well the
    discriminator detects the dynamics gap (0.5 is chance).

    By default each network is trained by its own loss, unlike in the authors' code; see ``detach_residual`` of
    :class:`DynamicsRatioEstimator`.

    Args:
        estimator (DynamicsRatioEstimator): holds the two networks.

    Keyword Args:
        input_noise (float, mapping or None, optional): standard deviation of the noise, in the unit of each input. A
            number is for all inputs; a mapping gives the standard deviation by entry, and other entries get no noise:
            ``{("next", "observation"): 0.1}`` is noise on s' alone. For an estimator that reads the change of the
            observation, the noise on s' is in units of ``change_scale``. 0 or ``None`` adds no noise. Defaults to 0.1.
        weight_penalty (float, optional): λ of :math:`\tfrac\lambda 2\|W\|^2`, over the weights (not the biases) of
            each network, added to the network's loss. It reduces over-fitting, which biases the ratio of the rows that
            the networks were trained on. Needs ``reduction="mean"``. Defaults to 0.
        delay_estimator (bool, optional): whether the ratio is that of target networks, the exponential moving average
            of the discriminators that ``SoftUpdate(loss, tau=...)`` computes. The average has less noise than the
            discriminators of any one update. Defaults to ``False``, as in the authors' code.
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.HybridLoss`.

    Reads the estimator's inputs, ``real`` ``[*B]`` and, if present, ``priority_weight`` ``[*B]``. Returns
    ``loss_ratio_sa``, ``loss_ratio_sas``, and the accuracies of the two classifiers: ``accuracy_sa`` of the one that
    reads (s, a), ``accuracy`` of the one that reads (s, a, s'). Each is the mean of the two streams' accuracies. An
    estimator without ``sa_network`` has neither ``loss_ratio_sa`` nor ``accuracy_sa``.

    Raises:
        ValueError: for a negative standard deviation or penalty, noise on an entry that the estimator does not read,
            or a penalty with another reduction than "mean".

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

    _checked_network = "estimator"
    estimator: DynamicsRatioEstimator
    estimator_params: TensorDictParams
    target_estimator_params: TensorDictParams

    def __init__(
        self,
        estimator: DynamicsRatioEstimator,
        *,
        input_noise: float | Mapping[NestedKey, float] | None = 0.1,
        weight_penalty: float = 0.0,
        delay_estimator: bool = False,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction=reduction)
        if weight_penalty < 0 or (weight_penalty and reduction != "mean"):
            raise ValueError(f"weight_penalty={weight_penalty} must not be negative, and needs reduction='mean'.")
        noise = _noise_by_entry(input_noise, estimator.in_keys)
        self._network_inputs = estimator.network_inputs
        # TorchRL accepts any compatible module, although it annotates a TensorDictModule.
        self.convert_to_functional(cast(TensorDictModule, estimator), "estimator", create_target_params=delay_estimator)
        self.delay_estimator = delay_estimator
        self.input_noise = input_noise
        self._noise = noise
        self.weight_penalty = weight_penalty

    def _read_keys(self) -> Iterable[NestedKey]:
        return *self.estimator.in_keys, self.tensor_keys.real

    def _written_keys(self) -> Iterable[NestedKey]:
        if self.estimator.sa_network is None:
            return "loss_ratio_sas", "accuracy"
        return "loss_ratio_sa", "loss_ratio_sas", "accuracy_sa", "accuracy"

    def dynamics_ratio(self, tensordict: TensorDictBase) -> Tensor:
        """Compute the clamped ratio of Eq. (9), as a constant, ``[*B]``; see :meth:`log_and_clamped_ratio`."""
        return self.log_and_clamped_ratio(tensordict)[1]

    def log_and_clamped_ratio(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Compute the logarithm of Eq. (9) without clamp, and the clamped ratio, constants, ``[*B]`` each.

        With ``delay_estimator`` they are those of the target networks, otherwise of the current discriminators.
        """
        params = self.target_estimator_params if self.delay_estimator else self.estimator_params
        with params.to_module(self.estimator, preserve_module_state=False):
            return self.estimator.ratio(tensordict)

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        rows, inputs = self._rows(batch), batch.select(*self.estimator.in_keys)
        with self.estimator_params.to_module(self.estimator, preserve_module_state=False):
            sa, sas = self.estimator.log_odds(self._noisy(inputs) if self.training and self._noise else inputs)
        terms = {
            "loss_ratio_sa": self._cross_entropy(sa, rows),
            "loss_ratio_sas": self._cross_entropy(sas, rows),
            "accuracy_sa": self._accuracy(sa, rows),
            "accuracy": self._accuracy(sas, rows),
        }
        if self.weight_penalty:
            terms["loss_ratio_sa"] = terms["loss_ratio_sa"] + self._penalty("sa_network")
            terms["loss_ratio_sas"] = terms["loss_ratio_sas"] + self._penalty("sas_network")
        return self._output({name: term for name, term in terms.items() if name in self._written_keys()}, tensordict)

    def _noisy(self, inputs: TensorDictBase) -> TensorDictBase:
        """Add the noise of each entry, in the order of the entries in ``inputs``, with the parameters in use."""
        estimator, noisy = self.estimator, inputs.copy()
        for key in inputs.keys(True, True):
            std = self._noise.get(unravel_key(key))
            if std is None:
                continue
            x = cast(Tensor, inputs.get(key))
            # The same numbers as torch.randn_like. Compiled populations replace normal_ to supply recorded numbers.
            noise = std * torch.empty_like(x).normal_()
            scale = estimator.change_scale if unravel_key(key) == estimator.next_observation else None
            noisy.set(key, x + (noise if scale is None else scale * noise))
        return noisy

    def _penalty(self, network: str) -> Tensor | float:
        """Compute λ/2 times the sum of the squared weights of a network; 0 if the estimator has no such network."""
        if getattr(self.estimator, network) is None:
            return 0.0
        params = cast(TensorDictBase, self.estimator_params.get(network))
        weights = [cast(Tensor, params.get(key)) for key in params.keys(True, True) if key[-1] == "weight"]
        return 0.5 * self.weight_penalty * cast(Tensor, sum(weight.square().sum() for weight in weights))

    def _cross_entropy(self, log_odds: Tensor, rows: Rows) -> Tensor:
        terms = F.softplus(torch.where(rows.like(log_odds).real, -log_odds, log_odds))  # -log p(own stream)
        return self._expectation(terms, rows)

    def _accuracy(self, log_odds: Tensor, rows: Rows) -> Tensor:
        hits = ((log_odds > 0) == rows.like(log_odds).real).to(log_odds.dtype)
        return self._metric(hits, rows)


def _noise_by_entry(
    noise: float | Mapping[NestedKey, float] | None, in_keys: Sequence[NestedKey]
) -> dict[NestedKey, float]:
    """Return the positive standard deviations by entry."""
    by_entry = noise if isinstance(noise, Mapping) else dict.fromkeys(in_keys, noise or 0.0)
    by_entry = {cast(NestedKey, unravel_key(key)): std for key, std in by_entry.items()}
    for key, std in by_entry.items():
        if std < 0:
            raise ValueError(f"input_noise is a standard deviation and cannot be {std}; None is no noise.")
        if key not in in_keys:
            raise ValueError(f"input_noise names {key!r}; the estimator reads {list(in_keys)}.")
    return {key: std for key, std in by_entry.items() if std}
