"""The sign of quaternions, which trackers choose anew now and then, made continuous as a simulator's is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDictBase


def continuous_quaternions(td: TensorDictBase, columns: Sequence[int]) -> TensorDictBase:
    """Reverses quaternions where that brings them nearer to the ones before; the rotations stay the same.

    Args:
        td: transitions (T,) in TED, in the order of their recording.
        columns: the four columns of the observation (T, n) that hold the quaternion.

    Returns:
        The transitions with other observations; the given ones are not changed.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.data.readers.quaternion_signs import continuous_quaternions
        >>> rows = torch.tensor([[1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
        >>> td = TensorDict({"observation": rows[:-1], "next": {"observation": rows[1:]}}, [2])
        >>> continuous_quaternions(td, [0, 1, 2, 3])["observation"][:, 0]
        tensor([1., 1.])
    """
    columns = list(columns)
    before = cast("torch.Tensor", td["observation"]).clone()
    after = cast("torch.Tensor", td["next", "observation"]).clone()
    within = _same_side(before[:, columns], after[:, columns])
    between = _same_side(after[:-1, columns], before[1:, columns])
    sign = torch.cumprod(torch.cat([torch.ones_like(within[:1]), within[:-1] * between]), dim=0)
    before[:, columns] *= sign[:, None]
    after[:, columns] *= (sign * within)[:, None]
    changed, following = td.clone(recurse=False), cast("TensorDictBase", td["next"]).clone(recurse=False)
    following["observation"] = after
    changed["observation"], changed["next"] = before, following
    return changed


def _same_side(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """1 where two quaternions (T, 4) are nearer to each other than to their opposites, else -1, (T,)."""
    return torch.where((one * other).sum(-1) < 0.0, -1.0, 1.0).to(one.dtype)
