"""TorchRL's episode data format (TED) as a flat TensorDict, which every reader returns, and its checks.

Row t is a transition; ``next`` of the last row of an episode is the final observation of that episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn, cast

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
    """Build a flat TED TensorDict from arrays of T transitions.

    An unfinished last episode is marked truncated.

    Args:
        observation: observations before the actions, (T, n).
        action: actions, (T, m).
        next_observation: observations after the actions, (T, n).
        terminated: whether the task ended at this transition, (T,), bool.
        truncated: whether the episode was cut off at this transition, (T,), bool.
        reward: rewards, (T,); without them the result has no ("next", "reward").

    Returns:
        TensorDict of batch size [T] with float32 ``observation``, ``action`` and ("next", "observation"), and bool
        flags and float32 rewards of shape [T, 1].

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
        # a copy, so that the result does not share memory with the caller's array
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
            # in TED, a state from which a step is taken is never done
            **{name: torch.zeros_like(flag) for name, flag in flags.items()},
            "next": TensorDict(following, batch_size=[steps]),
        },
        batch_size=[steps],
    )


def episodes(td: TensorDictBase) -> Iterator[TensorDictBase]:
    """Split a flat TED TensorDict after every ("next", "done") into views that share its memory.

    Args:
        td: transitions of batch size [T].

    Yields:
        One TensorDict per episode, including an unfinished last one.
    """
    ends = (cast("torch.Tensor", td["next", "done"]).flatten().nonzero().flatten() + 1).tolist()
    if not ends or ends[-1] != len(td):
        ends.append(len(td))
    start = 0
    for stop in ends:
        yield td[start:stop]
        start = stop


def require_ted(td: TensorDictBase, *, source: str | Path = "transitions") -> None:
    """Check the keys, shapes, flags and values of a flat TED TensorDict.

    Args:
        td: transitions of batch size [T].
        source: name of the data in errors.

    Raises:
        DataError: with the key as column, and the row.
    """
    keys = set(td.keys(True, True))
    for key in _REQUIRED_KEYS:
        if key not in keys:
            raise DataError("the entry is missing", "record it", source=source, column=entry_name(key))
    if td.ndim != 1 or not len(td):
        raise DataError(
            f"the batch size is {list(td.batch_size)}, expected [T] with T of at least 1",
            "use reshape(-1) on complete episodes that end in done, or record more data",
            source=source,
        )
    _require_shapes(td, keys, source)
    _require_flags(td, source)
    for key in sorted(keys, key=str):
        if td.get(key).is_complex():
            problem = f"the dtype is {td.get(key).dtype}"
            raise DataError(problem, "write real numbers", source=source, column=entry_name(key))
        if td.get(key).is_floating_point():
            values = td.get(key).numpy().reshape(len(td), math.prod(td.get(key).shape[1:]))
            names = [f"{entry_name(key)}[{i}]" for i in range(values.shape[1])]
            require_finite(values, names, source=source)


def require_continuous(td: TensorDictBase, *, source: str | Path = "transitions") -> None:
    """Check that within an episode every observation equals the next observation of the row before.

    Args:
        td: flat TED transitions of batch size [T], with episodes ending at ("next", "done").
        source: name of the data in errors.

    Raises:
        DataError: at the first row that violates this, counted from 1.

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
    inside = ~cast("torch.Tensor", td["next", "done"])[:-1].flatten()
    following, observation = cast("torch.Tensor", td["next", "observation"]), cast("torch.Tensor", td["observation"])
    same = (following[:-1] == observation[1:]).flatten(1).all(-1)
    jumps = (inside & ~same).nonzero().flatten()
    if len(jumps):
        raise DataError(
            "the observation is not the next observation of the row before",
            "mark the row before as done and truncated if a new episode begins here",
            source=source,
            column="observation",
            row=int(jumps[0]) + 2,
        )


def _require_shapes(td: TensorDictBase, keys: set, source: str | Path) -> None:
    def refuse(key: str | tuple, problem: str, remedy: str) -> NoReturn:
        raise DataError(problem, remedy, source=source, column=entry_name(key))

    for key in [("next", "reward"), *_FLAGS, *(("next", flag) for flag in _FLAGS)]:
        if key in keys and td.get(key).shape != (len(td), 1):
            refuse(key, f"the shape is {list(td.get(key).shape)}, expected {[len(td), 1]}", "add the last dimension")
    for key in ("observation", "action"):
        if td.get(key).ndim != 2:
            remedy = "flatten the values of one step into one vector of at least one entry"
            refuse(key, f"the shape is {list(td.get(key).shape)}, expected [{len(td)}, n]", remedy)
    shape, following = td["observation"].shape, td["next", "observation"].shape
    if shape != following:
        problem = f"shape {list(following)}, observation has {list(shape)}"
        refuse(("next", "observation"), problem, "both must have the same shape")
    for key in ("observation", ("next", "observation")):
        if not td.get(key).is_floating_point():
            remedy = "observations must be real numbers: convert them with .float(), or encode them one-hot"
            refuse(key, f"the dtype is {td.get(key).dtype}", remedy)


def _require_flags(td: TensorDictBase, source: str | Path) -> None:
    for prefix in ((), ("next",)):
        inner = td.get("next") if prefix else td
        flags = {name: inner.get(name) for name in _FLAGS if name in inner.keys()}
        for name, values in flags.items():
            if values.dtype != torch.bool:
                problem, place = f"the dtype is {values.dtype}, expected torch.bool", entry_name((*prefix, name))
                raise DataError(problem, "convert the flags with .bool()", source=source, column=place)
        for name in ("terminated", "truncated"):
            if "done" not in flags or name not in flags:
                continue
            loose = (flags[name] & ~flags["done"]).flatten().nonzero().flatten()
            if len(loose):
                raise DataError(
                    f"{name} is true but done is false",
                    "done must be true wherever terminated or truncated is: set done = terminated | truncated",
                    source=source,
                    column=entry_name((*prefix, "done")),
                    row=int(loose[0]) + 1,
                )


def entry_name(key: str | tuple) -> str:
    """Format a nested key for error messages: ``("next", "done")`` as ``next.done``."""
    return key if isinstance(key, str) else ".".join(key)
