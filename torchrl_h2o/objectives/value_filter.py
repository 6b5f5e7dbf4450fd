"""VGDF's filter: Q learns from those simulated transitions that lead to the value to which reality would lead."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from torchrl_h2o.objectives.batch_checks import entry, one_per_row, require_boolean
from torchrl_h2o.objectives.bellman import MixedBellmanLoss
from torchrl_h2o.objectives.dynamics_model import DynamicsModelLoss


class ValueGuidedFilter(TensorDictModuleBase):
    r"""Give weight 1 to the simulated rows with the highest fictitious value proximity Λ, and 0 to the others.

    .. math::
        \Lambda(s,a,s')=\log\mathcal N\big(V(s');\,\mathrm{mean}_i\,V(s'_i),\,\mathrm{var}_i\,V(s'_i)\big),\qquad
        s'_i\sim T_i(\cdot|s,a),\quad V(s)=\min_k\hat Q_k(s,a)|_{a\sim\pi(\cdot|s)}

    The models T of the real dynamics are those of ``dynamics_loss``, which trains them. The weight is written where
    :class:`MixedBellmanLoss` and :class:`H2OPlusLoss` read the dynamics ratio:

    .. math::
        \omega(s,a,s')=1\big(\Lambda(s,a,s')>\Lambda_\xi\big)\text{ multiplies the Bellman error of simulated rows}

    Args:
        bellman_loss (MixedBellmanLoss): holds the policy and the target networks of Q.
        dynamics_loss (DynamicsModelLoss): holds the models, and names s and s'.
        share (float, optional): ξ, the share of a batch's simulated rows that is kept, in (0, 1]. Defaults to 0.25.

    Keyword Args:
        real (NestedKey, optional): marks measured rows, which have weight 1. If the batch has no such entry, all rows
            count as simulated. Defaults to ``"real"``.
        out_keys (sequence of NestedKey, optional): keys of the weight and of Λ, ``[*B]`` each, constants. Defaults to
            ``["dynamics_ratio", "value_proximity"]``.

    Raises:
        ValueError: if ξ is not in (0, 1].

    Source:
        VGDF (Xu et al., 2023, https://arxiv.org/abs/2305.17625), Eqs. (5) to (7). As in these, rewards and ends of
        episodes are left out of the values; the authors' code includes them, and keeps all rows at first. Their
        exploration policy is not a part of this module.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_h2o.objectives import (DynamicsModelLoss, MixedBellmanLoss, make_actor, make_dynamics_model,
        ...     make_qvalue)
        >>> actor, qvalues = make_actor(3, Bounded(-1, 1, (1,))), make_qvalue(3, 1, ensemble=2)
        >>> bellman_loss = MixedBellmanLoss(actor, qvalues, mixing=0.0)
        >>> filtered = ValueGuidedFilter(bellman_loss, DynamicsModelLoss(make_dynamics_model(3, 1)))
        >>> batch = TensorDict(observation=torch.randn(8, 3), action=torch.rand(8, 1),
        ...                    next=TensorDict(observation=torch.randn(8, 3)), batch_size=8)
        >>> filtered(batch)["dynamics_ratio"].sum()
        tensor(2.)
    """

    # TorchRL annotates these as lists of flat keys.
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(
        self,
        bellman_loss: MixedBellmanLoss,
        dynamics_loss: DynamicsModelLoss,
        share: float = 0.25,
        *,
        real: NestedKey = "real",
        out_keys: Iterable[NestedKey] = ("dynamics_ratio", "value_proximity"),
    ) -> None:
        super().__init__()
        if not 0 < share <= 1:
            raise ValueError(f"share must lie in (0, 1], not {share}.")
        self.bellman_loss, self.dynamics_loss = bellman_loss, dynamics_loss
        self.share, self.real = share, real
        self.in_keys = list(
            dict.fromkeys((*dynamics_loss.network.in_keys, dynamics_loss.observation, dynamics_loss.next_observation))
        )
        self.out_keys = list(out_keys)

    def _values(self, observation: Tensor, batch_size: torch.Size) -> Tensor:
        """V of observations, with one action of the policy each, ``[*B]``."""
        loss = self.bellman_loss
        states = TensorDict({self.dynamics_loss.observation: observation}, batch_size)
        states.set(loss.tensor_keys.action, loss.sample_action(states)[0])
        return loss.qvalues(states, loss.target_qvalue_network_params).amin(0)

    @dispatch()
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        name, models = "ValueGuidedFilter", self.dynamics_loss
        value = self._values(entry(tensordict, models.next_observation, name), tensordict.batch_size)
        following = models.sample(tensordict)
        fictitious = self._values(following, torch.Size([len(following), *tensordict.batch_size]))  # Eq. (5)
        mean, std = fictitious.mean(0), fictitious.std(0).clamp_min(1e-8)
        proximity = -((value - mean) / std).square() / 2 - std.log()  # Eq. (6), without a constant
        real = tensordict.get(self.real, None)
        if real is None:
            real = torch.zeros_like(proximity, dtype=torch.bool)
        real = one_per_row(require_boolean(real, self.real, name), proximity.shape, self.real, name)
        ordered = torch.where(real, -torch.inf, proximity).flatten().argsort(descending=True)
        kept = ordered.argsort().reshape(real.shape) < self.share * (~real).sum()  # Eq. (7)
        weight, key = (real | kept).to(proximity.dtype), self.out_keys
        return tensordict.set(key[0], weight).set(key[1], proximity)
