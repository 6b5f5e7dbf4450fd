"""The one form that every reader returns, TorchRL's TED as a flat TensorDict, and its checks.

Row t is a transition; ``next`` of an episode's last row is that episode's own final observation.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_h2o.data.readers.error import DataError, require_finite

_REQUIRED_KEYS = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "done"),
    ("next", "terminated"),
)
_FLAGS = ("done", "terminated", "truncated")


def to_ted(
    *,
    observation: np.ndarray,
    action: np.ndarray,
    next_observation: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    reward: np.ndarray | None = None,
) -> TensorDict:
    """Put arrays of T transitions into one flat TED TensorDict.

    An episode that the end of the data cuts is marked truncated.

    Args:
        observation: shape (T, n), the state before the action.
        action: shape (T, m).
        next_observation: shape (T, n), the state after it.
        terminated: shape (T,), bool: the task ended here, nothing follows.
        truncated: shape (T,), bool: the recording ended here, more would have followed.
        reward: shape (T,); without it the result has no ("next", "reward").

    Returns:
        TensorDict of batch size [T]: float32 ``observation``, ``action`` and their ``next``; bool
        flags and float32 reward of shape [T, 1].

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data.readers.ted import to_ted
        >>> states = np.arange(4.0)[:, None]
        >>> td = to_ted(observation=states[:-1], action=np.zeros((3, 1)),
        ...             next_observation=states[1:], terminated=np.zeros(3, bool),
        ...             truncated=np.zeros(3, bool), reward=np.ones(3))
        >>> td["next", "truncated"].flatten().tolist()
        [False, False, True]
    """

    def floats(values: np.ndarray) -> torch.Tensor:
        # a copy: the caller's array must not change with the result
        return torch.from_numpy(np.array(values, dtype=np.float32))

    ends = {"terminated": np.array(terminated, bool), "truncated": np.array(truncated, bool)}
    ends["truncated"][-1] |= not ends["terminated"][-1]
    ends["done"] = ends["terminated"] | ends["truncated"]
    flags = {name: torch.from_numpy(ends[name])[:, None] for name in _FLAGS}
    following = {"observation": floats(next_observation), **flags}
    if reward is not None:
        following["reward"] = floats(reward).reshape(-1, 1)
    steps = len(observation)
    return TensorDict(
        {
            "observation": floats(observation),
            "action": floats(action),
            # TED: no state from which a step is taken is itself an end
            **{name: torch.zeros_like(flag) for name, flag in flags.items()},
            "next": TensorDict(following, batch_size=[steps]),
        },
        batch_size=[steps],
    )


def episodes(td: TensorDictBase) -> Iterator[TensorDictBase]:
    """Cut a flat TED TensorDict behind every ("next", "done"); the views share its memory.

    Args:
        td: batch size [T].

    Yields:
        one TensorDict an episode; a last one without an end is yielded too.
    """
    ends = (td["next", "done"].flatten().nonzero().flatten() + 1).tolist()
    if not ends or ends[-1] != len(td):
        ends.append(len(td))
    start = 0
    for stop in ends:
        yield td[start:stop]
        start = stop


def require_ted(td: TensorDictBase, *, source: str | Path = "transitions") -> None:
    """Check keys, shapes, flags and finite values of a flat TED TensorDict.

    Args:
        td: what to check, batch size [T].
        source: what to call it in errors.

    Raises:
        DataError: naming the key as column, and the row.
    """
    keys = set(td.keys(True, True))
    for key in _REQUIRED_KEYS:
        if key not in keys:
            raise DataError("the entry is missing", "record it", source=source, column=entry_name(key))
    if td.ndim != 1 or not len(td):
        raise DataError(
            f"the batch size is {list(td.batch_size)}, expected [T] with T of at least 1",
            "reshape(-1) complete episodes that end in done, or record something",
            source=source,
        )
    _require_shapes(td, keys, source)
    _require_flags(td, source)
    for key in sorted(keys, key=str):
        if td.get(key).is_floating_point():
            values = td.get(key).reshape(len(td), -1).numpy()
            names = [f"{entry_name(key)}[{i}]" for i in range(values.shape[1])]
            require_finite(values, names, source=source)


def require_continuous(td: TensorDictBase, *, source: str | Path = "transitions") -> None:
    """Check that inside an episode every observation is the one that the row before led to.

    Args:
        td: flat TED transitions of batch size [T], cut at ("next", "done").
        source: what to call them in errors.

    Raises:
        DataError: at the first row that begins elsewhere, counted from 1.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.data.readers.ted import require_continuous
        >>> td = GymEnv("Pendulum-v1").rollout(4)
        >>> require_continuous(td)
        >>> require_continuous(td[[0, 1, 3]])
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: transitions, column 'observation', row 3: the observation
        is not the next observation of the row before; ...
    """
    inside = ~td["next", "done"][:-1].flatten()
    same = (td["next", "observation"][:-1] == td["observation"][1:]).flatten(1).all(-1)
    jumps = (inside & ~same).nonzero().flatten()
    if len(jumps):
        raise DataError(
            "the observation is not the next observation of the row before",
            "mark the row before as done and truncated if another episode begins here",
            source=source,
            column="observation",
            row=int(jumps[0]) + 2,
        )


def _require_shapes(td: TensorDictBase, keys: set, source: str | Path) -> None:
    for key in [("next", "reward"), *_FLAGS, *(("next", flag) for flag in _FLAGS)]:
        if key in keys and td.get(key).shape != (len(td), 1):
            raise DataError(
                f"the shape is {list(td.get(key).shape)}, expected {[len(td), 1]}",
                "add the last dimension",
                source=source,
                column=entry_name(key),
            )
    for key in ("observation", "action"):
        if td.get(key).ndim != 2:
            raise DataError(
                f"the shape is {list(td.get(key).shape)}, expected [{len(td)}, n]",
                "flatten what belongs to one step into one vector, of length 1 at least",
                source=source,
                column=key,
            )
    if td["observation"].shape != td["next", "observation"].shape:
        raise DataError(
            f"shape {list(td['next', 'observation'].shape)}, observation has {list(td['observation'].shape)}",
            "both must be of one kind",
            source=source,
            column="next.observation",
        )
    for key in ("observation", ("next", "observation")):
        if not td.get(key).is_floating_point():
            raise DataError(
                f"the dtype is {td.get(key).dtype}",
                "observations must be real numbers: turn them with .float(), or encode them one-hot",
                source=source,
                column=entry_name(key),
            )


def _require_flags(td: TensorDictBase, source: str | Path) -> None:
    for prefix in ((), ("next",)):
        inner = td.get("next") if prefix else td
        flags = {name: inner.get(name) for name in _FLAGS if name in inner.keys()}
        for name, values in flags.items():
            if values.dtype != torch.bool:
                raise DataError(
                    f"the dtype is {values.dtype}, expected torch.bool",
                    "turn the flags with .bool()",
                    source=source,
                    column=entry_name((*prefix, name)),
                )
        done = flags.get("done")
        for name in ("terminated", "truncated"):
            if done is None or name not in flags:
                continue
            loose = (flags[name] & ~done).flatten().nonzero().flatten()
            if len(loose):
                raise DataError(
                    f"{name} holds and done does not",
                    "done must hold wherever terminated or truncated does: set done = terminated | truncated",
                    source=source,
                    column=entry_name((*prefix, "done")),
                    row=int(loose[0]) + 1,
                )


def entry_name(key: str | tuple) -> str:
    """Write a nested key as errors name it: ``("next", "done")`` as ``next.done``."""
    return key if isinstance(key, str) else ".".join(key)
