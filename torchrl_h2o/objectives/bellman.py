"""Dynamics-aware mixed value update, Eqs. (7) and (8): a Bellman target that mixes V(s') and the policy's Q(s', a')."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import ValueEstimators

from torchrl_h2o.objectives.batch_checks import NetworkInput, network_inputs, require_boolean, separated
from torchrl_h2o.objectives.exploration import EntropyBonus
from torchrl_h2o.objectives.hybrid_loss import HybridLoss, Rows
from torchrl_h2o.objectives.policy import action_dim_of, action_key_of, check_policy
from torchrl_h2o.objectives.value_estimator import MixedTD0Estimator, ValueType, one_step_discount

Networks = TensorDictModule | list[TensorDictModule]

if TYPE_CHECKING:

    class _ScheduledBuffer:
        """Type of a scalar buffer that TorchRL overwrites in place when a number is assigned to it."""

        def __get__(self, instance: object, owner: type | None = None) -> Tensor: ...
        def __set__(self, instance: object, value: float | Tensor) -> None: ...


class MixedBellmanLoss(HybridLoss):
    r"""Q loss on the mixed Bellman target, with simulated rows weighted by the dynamics ratio.

    .. math::
        \mathcal B^{mix}_\lambda\hat Q=r+\lambda\gamma V(s')
          +(1-\lambda)\gamma\,E_{a'\sim\pi}[\hat Q(s',a')-\beta\log\pi(a'|s')]

    .. math::
        \min_Q E_{𝒟}[(Q-\mathcal B^{mix}_\lambda\hat Q)^2]
          +E_B\big[\tfrac{P}{\hat P}(Q-\mathcal B^{mix}_\lambda\hat Q)^2\big]

    λ = 0 gives SAC's target on both streams (6), λ = 1 the in-sample target (5). The target bootstraps from truncated
    next states, but not from terminated ones. Only the Q network receives gradients; the policy and V are constants.
    γ is 0.99 by default; ``loss.make_value_estimator(gamma=...)`` changes it, as in TorchRL.

    Actions are continuous. Several agents may share the networks, with entries such as ``("agents", "action")``,
    ``[*B, agents, action_dim]``: each has rewards, targets and errors of its own.

    Args:
        actor_network (ProbabilisticTensorDictSequential): π(a|s), with a reparameterised distribution that has a
            density, such as ``TanhNormal``.
        qvalue_network (TensorDictModule or list of them): Q(s, a); writes ``"state_action_value"``, ``[*B, 1]``. A
            list is an ensemble of independent initialisations; one module is expanded to ``num_qvalue_nets``.
        value_network (TensorDictModule, optional): V(s); writes ``"state_value"``, ``[*B, 1]``. Required unless
            λ = 0.
        mixing (float, optional): λ in [0, 1]. Defaults to 0.1, the paper's value. ``loss.mixing = x`` changes it
            later.

    Keyword Args:
        exploration (TensorDictModule, optional): writes ``exploration_bonus``. Defaults to
            :class:`~torchrl_h2o.objectives.EntropyBonus`.
        alpha_init (float, optional): β. Defaults to 1.0.
        num_qvalue_nets (int, optional): size of the ensemble. The target uses the minimum over the ensemble. Defaults
            to 2.
        separate_losses (bool, optional): if ``True``, parameters that Q or V share with the policy, such as those of
            an image encoder, are trained by the policy's loss only, and those that Q shares with V by V's loss. By
            default all losses train them. To share parameters, give Q as a list of networks.
        deactivate_vmap (bool, optional): whether to replace ``vmap`` over the ensemble by a plain loop, for networks
            that ``vmap`` does not support, such as ``nn.GRU``. Defaults to ``False``.
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.HybridLoss`.

    Raises:
        ValueError: if λ is outside [0, 1], if λ > 0 and ``value_network`` is None, if β is not positive, if Q has no
            parameters, or if the policy is deterministic, discrete or composed of several actions.

    Reads observation, action, ``real`` ``[*B]``, ``("next", ...)`` observation, reward ``[*B, 1]`` and terminated
    ``[*B, 1]``. Reads if present: ``dynamics_ratio`` ``[*B]`` (default 1), ``priority_weight`` ``[*B]`` and
    ``steps_to_next_obs`` ``[*B, 1]``, the number of steps n of an n-step transition, as written by
    ``MultiStepTransform``. Its reward is the discounted sum of n rewards, and Eq. (7) becomes

    .. math::
        \sum_{k<n}\gamma^k r_{t+k}+\gamma^n\big[\lambda V(s_{t+n})
          +(1-\lambda)E_{a'\sim\pi}[\hat Q(s_{t+n},a')-\beta\log\pi(a'|s_{t+n})]\big]

    The n - 1 actions after the first are those in the batch, not the policy's. This off-policy bias grows with n and
    with the distance between the policy and the batch; it is not corrected (Munos et al., 2016,
    https://arxiv.org/abs/1606.02647, give a correction). With short control steps it costs less than one-step targets,
    in which the effect of one action is lost in the error of Q (Tallec et al., 2019, https://arxiv.org/abs/1901.09732).
    Returns ``loss_qvalue``, the sum over the ensemble. Writes
    ``td_error`` ``[*B]``, the largest absolute error of the ensemble, into the input, as TorchRL's losses do.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eqs. (7) and (8).

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
            action: Defaults to the key that the actor writes.
            value: V(s), written by the value network. Defaults to ``"state_value"``.
            state_action_value: Q(s, a), written by the Q network. Defaults to ``"state_action_value"``.
            reward: below ``"next"``. Defaults to ``"reward"``.
            terminated: below ``"next"``. Defaults to ``"terminated"``.
            done: accepted as by TorchRL's losses, and not read: a truncated episode bootstraps. Defaults to ``"done"``.
            dynamics_ratio: P / P̂ of the simulated rows. Defaults to ``"dynamics_ratio"``.
            steps_to_next_obs: n of an n-step transition. Defaults to ``"steps_to_next_obs"``.
            priority: the td error, written into the input. Defaults to ``"td_error"``.
            log_prob: log π(a'|s'), given to the exploration term. Defaults to ``"_log_prob"``.
            alpha: β, given to the exploration term. Defaults to ``"alpha"``.
            exploration_bonus: written by the exploration term. Defaults to ``"exploration_bonus"``.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        done: NestedKey = "done"
        dynamics_ratio: NestedKey = "dynamics_ratio"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        priority: NestedKey = "td_error"
        log_prob: NestedKey = "_log_prob"
        alpha: NestedKey = "alpha"
        exploration_bonus: NestedKey = "exploration_bonus"

    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    _checked_network = "qvalue_network"
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
    exploration: TensorDictModuleBase
    mixing: _ScheduledBuffer
    gamma: _ScheduledBuffer
    log_alpha: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule] | nn.ModuleList,
        value_network: TensorDictModule | None = None,
        mixing: float = 0.1,
        *,
        exploration: TensorDictModuleBase | None = None,
        alpha_init: float = 1.0,
        num_qvalue_nets: int = 2,
        separate_losses: bool = False,
        deactivate_vmap: bool = False,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction=reduction)
        if not 0 <= mixing <= 1:
            raise ValueError(f"mixing (lambda) must lie in [0, 1], not {mixing}.")
        if not alpha_init > 0:
            raise ValueError(f"alpha_init must be positive, not {alpha_init}.")
        if value_network is None and mixing:
            raise ValueError(f"mixing={mixing} weighs V(s'), and there is no value network: pass one, or mixing=0.0.")
        check_policy(actor_network)
        several = isinstance(qvalue_network, Sequence | nn.ModuleList)
        qvalues = cast("Networks", list(qvalue_network) if several else qvalue_network)
        self._network_inputs = _inputs_of(actor_network, qvalues, value_network)
        self.deactivate_vmap = deactivate_vmap
        self.convert_to_functional(actor_network, "actor_network")
        self.tensor_keys.action = action_key_of(actor_network)
        if isinstance(qvalues, list):
            num_qvalue_nets = len(qvalues)
        # TorchRL accepts a list of networks, although it annotates one.
        self.convert_to_functional(
            cast(TensorDictModule, qvalues), "qvalue_network", num_qvalue_nets, create_target_params=True
        )
        self.value_network = None
        if value_network is not None:
            self.convert_to_functional(value_network, "value_network")
        if separate_losses:
            self._separate(actor_network, value_network, qvalues)
        self.exploration = EntropyBonus() if exploration is None else exploration
        dtype = self._dtype_of("qvalue_network")
        self.register_coeff_buffer("mixing", mixing, dtype=dtype)
        self.register_coeff_buffer("gamma", 0.99, dtype=dtype)
        _ = self.vmap_randomness  # TorchRL sets it at the first access, which must not be inside a compiled forward
        self.register_buffer("log_alpha", torch.tensor(math.log(alpha_init), dtype=dtype))

    def _separate(self, actor: nn.Module, value: TensorDictModule | None, qvalues: Networks) -> None:
        """Note which parameters V shares with the policy, and Q with either."""
        shared = {parameter.data_ptr() for parameter in actor.parameters()}
        self._constants = {}
        for name, network in (("value_network", value), ("qvalue_network", qvalues)):
            if network is None:
                continue
            if isinstance(network, nn.Module):
                of_network = {parameter.data_ptr() for parameter in network.parameters()}
                if name == "qvalue_network" and shared & of_network:
                    raise ValueError(
                        "one Q network is copied with new parameters for each member of the ensemble, so it cannot "
                        "share any: give a list of networks that hold the shared module."
                    )
            leaves = getattr(self, f"{name}_params").items(True, True)
            self._constants[name] = {key for key, leaf in leaves if leaf.data_ptr() in shared}
            shared |= {leaf.data_ptr() for _, leaf in leaves}

    def make_value_estimator(self, value_type: ValueType = None, **hyperparams) -> MixedBellmanLoss:
        """Set γ of Eq. (7): ``loss.make_value_estimator(gamma=0.98)``.

        Args:
            value_type: ``ValueEstimators.TD0``, TorchRL's ``TD0Estimator`` or an instance of it. Defaults to TD0.
            **hyperparams: ``gamma``; if ``value_type`` is a class, the arguments of its constructor.

        Returns:
            This loss.

        Raises:
            NotImplementedError: for any other estimator, as Eq. (7) is a one-step target.
        """
        self.gamma = one_step_discount(value_type, hyperparams, default=float(self.gamma))
        self.value_type = ValueEstimators.TD0
        return self

    @property
    def value_estimator(self) -> MixedTD0Estimator:
        """TD(0) estimator of Eq. (7). It follows this loss; change γ and keys here, not there."""
        keys = self.tensor_keys
        estimator = MixedTD0Estimator(self.gamma, self.mixed_next_value)
        estimator.set_keys(
            value=keys.value,
            reward=keys.reward,
            done=keys.done,
            terminated=keys.terminated,
            steps_to_next_obs=keys.steps_to_next_obs,
        )
        return estimator

    def set_keys(self, **kwargs) -> None:
        super().set_keys(**kwargs)
        if isinstance(self.exploration, EntropyBonus):
            keys = self.tensor_keys
            self.exploration = EntropyBonus(
                log_prob=keys.log_prob, alpha=keys.alpha, exploration_bonus=keys.exploration_bonus
            )

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
        keys = self.tensor_keys
        return keys.dynamics_ratio, *super()._optional_keys(), keys.steps_to_next_obs

    def _written_keys(self) -> Iterable[NestedKey]:
        return ("loss_qvalue",)

    @property
    def alpha(self) -> Tensor:
        """β, the weight of the entropy, as a constant."""
        return self.log_alpha.detach().exp()

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = self._without_masked_rows(tensordict)
        losses = {"loss_qvalue": self.qvalue_loss(batch, self._rows(batch))}
        tensordict.set(self.tensor_keys.priority, batch.get(self.tensor_keys.priority))
        return self._output(losses, tensordict)

    def qvalue_loss(self, tensordict: TensorDictBase, rows: Rows) -> Tensor:
        """Compute Eq. (8), reduced, and write the td error into ``tensordict``."""
        qvalues = self.qvalues(tensordict, self.qvalue_network_params)
        td_error = qvalues - self.mixed_target(tensordict)
        tensordict.set(self.tensor_keys.priority, td_error.detach().abs().amax(0))
        terms = (td_error**2).sum(0)
        ratio = tensordict.get(self.tensor_keys.dynamics_ratio, None)
        if ratio is not None:
            ratio = self._one_per_row(ratio.detach(), terms, self.tensor_keys.dynamics_ratio)
            terms = torch.where(rows.like(terms).real, terms, ratio * terms)
        return self._expectation(terms, rows)  # Eq. (8)

    @torch.no_grad()
    def mixed_target(self, tensordict: TensorDictBase) -> Tensor:
        """Compute Eq. (7), the target of Q(s, a), as a constant, ``[*B]``."""
        keys = self.tensor_keys
        reward_key, terminated_key = (unravel_key(("next", key)) for key in (keys.reward, keys.terminated))
        next_value = self.mixed_next_value(tensordict)
        reward = self._one_per_row(self._entry(tensordict, reward_key), next_value, reward_key)
        terminated = require_boolean(self._entry(tensordict, terminated_key), terminated_key, type(self).__name__)
        terminated = self._one_per_row(terminated, next_value, terminated_key)
        steps, discount = tensordict.get(keys.steps_to_next_obs, None), self.gamma
        if steps is not None:
            discount = self.gamma ** self._one_per_row(steps, next_value, keys.steps_to_next_obs)
        return reward + discount * torch.where(terminated, 0.0, next_value)  # Eq. (7)

    @torch.no_grad()
    def mixed_next_value(self, tensordict: TensorDictBase) -> Tensor:
        """Compute what Eq. (7) multiplies by γ, the mixture of V(s') and the policy's value, ``[*B]``."""
        next_states = tensordict.get("next")
        next_value = self._next_policy_value(next_states)
        if self.value_network is None:
            return next_value
        out = self._call("value_network", next_states)
        value = self._entry(out, self.tensor_keys.value).squeeze(-1)
        return self.mixing * value + (1 - self.mixing) * next_value

    def _next_policy_value(self, next_states: TensorDictBase) -> Tensor:
        """Minimum of the target networks' Q̂(s', a') plus the exploration term, with a' ~ π(.|s'), ``[*B]``."""
        keys, states = self.tensor_keys, next_states.copy()
        action, log_prob = self.sample_action(states)
        states.set(keys.action, action)
        qvalue = self.qvalues(states, self.target_qvalue_network_params).amin(0)
        states.set(keys.log_prob, log_prob).set(keys.alpha, self.alpha.expand(log_prob.shape))
        bonus = self._entry(self.exploration(states), keys.exploration_bonus)
        return qvalue + self._one_per_row(bonus, qvalue, keys.exploration_bonus)

    def sample_action(self, states: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Draw a reparameterised a ~ π(.|s), and return it with log π(a|s), ``[*B]``."""
        stateful = self.actor_network_params.to_module(self.actor_network, preserve_module_state=False)
        with set_exploration_type(ExplorationType.RANDOM), stateful:
            policy = self.actor_network.get_dist(states.select(*self.actor_network.in_keys))
        return rsample_and_log_prob(policy)

    def qvalues(self, tensordict: TensorDictBase, params: TensorDictBase, *, frozen: bool = False) -> Tensor:
        """Q(s, a) of each ensemble member, ``[num_qvalue_nets, *B]``; ``frozen`` makes the parameters constants."""
        out = self._call("qvalue_network", tensordict, params, frozen=frozen)
        return self._entry(out, self.tensor_keys.state_action_value).squeeze(-1)


def _inputs_of(
    actor_network: ProbabilisticTensorDictSequential,
    qvalue_network: Networks,
    value_network: TensorDictModule | None,
) -> tuple[NetworkInput, ...]:
    """Sizes of the entries that the loss reads, from its networks and the action's spec."""
    read_by_q, key = network_inputs(qvalue_network), action_key_of(actor_network)
    states = [*network_inputs(actor_network), *network_inputs(value_network)]
    following = [*network_inputs(actor_network, "next"), *network_inputs(value_network, "next")]
    action_dim = action_dim_of(actor_network, key)
    action = [] if action_dim is None else [NetworkInput((unravel_key(key),), action_dim)]
    read = {key for one in (*read_by_q, *following) for key in one.keys}
    return tuple(one for one in separated([*read_by_q, *states, *following, *action]) if read.issuperset(one.keys))
