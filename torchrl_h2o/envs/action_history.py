"""A TorchRL transform that shows the last actions together with the observation."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import CatFrames, Transform


class ActionHistory(Transform):
    """Concatenates the last N actions and the observation.

    If actions take effect late, the observation alone is not a Markov state: what happens next also depends on actions
    that are still on their way. The observation together with these actions is one (Katsikopoulos and Engelbrecht,
    "Markov decision processes with delays and asynchronous cost collection", IEEE Transactions on Automatic Control
    48(4), 2003).

    The history is part of the observation, so the transform has no state of its own: worlds can be reset one by one,
    and episodes can be saved and continued. Actions before an episode count as zero.

    Args:
        N: number of actions.

    Shapes:
        ``observation``: ``[*B, N * m + n]`` for actions ``[*B, m]`` and observations ``[*B, n]``. The oldest action is
        first, the observation last.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("InvertedPendulum-v5"), ActionHistory(2))
        >>> env.observation_spec["observation"].shape
        torch.Size([6])
        >>> rollout = env.rollout(2)
        >>> bool((rollout["next", "observation"][1, :2] == rollout["action"].squeeze(-1)).all())
        True
    """

    def __init__(self, N: int) -> None:  # noqa: N803  (the name of CatFrames' argument)
        if N < 1:
            raise ValueError(f"N={N}: the history holds at least one action")
        super().__init__(in_keys=["observation"], out_keys=["observation"])
        self.N = N

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Returns the specification with the wider observation."""
        shown = observation_spec["observation"]
        shape = torch.Size((*shown.shape[:-1], self.N * self._action_dim + shown.shape[-1]))
        observation_spec["observation"] = Unbounded(shape=shape, dtype=shown.dtype, device=shown.device)
        return observation_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        observation = tensordict_reset["observation"]
        history = observation.new_zeros(torch.Size((*observation.shape[:-1], self.N * self._action_dim)))
        return tensordict_reset.set("observation", torch.cat([history, observation], -1))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        action, before, following = tensordict["action"], tensordict["observation"], next_tensordict["observation"]
        size = action.shape[-1]
        history = before[..., size : self.N * size]  # without the oldest action
        return next_tensordict.set("observation", torch.cat([history, action, following], -1))

    def unfolding(self, data: TensorDictBase) -> TensorDictBase:
        """Gives recorded transitions the observations that they would have had with this transform.

        Args:
            data: transitions in TED, ``[T]``. Episodes end where ``("next", "done")`` is true; actions before the first
                row of an episode count as zero.

        Returns:
            A new tensordict; ``data`` is not changed.

        Example:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> done = torch.tensor([[False], [True], [True]])
            >>> following = TensorDict(observation=torch.tensor([[7.0], [8.0], [9.0]]), done=done)
            >>> data = TensorDict(observation=following["observation"] - 1, action=torch.tensor([[1.0], [2.0], [3.0]]))
            >>> data = data.set("next", following).auto_batch_size_(1)
            >>> shown = ActionHistory(2).unfolding(data)
            >>> shown["observation"].tolist()
            [[0.0, 0.0, 6.0], [0.0, 1.0, 7.0], [0.0, 0.0, 8.0]]
            >>> shown["next", "observation"].tolist()
            [[0.0, 1.0, 7.0], [1.0, 2.0, 8.0], [0.0, 3.0, 9.0]]
        """
        window = CatFrames(N=self.N + 1, dim=-1, in_keys=["action"], out_keys=["actions"], padding="constant")
        rows = cast(TensorDictBase, data.select("action", ("next", "done")).refine_names("time"))
        actions = window.unfolding(rows)["actions"]  # those of a row and of the N rows before it
        width = actions.shape[-1] - data["action"].shape[-1]
        shown = data.copy()
        shown["observation"] = torch.cat([actions[:, :width], data["observation"]], -1)
        following = cast(TensorDictBase, data["next"]).copy()
        shown["next"] = following.set("observation", torch.cat([actions[:, -width:], following["observation"]], -1))
        return shown

    @property
    def _action_dim(self) -> int:
        if self.parent is None:
            raise RuntimeError("ActionHistory belongs in a TransformedEnv; unfolding() adds it to recorded transitions")
        return self.parent.action_spec.shape[-1]
