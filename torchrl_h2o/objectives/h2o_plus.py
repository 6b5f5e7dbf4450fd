"""H2O+: the mixed Bellman update, an in-sample value loss, the policy (10) and its temperature, and the ratio (9)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torch import Tensor, nn
from torchrl.data import Composite

from torchrl_h2o.objectives.bellman import MixedBellmanLoss
from torchrl_h2o.objectives.hybrid_loss import HybridLoss, Rows, normal_like
from torchrl_h2o.objectives.ratio import DynamicsRatioLoss
from torchrl_h2o.objectives.value import InSampleValueLoss


class H2OPlusLoss(MixedBellmanLoss):
    r"""All of H2O+ in one loss: add its ``loss_*`` terms and take one step of one optimiser.

    .. math::
        \max_\pi E_{𝒟\cup B}[Q(s,a)-\beta\log\pi(a|s)]

    Each term moves its own network alone: ``loss_value`` V (4), ``loss_qvalue`` Q (7, 8), ``loss_actor`` the policy
    (10), ``loss_alpha`` β, ``loss_ratio_sa`` and ``loss_ratio_sas`` the discriminators (9). A network is held once, by
    the loss that it is for: V by ``value_loss``, the discriminators by ``ratio_loss``, the others here.

    Args:
        actor_network (ProbabilisticTensorDictSequential): π(a|s), with a reparameterised distribution.
        qvalue_network (TensorDictModule or list of them): see :class:`MixedBellmanLoss`.
        value_loss (InSampleValueLoss or None): the backbone, holding V. Swapping it swaps the backbone. None, with
            λ = 0, is SAC on both streams, Eq. (6): there is no V then.
        ratio_loss (DynamicsRatioLoss, optional): holding the discriminators, whose ratio then weighs the simulated
            rows. Without it the batch's own ``dynamics_ratio`` does, and without that the weight is 1.
        mixing (float, optional): λ. Defaults to 0.1.

    Keyword Args:
        exploration (TensorDictModule, optional): see :class:`MixedBellmanLoss`.
        alpha_init (float, optional): β at the start. Defaults to 1.0.
        fixed_alpha (bool, optional): whether β stays as it is. Defaults to ``False``.
        target_entropy (float or "auto", optional): in nats; ``"auto"`` is -dim(A), from the actor's spec.
        num_qvalue_nets (int, optional): see :class:`MixedBellmanLoss`.
        num_real (int, optional): of a flat batch whose real rows come first, as
            :class:`~torchrl_h2o.data.HybridReplayBuffer` draws it, how many there are. V, which real rows alone train,
            is then not evaluated on the others.
        reduction (str, optional): see :class:`~torchrl_h2o.objectives.hybrid_loss.HybridLoss`; that of its parts too.

    Raises:
        ValueError: if the target entropy is "auto" and the actor has no action spec, or a part reduces differently.

    Reads a transition and ``real`` ``[*B]``. Writes the losses above and, to be logged, ``alpha``, ``entropy``, and
    with a ``ratio_loss`` ``accuracy_sa``, ``accuracy`` and ``dynamics_ratio`` (its mean over the simulated rows).

    Source:
        H2O+, Eqs. (4) to (10); β as in SAC (https://arxiv.org/abs/1812.05905).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_h2o.objectives import (DynamicsRatioLoss, ExpectileValueLoss, H2OPlusLoss, make_actor,
        ...     make_dynamics_ratio_estimator, make_qvalue, make_value)
        >>> loss = H2OPlusLoss(
        ...     actor_network=make_actor(observation_dim=3, action_spec=Bounded(-1, 1, (1,))),
        ...     qvalue_network=[make_qvalue(3, 1), make_qvalue(3, 1)],
        ...     value_loss=ExpectileValueLoss(make_value(3), expectile=0.7),
        ...     ratio_loss=DynamicsRatioLoss(make_dynamics_ratio_estimator(3, 1)))
        >>> optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> batch = TensorDict(observation=torch.randn(8, 3), action=torch.rand(8, 1), real=torch.arange(8) < 4,
        ...                    next=TensorDict(observation=torch.randn(8, 3), reward=torch.randn(8, 1),
        ...                                    terminated=torch.zeros(8, 1, dtype=torch.bool)), batch_size=8)
        >>> losses = loss(batch)
        >>> sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
        >>> optimiser.step()
        >>> targets.step()
    """

    value_loss: InSampleValueLoss | None
    ratio_loss: DynamicsRatioLoss | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        value_loss: InSampleValueLoss | None,
        ratio_loss: DynamicsRatioLoss | None = None,
        mixing: float = 0.1,
        *,
        exploration: TensorDictModule | None = None,
        alpha_init: float = 1.0,
        fixed_alpha: bool = False,
        target_entropy: float | str = "auto",
        num_qvalue_nets: int = 2,
        num_real: int | None = None,
        reduction: str = "mean",
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            value_loss,
            mixing,
            exploration=exploration,
            alpha_init=alpha_init,
            num_qvalue_nets=num_qvalue_nets,
            reduction=reduction,
        )
        self.ratio_loss = ratio_loss
        self.num_real = num_real
        for part in self._parts:
            if part.reduction != reduction:
                raise ValueError(
                    f"{type(part).__name__} has reduction={part.reduction!r} and H2OPlusLoss {reduction!r}: "
                    "build both alike."
                )
        if not fixed_alpha:
            log_alpha = self.log_alpha
            del self.log_alpha
            self.log_alpha = nn.Parameter(log_alpha)
        if target_entropy == "auto":
            target_entropy = -float(_action_dim(actor_network, self.tensor_keys.action))
        self.register_coeff_buffer("target_entropy", target_entropy, dtype=self.mixing.dtype)

    def _hold_value_network(self, value_loss: InSampleValueLoss | None) -> None:
        # V belongs to the loss that trains it; Eq. (7) reads it there, through the two properties below.
        self.value_loss = value_loss
        if value_loss is not None:
            self.tensor_keys.value = value_loss.tensor_keys.value

    @property
    def _parts(self) -> list[HybridLoss]:
        return [part for part in (self.value_loss, self.ratio_loss) if part is not None]

    @property
    def value_network(self) -> TensorDictModule | None:
        return None if self.value_loss is None else self.value_loss.value_network

    @property
    def value_network_params(self) -> TensorDictBase:
        return self.value_loss.value_network_params

    def set_keys(self, **kwargs) -> None:
        super().set_keys(**kwargs)
        for part in self._parts:
            part.set_keys(**{k: v for k, v in kwargs.items() if hasattr(part.tensor_keys, k)})

    @property
    def loss_mask_key(self) -> NestedKey | str | None:
        return self._loss_mask_key

    @loss_mask_key.setter
    def loss_mask_key(self, key: NestedKey | str | None) -> None:
        for loss in (self, *self._parts):
            HybridLoss.loss_mask_key.fset(loss, key)

    def _read_keys(self) -> Iterable[NestedKey]:
        ratio_keys = () if self.ratio_loss is None else self.ratio_loss.estimator.in_keys
        return (
            *super()._read_keys(),
            *self.actor_network.in_keys,
            *(() if self.value_network is None else self.value_network.in_keys),
            *ratio_keys,
        )

    def _optional_keys(self) -> Iterable[NestedKey]:
        keys = self.tensor_keys
        return (keys.priority_weight,) if self.ratio_loss else (keys.dynamics_ratio, keys.priority_weight)

    def _written_keys(self) -> Iterable[NestedKey]:
        yield from ("loss_actor", "loss_qvalue")
        if self.value_loss is not None:
            yield "loss_value"
        yield "loss_alpha"
        if self.ratio_loss is not None:
            yield from (
                "loss_ratio_sa",
                "loss_ratio_sas",
                "accuracy_sa",
                "accuracy",
                "dynamics_ratio",
            )
        if self.reduction != "none":
            yield from ("alpha", "entropy")

    @dispatch(source="_dispatch_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch, rows = tensordict.copy(), self._rows(tensordict)
        ratio_terms = {} if self.ratio_loss is None else self._ratio_terms(batch, rows)
        loss_qvalue = self.qvalue_loss(batch, rows)
        tensordict.set(self.tensor_keys.priority, batch.get(self.tensor_keys.priority))
        value_terms = {} if self.value_loss is None else self._value_terms(batch, rows)
        loss_actor, log_prob = self.actor_loss(batch, rows)
        terms = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            **value_terms,
            "loss_alpha": self.alpha_loss(log_prob, rows),
            **ratio_terms,
        }
        if self.reduction != "none":
            terms |= {"alpha": self.alpha, "entropy": self._metric(-log_prob, rows)}
        return self._output(terms, tensordict)

    def draw_noise(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDict:
        action = self._entry(tensordict, self.tensor_keys.action)
        ratio_noise = {} if self.ratio_loss is None else self.ratio_loss.draw_noise(tensordict, generator)  # the first
        noise = super().draw_noise(tensordict, generator).set("action", normal_like(action, generator))
        return noise.update(ratio_noise)

    def _ratio_terms(self, batch: TensorDictBase, rows: Rows) -> dict[str, Tensor]:
        """Eq. (9): writes the ratio into the batch and returns the discriminators' losses."""
        ratio = self.ratio_loss.dynamics_ratio(batch)
        batch.set(self.tensor_keys.dynamics_ratio, ratio)
        shown = ratio if self.reduction == "none" else self._expectation(ratio, rows, rows.sim, reduction="mean")
        return {**self.ratio_loss(batch), "dynamics_ratio": shown}

    def _value_terms(self, batch: TensorDictBase, rows: Rows) -> dict[str, Tensor]:
        """Eq. (4): V's loss, regressed on the target Q at the data's own actions."""
        if self.num_real is not None and self.reduction != "none":  # no other row counts
            batch, rows = batch[: self.num_real], rows.first(self.num_real)
        batch.set(self.value_loss.tensor_keys.state_action_value, self._data_qvalue(batch))
        return {"loss_value": self.value_loss.value_loss(batch, rows)}

    @torch.no_grad()
    def _data_qvalue(self, batch: TensorDictBase) -> Tensor:
        """Minimum of the target Q at the data's own action, ``[*B]``: what V is regressed on."""
        return self._qvalues(batch, self.target_qvalue_network_params).amin(0)

    def actor_loss(self, tensordict: TensorDictBase, rows: Rows) -> tuple[Tensor, Tensor]:
        """Eq. (10), reduced, and log π(a|s) of the sampled actions, ``[*B]``, a constant."""
        states = tensordict.copy()
        action, log_prob = self._sample_action(states, self._given_noise(tensordict, "action"))
        states.set(self.tensor_keys.action, action)
        qvalue = self._qvalues(states, self.qvalue_network_params, frozen=True).amin(0)
        terms = self.alpha * log_prob - qvalue  # Eq. (10)
        return self._union_expectation(terms, rows), log_prob.detach()

    def alpha_loss(self, log_prob: Tensor, rows: Rows) -> Tensor:
        """SAC's loss for β, reduced: it grows while the entropy is below its target."""
        terms = -self.log_alpha * (log_prob + self.target_entropy)
        return self._union_expectation(terms, rows)


def _action_dim(actor_network: ProbabilisticTensorDictSequential, action_key: NestedKey) -> int:
    spec = getattr(actor_network, "spec", None)
    leaf = spec.get(action_key, None) if isinstance(spec, Composite) else spec
    if leaf is None:
        raise ValueError(
            "target_entropy='auto' needs the action's spec: give it to the actor "
            "(ProbabilisticActor(..., spec=env.action_spec)), or pass target_entropy=-action_dim."
        )
    batch_dims = spec.ndim if isinstance(spec, Composite) else 0
    return leaf.shape[batch_dims:].numel()
