"""Default exploration term of the mixed Bellman target, Eq. (7): the policy's entropy."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch


class EntropyBonus(TensorDictModuleBase):
    r"""Entropy term of Eq. (7): :math:`-\beta\log\pi(a'|s')`.

    Any TensorDict module that writes an exploration bonus (``[*B]`` or ``[*B, 1]``, in units of the reward) can
    replace this one. The loss calls the module without gradients on the *next* states. The module's input contains the
    observation, the policy's action, the action's log-probability ``[*B]`` and β ``[*B]``.

    Keyword Args:
        log_prob (NestedKey, optional): log-probability, read. Defaults to ``"_log_prob"``.
        alpha (NestedKey, optional): β, read. Defaults to ``"alpha"``.
        exploration_bonus (NestedKey, optional): the bonus, written. Defaults to ``"exploration_bonus"``.

    ``set_keys`` of :class:`~torchrl_h2o.objectives.MixedBellmanLoss` renames these keys too.

    Source:
        H2O+ (Niu et al., 2023, https://arxiv.org/abs/2309.12716), Eq. (7).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> next_states = TensorDict(_log_prob=torch.tensor([-2.0, 1.0]), alpha=torch.full((2,), 0.5), batch_size=2)
        >>> EntropyBonus()(next_states)["exploration_bonus"]
        tensor([ 1.0000, -0.5000])
    """

    # TorchRL annotates these as lists of flat keys.
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(
        self,
        *,
        log_prob: NestedKey = "_log_prob",
        alpha: NestedKey = "alpha",
        exploration_bonus: NestedKey = "exploration_bonus",
    ) -> None:
        super().__init__()
        self.in_keys = [log_prob, alpha]
        self.out_keys = [exploration_bonus]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        log_prob, alpha = (tensordict.get(key) for key in self.in_keys)
        return tensordict.set(self.out_keys[0], -alpha * log_prob)
