"""ReBRAC: TorchRL's TD3+BC loss with a second penalty of the distance from the data's actions, in the target of Q."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor
from torchrl.objectives import TD3BCLoss


class ReBRACLoss(TD3BCLoss):
    r"""TorchRL's ``TD3BCLoss`` with the same arguments, and ReBRAC's penalty in the critic's target.

    .. math::
        r+\gamma\big(\min_i\hat Q_i(s',a')-\beta_2\|a'-\hat a'\|^2\big),\qquad
        a'=\hat\pi(s')+\epsilon,\quad\hat a'\text{ the action that follows in the data}

    The penalty of the policy, :math:`\beta_1\|\pi(s)-a\|^2` beside the normalised Q, is that of TD3+BC: for a policy of
    n dimensions, ``alpha`` is :math:`1/(n\beta_1)`, because TorchRL takes the mean over the dimensions. In the n-step
    rows of :class:`~torchrl_h2o.data.HybridReplayBuffer`, s' and the action that follows are m steps later and γ
    becomes γ to the m. The noise ε of the penalty is drawn anew; the authors have that of :math:`\hat Q`, with the same
    mean.

    Keyword Args:
        critic_penalty (float, optional): β₂, in rewards per squared unit of the action, at least 0. Defaults to 0.0,
            which is TD3+BC.

    Raises:
        ValueError: if β₂ is negative.

    Reads the inputs of ``TD3BCLoss`` and, if β₂ is positive, ``("next", "action")``, which
    :func:`~torchrl_h2o.data.with_next_actions` adds to recorded data.

    Source:
        ReBRAC (Tarasov et al., 2023, https://arxiv.org/abs/2305.09836), Eqs. (3) and (4). Its other changes are layer
        normalisation in Q, see :func:`make_qvalue`, deeper networks and larger batches.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_h2o.objectives import make_actor, make_qvalue
        >>> spec, qvalues = Bounded(-1, 1, (1,)), make_qvalue(3, 1, layer_norm=True, ensemble=2)
        >>> loss = ReBRACLoss(make_actor(3, spec), qvalues, action_spec=spec, loss_function="l2", critic_penalty=0.1)
        >>> loss.make_value_estimator(gamma=0.99)
        >>> step = {"done": torch.zeros(4, 1, dtype=torch.bool), "terminated": torch.zeros(4, 1, dtype=torch.bool)}
        >>> batch = TensorDict(observation=torch.randn(4, 3), action=torch.rand(4, 1), batch_size=4,
        ...                    next=TensorDict(observation=torch.randn(4, 3), action=torch.rand(4, 1),
        ...                                    reward=torch.randn(4, 1), **step))
        >>> loss(batch)["loss_qvalue"].backward()
    """

    out_keys = TD3BCLoss.out_keys  # select_out_keys needs those of the class itself
    critic_penalty = 0.0

    def __init__(self, *args, critic_penalty: float = 0.0, **kwargs) -> None:
        if critic_penalty < 0:
            raise ValueError(f"critic_penalty is {critic_penalty}: a negative one would draw Q away from the data.")
        super().__init__(*args, **kwargs)
        self.critic_penalty = critic_penalty

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        if self.critic_penalty:
            self._in_keys = [*(self._in_keys or ()), unravel_key(("next", self.tensor_keys.action))]

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict]:
        """Compute the loss of Q; see ``TD3BCLoss.qvalue_loss``."""
        return super().qvalue_loss(self._penalised(tensordict) if self.critic_penalty else tensordict)

    @torch.no_grad()
    def _penalised(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Copy a batch, with the discounted penalty subtracted from its reward."""
        keys, estimator, following = self.tensor_keys, self.value_estimator, tensordict.get("next")
        with self.target_actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            action = self.actor_network(following.select(*self.actor_network.in_keys)).get(keys.action)
        noise = (torch.randn_like(action) * self.policy_noise).clamp(-self.noise_clip, self.noise_clip)
        action = (action + noise).clamp(self.min_action, self.max_action)
        distance = (action - following.get(keys.action)).square().sum(-1, keepdim=True)
        discount, steps = cast(Tensor, estimator.gamma), tensordict.get(estimator.tensor_keys.steps_to_next_obs, None)
        if steps is not None:
            discount = discount ** steps.reshape(distance.shape)
        goes_on = ~following.get(keys.terminated).reshape(distance.shape)
        reward = following.get(keys.reward)
        penalty = (self.critic_penalty * discount * distance * goes_on).reshape(reward.shape)  # Eq. (4)
        return tensordict.copy().set(unravel_key(("next", keys.reward)), reward - penalty)
