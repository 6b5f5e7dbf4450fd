"""Reward corrections of DARC, DARA and PAR: lower the reward of simulated steps that are unlikely in reality."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch

from torchrl_h2o.objectives.batch_checks import one_per_row, require_boolean


class DynamicsRewardCorrection(TensorDictModuleBase):
    r"""Add a measure u of the dynamics gap to the reward of simulated transitions.

    .. math::
        r+c\,u(s,a,s'),\qquad u=\log\tfrac{P}{\hat P}(s'|s,a)\text{ of an estimator of the dynamics ratio}

    The log ratio with TorchRL's ``SACLoss`` gives DARC; on both streams, clipped and with a smaller c, DARA. A
    :class:`RepresentationDeviation` and a negative c give the reward of PAR. Call the module on a batch, or make it the
    transform of a replay buffer, ``ReplayBuffer(..., transform=correction)``; each sample is then corrected with the
    current networks.

    Args:
        estimator (TensorDictModule): reads a transition and writes u, ``[*B]``, as its first entry, for example a
            :class:`DynamicsRatioEstimator` trained by a :class:`DynamicsRatioLoss`, whose log ratio is bounded by
            ``logit_bound``, not by ``clamp``.
        scale (float, optional): c, reward per unit of u (of the log ratio, nats). If the loss receives rewards
            multiplied by a factor, multiply c by it, too. Defaults to 1.0.

    Keyword Args:
        clip (float, optional): bound of :math:`|u|`, in its unit. Defaults to ``None``: no bound.
        gamma (float, optional): discount factor of n-step rewards. Only the first of the n transitions is available, so
            its correction is counted for all of them: it is multiplied by :math:`1+\gamma+\dots+\gamma^{m-1}`, with m =
            ``steps_to_next_obs``. Exact for one step. Defaults to 0.99.
        reward (NestedKey, optional): read and replaced, ``[*B, 1]`` or ``[*B]``. Defaults to ``("next", "reward")``.
        real (NestedKey, optional): marks measured rows, which keep their reward. If the batch has no such entry, all
            rows count as simulated. Defaults to ``"real"``.
        steps_to_next_obs (NestedKey, optional): number of steps m of an n-step row, read if present. Defaults to
            ``"steps_to_next_obs"``.

    Raises:
        KeyError: if a transition lacks the estimator's inputs or the reward.

    Source:
        The correction Δr: DARC (Eysenbach et al., 2020, https://arxiv.org/abs/2006.13916). Its clip: DARA (Liu et al.,
        2022, https://arxiv.org/abs/2203.06662). The ratio: H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716),
        Eq. (9).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_h2o.objectives import make_dynamics_ratio_estimator
        >>> correction = DynamicsRewardCorrection(make_dynamics_ratio_estimator(observation_dim=3, action_dim=1))
        >>> steps = TensorDict(observation=torch.randn(8, 3), action=torch.rand(8, 1), batch_size=8,
        ...                    next=TensorDict(observation=torch.randn(8, 3), reward=torch.zeros(8, 1), batch_size=8))
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(8), transform=correction, batch_size=4)
        >>> _ = buffer.extend(steps)
        >>> buffer.sample()["next", "reward"].abs().max() > 0
        tensor(True)
    """

    # TorchRL annotates these as lists of flat keys.
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(
        self,
        estimator: TensorDictModuleBase,
        scale: float = 1.0,
        *,
        clip: float | None = None,
        gamma: float = 0.99,
        reward: NestedKey = ("next", "reward"),
        real: NestedKey = "real",
        steps_to_next_obs: NestedKey = "steps_to_next_obs",
    ) -> None:
        super().__init__()
        self.estimator = estimator
        self.scale = scale
        self.clip = clip
        self.gamma = gamma
        self.steps_to_next_obs = steps_to_next_obs
        self.reward, self.real = reward, real
        self.in_keys = [*estimator.in_keys, reward]
        self.out_keys = [reward]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        name = "DynamicsRewardCorrection"
        estimated = self.estimator(tensordict.select(*self.estimator.in_keys))
        measure = estimated.get(self.estimator.out_keys[0])
        correction = self.scale * (measure if self.clip is None else measure.clamp(-self.clip, self.clip))
        steps = tensordict.get(self.steps_to_next_obs, None)
        if steps is not None:
            steps = one_per_row(steps, correction.shape, self.steps_to_next_obs, name).to(correction.dtype)
            correction = correction * (steps if self.gamma == 1 else (1 - self.gamma**steps) / (1 - self.gamma))
        real = tensordict.get(self.real, None)
        if real is not None:
            real = one_per_row(require_boolean(real, self.real, name), correction.shape, self.real, name)
            correction = torch.where(real, 0.0, correction)
        reward = tensordict.get(self.reward)
        one_per_row(reward, correction.shape, self.reward, name)
        return tensordict.set(self.reward, reward + correction.reshape(reward.shape))
