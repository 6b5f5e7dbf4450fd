"""Checks of transitions where they enter a replay buffer: once per transition, so that updates need not check values.

A single NaN in a reward or an observation would spread to all networks, many updates later.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase

_FLAGS = ("done", "terminated", "truncated")
_ROWS = 2**18  # rows looked at together, because mapped data may be larger than the memory


class UnstableSimulatorError(ValueError):
    """A simulator produced NaN or infinite numbers."""


def select_entries(td: TensorDictBase, keys: Sequence[NestedKey], stream: str) -> TensorDictBase:
    """Select entries of transitions.

    Args:
        td: transitions.
        keys: the entries.
        stream: ``"real"`` or ``"simulated"``, for the message.

    Raises:
        ValueError: if an entry is missing.
    """
    present = set(td.keys(True, True))
    for key in keys:
        if key not in present:
            raise ValueError(
                f"the {stream} data lack {key!r}, they have {sorted(present, key=str)}; record "
                "it (for a log, give reward=), or choose other keys="
            )
    return td.select(*keys)


def require_usable_real(rows: TensorDictBase, keys: Sequence[NestedKey]) -> None:
    """Check that real transitions have boolean flags and finite numbers.

    Args:
        rows: transitions, ``[T]``.
        keys: the entries to check.

    Raises:
        ValueError: with the entry and the number of rows.
    """
    for key in keys:
        value = cast(torch.Tensor, rows.get(key))
        _require_flag(value, key, "real")
        bad = sum(_not_finite(part, 1) for part in value.split(_ROWS))
        if bad:
            raise ValueError(
                f"{key!r} of the real data is NaN or infinite in {bad} of {len(rows)} rows; remove these rows, and "
                "mark the row before each of them as the end of an episode"
            )


def require_usable_simulated(rows: TensorDictBase, keys: Sequence[NestedKey], like: Sequence[torch.Tensor]) -> None:
    """Check that simulated transitions have the shapes of the real data, boolean flags and finite numbers.

    Numbers beyond the range of the real data's dtype count as infinite, because they are converted to it.

    Args:
        rows: transitions, ``[*B]``.
        keys: the entries to check.
        like: the same entries of the real data, ``[T, ...]`` each.

    Raises:
        ValueError: if the shape of a row differs from that of the real data, or a flag is not boolean.
        UnstableSimulatorError: for NaN or infinite numbers, with the entry and the number of rows.
    """
    for key, real in zip(keys, like, strict=True):
        value = cast(torch.Tensor, rows.get(key))
        if value.shape[rows.ndim :] != real.shape[1:]:
            raise ValueError(
                f"{key!r} has the shape {list(value.shape[rows.ndim :])} in the simulated data and "
                f"{list(real.shape[1:])} in the real data; simulator and data must be of the same task"
            )
        _require_flag(value, key, "simulated")
        if bad := _not_finite(value.detach().to(real.dtype), rows.ndim):
            raise UnstableSimulatorError(
                f"the simulator produced a {key!r} that is NaN or infinite in {bad} of {rows.numel()} rows, and no row "
                "was added; MuJoCo names the cause in MUJOCO_LOG.TXT: shorten the simulator's time step, weaken its "
                "gap, or end an episode before its state diverges"
            )


def _require_flag(value: torch.Tensor, key: NestedKey, stream: str) -> None:
    if (key if isinstance(key, str) else key[-1]) in _FLAGS and value.dtype != torch.bool:
        raise ValueError(
            f"{key!r} of the {stream} data is {value.dtype}, expected torch.bool: convert it with .bool() after "
            "checking that every value is 0 or 1"
        )


def _not_finite(value: torch.Tensor, batch_dims: int) -> int:
    """Number of rows with a number that is NaN or infinite."""
    if not value.is_floating_point():
        return 0
    finite = value.isfinite()
    if finite.all():
        return 0
    return int((~finite.reshape(*value.shape[:batch_dims], -1).all(-1)).sum())
