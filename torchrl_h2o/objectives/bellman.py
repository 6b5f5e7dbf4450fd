"""The dynamics-aware mixed value update, Eqs. (7) and (8): where in-sample and exploring Bellman targets meet."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    dispatch,
)
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import ValueEstimators

from torchrl_h2o.objectives.functional import distribution, run, sample_from_noise
from torchrl_h2o.objectives.hybrid_loss import HybridLoss, Rows, like_rows, normal_like


class EntropyBonus(TensorDictModuleBase):
    r"""The default exploration term of Eq. (7): :math:`-\beta\log\pi(a'|s')`.

    Any TensorDict module that writes ``exploration_bonus`` (``[*B]`` or ``[*B, 1]``, in units of the reward) can
    stand in its place. It is called without gradients on the *next* states and finds there the observation, the
    action that the policy takes, its log-probability ``"_log_prob"`` ``[*B]``, and β as ``alpha`` ``[*B]``.

    Source:
        H2O+, Eq. (7).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> next_states = TensorDict(_log_prob=torch.tensor([-2.0, 1.0]), alpha=torch.full((2,), 0.5), batch_size=2)
        >>> EntropyBonus()(next_states)["exploration_bonus"]
        tensor([ 1.0000, -0.5000])
    """

    def __init__(self) -> None:
        super().__init__()
        self.in_keys = ["_log_prob", "alpha"]
        self.out_keys = ["exploration_bonus"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        log_prob, alpha = (tensordict.get(key) for key in self.in_keys)
        return tensordict.set("exploration_bonus", -alpha * log_prob)


class MixedBellmanLoss(HybridLoss):
    r"""Q loss on the mixed Bellman target, simulated rows weighted by the dynamics ratio.

    .. math::
        \mathcal B^{mix}_\lambda\hat Q=r+\lambda\gamma V(s')
          +(1-\lambda)\gamma\,E_{a'\sim\pi}[\hat Q(s',a')-\beta\log\pi(a'|s')]

    .. math::
        \min_Q E_{𝒟}[(Q-\mathcal B^{mix}_\lambda\hat Q)^2]
          +E_B\big[\tfrac{P}{\hat P}(Q-\mathcal B^{mix}_\lambda\hat Q)^2\big]

    λ = 0 is SAC's target on both streams (6), λ = 1 the in-sample target (5). Terminated states do not bootstrap,
    truncated ones do. It moves the Q network alone; the policy and V are read. γ is 0.99 until
    ``loss.make_value_estimator(gamma=...)`` says otherwise, as in TorchRL.

    Args:
        actor_network (ProbabilisticTensorDictSequential): π(a|s), with a reparameterised distribution.
        qvalue_network (TensorDictModule or list of them): Q(s, a); writes ``"state_action_value"``, ``[*B, 1]``. A
            list is an ensemble of independent initialisations; one module is expanded to ``num_qvalue_nets``.
        value_network (TensorDictModule or None): V(s); writes ``"state_value"``, ``[*B, 1]``. With λ = 0 there need be
            none, and λ stays 0 then.
        mixing (float, optional): λ in [0, 1]. Defaults to 0.1, the paper's. ``loss.mixing = x`` changes it later.

    Keyword Args:
        exploration (TensorDictModule, optional): writes ``exploration_bonus``. Defaults to :class:`EntropyBonus`.
        alpha_init (float, optional): β. Defaults to 1.0.
        num_qvalue_nets (int, optional): size of the ensemble; the target takes its minimum. Defaults to 2.
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.hybrid_loss.HybridLoss`.

    Raises:
        ValueError: if λ is outside [0, 1] or not 0 where there is no V, or β is not positive.

    Reads observation, action, ``real`` ``[*B]``, ``("next", ...)`` observation, reward ``[*B, 1]`` and terminated
    ``[*B, 1]``, and ``dynamics_ratio`` ``[*B]`` if it is there (else 1). Writes ``loss_qvalue``, the sum over the
    ensemble, and into the input ``td_error`` ``[*B]``, the largest of the ensemble, as TorchRL's losses do.

    Source:
        H2O+, Eqs. (7) and (8).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_h2o.objectives import make_actor, make_qvalue, make_value
        >>> actor = make_actor(observation_dim=3, action_spec=Bounded(-1, 1, (1,)))
        >>> loss = MixedBellmanLoss(actor, [make_qvalue(3, 1), make_qvalue(3, 1)], make_value(3), mixing=0.1)
        >>> batch = TensorDict(observation=torch.randn(4, 3), action=torch.rand(4, 1), real=torch.arange(4) < 2,
        ...                    next=TensorDict(observation=torch.randn(4, 3), reward=torch.randn(4, 1),
        ...                                    terminated=torch.zeros(4, 1, dtype=torch.bool)), batch_size=4)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> loss(batch)["loss_qvalue"].backward()
    """

    @dataclass
    class _AcceptedKeys(HybridLoss._AcceptedKeys):
        """Keys that ``set_keys`` renames.

        Attributes:
            action: Defaults to ``"action"``.
            value: V(s), as the value network writes it. Defaults to ``"state_value"``.
            state_action_value: Q(s, a), as the Q network writes it. Defaults to ``"state_action_value"``.
            reward: below ``"next"``. Defaults to ``"reward"``.
            terminated: below ``"next"``. Defaults to ``"terminated"``.
            dynamics_ratio: P / P̂ of the simulated rows. Defaults to ``"dynamics_ratio"``.
            priority: where the td error goes. Defaults to ``"td_error"``.
            priority_weight: of a prioritised replay buffer; multiplies the terms if it is there. Defaults to
                ``"priority_weight"``.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        dynamics_ratio: NestedKey = "dynamics_ratio"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    _schedulable_buffers = frozenset({"mixing", "gamma"})

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    value_network: TensorDictModule | None
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        value_network: TensorDictModule | None,
        mixing: float = 0.1,
        *,
        exploration: TensorDictModuleBase | None = None,
        alpha_init: float = 1.0,
        num_qvalue_nets: int = 2,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction=reduction)
        if not 0 <= mixing <= 1:
            raise ValueError(f"mixing (lambda) must lie in [0, 1], not {mixing}.")
        if not alpha_init > 0:
            raise ValueError(f"alpha_init must be positive, not {alpha_init}.")
        self.convert_to_functional(actor_network, "actor_network")
        self.tensor_keys.action = _action_key(actor_network)
        if isinstance(qvalue_network, Sequence):
            num_qvalue_nets = len(qvalue_network)
        self.convert_to_functional(qvalue_network, "qvalue_network", num_qvalue_nets, create_target_params=True)
        if value_network is None and mixing:
            raise ValueError(f"mixing={mixing} weighs V(s'), and there is no value network: pass one, or mixing=0.0.")
        self._hold_value_network(value_network)
        self.exploration = EntropyBonus() if exploration is None else exploration
        dtype = next(iter(self.qvalue_network_params.values(True, True))).dtype
        self.register_coeff_buffer("mixing", mixing, dtype=dtype)
        self.register_coeff_buffer("gamma", 0.99, dtype=dtype)
        _ = self.vmap_randomness  # TorchRL settles it when it is first asked for: for a compiled loss, too late
        self.register_buffer("log_alpha", torch.tensor(math.log(alpha_init), dtype=dtype))

    def _hold_value_network(self, value_network: TensorDictModule | None) -> None:
        if value_network is None:
            self.value_network = None
        else:
            self.convert_to_functional(value_network, "value_network")

    def make_value_estimator(self, value_type: ValueEstimators | None = None, **hyperparams) -> None:
        """Sets γ of Eq. (7): ``loss.make_value_estimator(gamma=0.98)``.

        Raises:
            ValueError: for an estimator that is not TD(0): Eq. (7) is a one-step target, there is no other.
        """
        if value_type not in (None, ValueEstimators.TD0):
            raise ValueError(f"Eq. (7) is a one-step target: TD0 alone fits, not {value_type}.")
        self.gamma = float(hyperparams.pop("gamma", 0.99))
        if hyperparams:
            raise TypeError(f"TD0 takes gamma alone, not {sorted(hyperparams)}.")

    def _read_keys(self) -> Iterable[NestedKey]:
        keys = self.tensor_keys
        value_keys = () if self.value_network is None else self.value_network.in_keys
        states = (*self.actor_network.in_keys, *value_keys)
        return (
            *self.qvalue_network.in_keys,
            keys.action,
            ("next", keys.reward),
            ("next", keys.terminated),
            *(("next", key) for key in states),
            keys.real,
        )

    def _optional_keys(self) -> Iterable[NestedKey]:
        return self.tensor_keys.dynamics_ratio, self.tensor_keys.priority_weight

    def _written_keys(self) -> Iterable[NestedKey]:
        return ("loss_qvalue",)

    @property
    def alpha(self) -> Tensor:
        """β, the weight of the entropy, as a constant."""
        return self.log_alpha.detach().exp()

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._output({"loss_qvalue": self.qvalue_loss(tensordict, self._rows(tensordict))}, tensordict)

    def qvalue_loss(self, tensordict: TensorDictBase, rows: Rows) -> Tensor:
        """Eq. (8), reduced; writes the td error into ``tensordict``."""
        qvalues = self._qvalues(tensordict, self.qvalue_network_params)
        td_error = qvalues - self.mixed_target(tensordict)
        tensordict.set(self.tensor_keys.priority, td_error.detach().abs().amax(0))
        terms = (td_error**2).sum(0)
        return self._expectation(self._weight(terms, tensordict, rows), rows)  # Eq. (8)

    @torch.no_grad()
    def mixed_target(self, tensordict: TensorDictBase) -> Tensor:
        """Eq. (7): the target of Q(s, a), a constant, ``[*B]``."""
        keys = self.tensor_keys
        next_states = tensordict.get("next")
        next_value = self._next_policy_value(next_states, self._given_noise(tensordict, "next_action"))
        if self.value_network is not None:
            next_value = self.mixing * self._next_value(next_states) + (1 - self.mixing) * next_value
        reward = like_rows(self._entry(next_states, keys.reward), next_value)
        terminated = like_rows(self._entry(next_states, keys.terminated).bool(), next_value)
        return reward + self.gamma * torch.where(terminated, 0.0, next_value)  # Eq. (7)

    def _next_value(self, next_states: TensorDictBase) -> Tensor:
        """V(s') of the online value network."""
        out = run(self.value_network, next_states, self.value_network_params)
        return self._entry(out, self.tensor_keys.value).squeeze(-1)

    def _next_policy_value(self, next_states: TensorDictBase, noise: Tensor | None) -> Tensor:
        """Q̂(s', a') of the target networks' minimum plus the exploration term, a' from the policy."""
        states = next_states.copy()
        action, log_prob = self._sample_action(states, noise)
        states.set(self.tensor_keys.action, action)
        qvalue = self._qvalues(states, self.target_qvalue_network_params).amin(0)
        states.set("_log_prob", log_prob).set("alpha", self.alpha.expand(log_prob.shape))
        bonus = self.exploration(states).get("exploration_bonus")
        return qvalue + like_rows(bonus, qvalue)

    def draw_noise(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDict:
        action = self._entry(tensordict, self.tensor_keys.action)
        return super().draw_noise(tensordict, generator).set("next_action", normal_like(action, generator))

    def _sample_action(self, states: TensorDictBase, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Reparameterised a ~ π(.|s) and log π(a|s), ``[*B]``."""
        with set_exploration_type(ExplorationType.RANDOM):
            policy = distribution(self.actor_network, states, self.actor_network_params)
        return rsample_and_log_prob(policy) if noise is None else sample_from_noise(policy, noise)

    def _qvalues(self, tensordict: TensorDictBase, params: TensorDictBase, *, frozen: bool = False) -> Tensor:
        """Q(s, a) of every member of the ensemble, ``[num_qvalue_nets, *B]``."""
        out = run(self.qvalue_network, tensordict, params, self.vmap_randomness, frozen=frozen)
        return self._entry(out, self.tensor_keys.state_action_value).squeeze(-1)

    def _weight(self, terms: Tensor, tensordict: TensorDictBase, rows: Rows) -> Tensor:
        """Terms of simulated rows times P / P̂, real rows as they are; both times the priority's weight."""
        priority_weight = self._maybe_get_priority_weight(tensordict)
        if priority_weight is not None:
            terms = terms * like_rows(priority_weight, terms)
        ratio = tensordict.get(self.tensor_keys.dynamics_ratio, None)
        if ratio is None:
            return terms
        return torch.where(rows.real, terms, like_rows(ratio.detach(), terms) * terms)


def _action_key(actor_network: ProbabilisticTensorDictSequential) -> NestedKey:
    """Where the actor writes its action, as it says itself."""
    keys = getattr(actor_network, "dist_sample_keys", None)
    return keys[0] if keys else "action"
