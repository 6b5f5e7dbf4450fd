"""Read a D4RL HDF5 file (``halfcheetah_medium-v2.hdf5`` and the like) into TED."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError, require_finite, require_flags, require_real, unreadable
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.own_data import own_arrays
from torchrl_h2o.data.readers.ted import to_ted

_DIMENSIONS = {"observations": 2, "actions": 2, "rewards": 1, "terminals": 1, "timeouts": 1, "next_observations": 2}
_FLAGS = ("terminals", "timeouts")


def read_d4rl(path: str | Path) -> TensorDict:
    """Read a D4RL file.

    In a file with ``next_observations`` every row is a transition. A row whose next observation differs from the
    following row, although neither flag is set, is marked truncated; the number of these rows is logged. Such a file
    needs no ``timeouts``.

    In a file without ``next_observations`` the next observation is the observation of the following row. The last row
    of an episode then has no next observation and is dropped; the row before it becomes the end of the episode, marked
    truncated. The number of dropped rows is logged. The reward of a dropped terminal row is lost, so prefer files with
    ``next_observations`` (D4RL's MuJoCo files from v1 on) for tasks that terminate.

    Args:
        path: an HDF5 file with observations, actions, rewards, terminals, and timeouts or next_observations. Rewards,
            terminals and timeouts have the shape (N,) or (N, 1).

    Returns:
        TensorDict of batch size [T] in TED.

    Raises:
        DataError: for a file that is missing, empty, truncated or a pickle; a missing array, arrays of different
            lengths, NaN or infinity, complex numbers, a flag other than 0 and 1, or an array whose values are in
            another file or nowhere. Rows in the message are counted from 1.

    Example:
        >>> import h5py, numpy as np, tempfile
        >>> from torchrl_h2o.data import read_d4rl
        >>> path = tempfile.mkdtemp() + "/task.hdf5"
        >>> with h5py.File(path, "w") as file:
        ...     for name in ("observations", "next_observations", "actions"):
        ...         file[name] = np.zeros((4, 2), np.float32)
        ...     for name in ("rewards", "terminals", "timeouts"):
        ...         file[name] = np.zeros(4)
        >>> read_d4rl(path).batch_size
        torch.Size([4])

    Source: Fu et al., "D4RL: Datasets for Deep Data-Driven Reinforcement Learning" (2020), arXiv 2004.07219.
    """
    path = require_file(path)
    arrays = _read_arrays(path)
    steps = len(arrays["observations"])
    for name, values in arrays.items():
        if len(values) != steps or not steps:
            raise DataError(
                f"it has {len(values)} rows, observations has {steps}",
                "the file is empty or truncated: copy or download it again",
                source=path,
                column=name,
            )
        if name in _FLAGS:
            continue
        columns = values.reshape(steps, -1)
        names = [name] if values.ndim == 1 else [f"{name}[{i}]" for i in range(columns.shape[1])]
        require_finite(columns, names, source=path)
    for name in _FLAGS:
        arrays[name] = require_flags(arrays[name], name, source=path)
    if "next_observations" in arrays:
        rows, following = slice(None), arrays["next_observations"]
        if following.shape != arrays["observations"].shape:
            raise DataError(
                f"the shape is {list(following.shape)}, observations has {list(arrays['observations'].shape)}",
                "they must have the same shape",
                source=path,
                column="next_observations",
            )
        terminated, truncated = arrays["terminals"], _truncated_at_jumps(arrays, path)
    else:
        rows, following, terminated, truncated = _link_rows(arrays, path)
    return to_ted(
        observation=arrays["observations"][rows],
        action=arrays["actions"][rows],
        reward=arrays["rewards"][rows],
        next_observation=following,
        terminated=terminated,
        truncated=truncated,
    )


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    import h5py  # imported here, because the replay buffer does not need it

    remedy = "the file is truncated or of another format: copy or download it again"
    with unreadable("the file cannot be read as HDF5", remedy, source=path), h5py.File(path, "r") as file:
        names = [name for name in _DIMENSIONS if name in file]
        given = "timeouts or next_observations"
        required = [name for name in _DIMENSIONS if name not in ("timeouts", "next_observations")]
        missing = [name for name in required if name not in file]
        if "timeouts" not in file and "next_observations" not in file:
            missing.append(given)
        if missing:
            raise DataError(
                f"the file has no {', '.join(missing)}; it has {', '.join(file)}",
                f"a D4RL file contains {', '.join(required)}, and {given}",
                source=path,
                column=missing[0],
            )
        arrays = {name: np.asarray(array) for name, array in own_arrays(file, names, source=path).items()}
    arrays.setdefault("timeouts", np.zeros(len(arrays["terminals"]), bool))
    for name, values in arrays.items():
        if _DIMENSIONS[name] == 1 and values.ndim == 2 and values.shape[1] == 1:
            arrays[name] = values = values[:, 0]
        require_real(values, name, source=path)
        if values.ndim != _DIMENSIONS[name]:
            raise DataError(
                f"it has {values.ndim} dimensions",
                f"expected {_DIMENSIONS[name]} dimensions",
                source=path,
                column=name,
            )
    return arrays


def _truncated_at_jumps(arrays: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Return the timeouts, extended by rows whose next observation differs from the following row."""
    led, found = (
        arrays[name][rows].astype(np.float32)
        for name, rows in (("next_observations", slice(-1)), ("observations", slice(1, None)))
    )
    jumps = np.append((led != found).any(1), False) & ~arrays["terminals"] & ~arrays["timeouts"]
    if jumps.any():
        torchrl_logger.warning(
            f"{path}: {jumps.sum()} of {len(jumps)} rows are marked truncated, because their next observation "
            "differs from the following row"
        )
    return arrays["timeouts"] | jumps


def _link_rows(arrays: dict[str, np.ndarray], path: Path) -> tuple:
    """Return the rows with a known next observation, that observation, and both flags."""
    ends = arrays["terminals"] | arrays["timeouts"]
    ends[-1] = True
    rows = np.flatnonzero(~ends)
    if not len(rows):
        raise DataError(
            "no row has a successor in its own episode",
            "a file without next_observations needs episodes of at least two rows",
            source=path,
            column="observations",
        )
    torchrl_logger.info(f"{path}: {ends.sum()} of {len(ends)} rows dropped, last of their episode")
    # the row before a dropped end becomes the last one of its episode
    return rows, arrays["observations"][rows + 1], np.zeros(len(rows), bool), ends[rows + 1]
