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
    rows = torch.stack([before[:, columns], after[:, columns]], 1).reshape(-1, 4)
    valid = rows.square().sum(-1) > 0.0  # a tracker that has lost the body may write zeros
    last = torch.where(valid, torch.arange(len(rows)), 0).cummax(0).values
    known = rows[last]
    same = torch.where((known[1:] * known[:-1]).sum(-1) < 0.0, -1.0, 1.0).to(rows.dtype)
    sign = torch.cat([torch.ones_like(same[:1]), same]).cumprod(0) if len(same) else torch.ones_like(rows[:, 0])
    before[:, columns] *= sign[0::2, None]
    after[:, columns] *= sign[1::2, None]
    changed, following = td.clone(recurse=False), cast("TensorDictBase", td["next"]).clone(recurse=False)
    following["observation"] = after
    changed["observation"], changed["next"] = before, following
    return changed
