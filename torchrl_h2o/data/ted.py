"""The one form that every reader returns, TorchRL's TED as a flat TensorDict, and its memory map.

Row t is a transition; ``next`` of an episode's last row is that episode's own final observation.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_h2o.data.error import DataError, require_finite
from torchrl_h2o.data.memory_map import load_memory_map
from torchrl_h2o.data.whole_folder import whole_folder

_REQUIRED_KEYS = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "done"),
    ("next", "terminated"),
)
_FLAGS = ("done", "terminated", "truncated")
_FLOATS = ("observation", "action", ("next", "observation"), ("next", "reward"))


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
        >>> from torchrl_h2o.data.ted import to_ted
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
            raise DataError("the entry is missing", "record it", source=source, column=_name(key))
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
            names = [f"{_name(key)}[{i}]" for i in range(values.shape[1])]
            require_finite(values, names, source=source)


def _require_shapes(td: TensorDictBase, keys: set, source: str | Path) -> None:
    for key in [("next", "reward"), *_FLAGS, *(("next", flag) for flag in _FLAGS)]:
        if key in keys and td.get(key).shape != (len(td), 1):
            raise DataError(
                f"the shape is {list(td.get(key).shape)}, expected {[len(td), 1]}",
                "add the last dimension",
                source=source,
                column=_name(key),
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
                column=_name(key),
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
                    column=_name((*prefix, name)),
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
                    column=_name((*prefix, "done")),
                    row=int(loose[0]) + 1,
                )


def write_ted(td: TensorDictBase, folder: str | Path) -> Path:
    """Write a flat TED TensorDict as a memory map: one file an entry, no pickle, all or nothing.

    Args:
        td: batch size [T]; tensors only.
        folder: a folder that does not exist yet.

    Returns:
        the folder.

    Raises:
        DataError: the folder exists, or the TensorDict is not what :func:`read_ted` would take.

    Example:
        >>> import tempfile, torch
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.data import read_ted, write_ted
        >>> recorded = GymEnv("Pendulum-v1").rollout(10)
        >>> folder = write_ted(recorded, tempfile.mkdtemp() + "/pendulum")
        >>> td = read_ted(folder)
        >>> bool((td["observation"] == recorded["observation"]).all())
        True
    """
    require_ted(td, source=folder)
    for key in td.keys(True, True, is_leaf=lambda kind: not issubclass(kind, TensorDictBase)):
        if not isinstance(td.get(key), torch.Tensor):
            raise DataError(
                "the entry is not a tensor and would be pickled",
                "drop it with td.exclude(...)",
                source=folder,
                column=_name(key),
            )
    with whole_folder(folder) as partial:
        td.detach().contiguous().memmap(partial)
    return Path(folder)


def read_ted(folder: str | Path, *, in_memory: bool = True) -> TensorDict:
    """Read a flat TED TensorDict that :func:`write_ted` or ``TensorDict.memmap`` has written.

    Args:
        folder: the folder that holds ``meta.json``.
        in_memory: copy the data, and turn observation, action and reward to float32 (our own
            simulators record float64). Without it the tensors stay mapped to the files, for data
            larger than the memory, and must be float32 there; writing to them changes the files.

    Returns:
        TensorDict of batch size [T], with every entry that was written. A last episode without an
        end is marked truncated.

    Raises:
        DataError: a missing or cut-off file, a pickle, a missing entry, NaN or infinity, another
            dtype than float32 that is to stay mapped.
    """
    td = load_memory_map(folder)
    require_ted(td, source=folder)
    td = _as_float32(td.clone(recurse=in_memory), in_memory, folder)
    ends = td["next", "done"].clone()
    ends[-1] = True
    td["next", "done"] = ends
    td["next", "truncated"] = ends & ~td["next", "terminated"]
    return td


def _as_float32(td: TensorDict, in_memory: bool, folder: str | Path) -> TensorDict:
    for key in _FLOATS:
        values = td.get(key, None)
        # actions may be integers: those of a discrete task
        discrete = key == "action" and not values.is_floating_point()
        if values is None or values.dtype == torch.float32 or discrete:
            continue
        if not in_memory:
            raise DataError(
                f"the dtype is {values.dtype}, and mapped data are taken as they are: torch.float32",
                "read with in_memory=True, or write the data again as float32",
                source=folder,
                column=_name(key),
            )
        td[key] = values.float()
    return td


def _name(key: str | tuple) -> str:
    return key if isinstance(key, str) else ".".join(key)
