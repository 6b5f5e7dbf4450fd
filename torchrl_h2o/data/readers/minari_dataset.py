"""Read Minari datasets into TED, and write recordings as Minari datasets.

Files are read through ``minari`` itself, because ``MinariExperienceReplay(..., load_from_local_minari=True)`` of
torchrl 0.14.1 returns zeros for these files without an error.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from tensordict import TensorDict, TensorDictBase

from torchrl_h2o.data.readers.error import DataError, require_finite, require_flags, require_real, unreadable
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.own_data import own_arrays
from torchrl_h2o.data.readers.specs import check_specs, warn_of_unknown_task
from torchrl_h2o.data.readers.ted import episodes, require_continuous, require_ted, to_ted
from torchrl_h2o.data.readers.whole_folder import whole_folder

if TYPE_CHECKING:  # imported where they are used, because the replay buffer does not need them
    from gymnasium.envs.registration import EnvSpec
    from minari import MinariDataset
    from torchrl.envs import EnvBase

_FIELDS = ("observations", "actions", "rewards", "terminations", "truncations")
_MAIN_FILE = "main_data.hdf5"
_FLAGS = ("terminations", "truncations")


def read_minari(source: str | Path, *, task: str | None = None) -> TensorDict:
    """Read a Minari dataset by its folder or by its name.

    A name such as ``"halfcheetah/medium-v0"`` is looked up in ``MINARI_DATASETS_PATH`` and downloaded if missing. A
    folder is never downloaded.

    Args:
        source: a dataset's folder, which contains ``data/``, or its name.
        task: a Gymnasium id. Data of another task are rejected; the version may differ. For data that do not name
            their task, a warning is logged.

    Returns:
        TensorDict of batch size [T] in TED.

    Raises:
        DataError: for an unknown name, truncated files, an episode with arrays of inconsistent shapes, NaN or infinity
            (the column is the path inside the HDF5 file, the row is counted from 1 within its episode), complex
            numbers, flags other than 0 and 1, values that are in another file or nowhere, or spaces other than flat
            boxes.

    Example:
        >>> import tempfile
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.data import read_minari, write_minari
        >>> recorded = GymEnv("Pendulum-v1").rollout(200)
        >>> folder = write_minari(recorded, "pendulum/random-v0", root=tempfile.mkdtemp())
        >>> read_minari(folder)["action"].shape
        torch.Size([200, 1])
    """
    dataset = _open(source)
    _require_task(dataset, task, source)
    parts = _read_episodes(dataset, source)
    lengths = [len(rewards) for rewards in parts["rewards"]]
    if sum(lengths) != dataset.total_steps or not lengths:
        raise DataError(
            f"the metadata state {dataset.total_steps} steps, the file contains {sum(lengths)}",
            "the dataset is empty or truncated: copy or download it again",
            source=source,
        )
    for field in ("observations", "actions", "rewards"):
        for number, values in enumerate(parts[field]):
            values = values.reshape(len(values), -1)
            path = f"episode_{number}/{field}"
            names = [f"{path}[{i}]" for i in range(values.shape[1])]
            require_finite(values, names, source=source)
    truncated, terminated = np.concatenate(parts["truncations"]), np.concatenate(parts["terminations"])
    # Minari allows episodes that end without either flag; they are marked truncated
    last = np.cumsum(lengths) - 1
    truncated[last] |= ~terminated[last]
    return to_ted(
        observation=np.concatenate([values[:-1] for values in parts["observations"]]),
        next_observation=np.concatenate([values[1:] for values in parts["observations"]]),
        action=np.concatenate(parts["actions"]),
        reward=np.concatenate(parts["rewards"]),
        terminated=terminated,
        truncated=truncated,
    )


def write_minari(
    td: TensorDictBase,
    dataset_id: str,
    *,
    root: str | Path | None = None,
    env: EnvBase | None = None,
    env_spec: EnvSpec | None = None,
    author: str | None = None,
    algorithm_name: str | None = None,
    description: str | None = None,
) -> Path:
    """Write a recording as a Minari dataset, atomically.

    Args:
        td: flat TED transitions of batch size [T] with rewards, with episodes ending at ("next", "done").
        dataset_id: ``"(namespace/)name-v0"``.
        root: the folder of datasets; by default Minari's own (``MINARI_DATASETS_PATH``).
        env: an environment that provides the bounds of the action space; the data are checked against it. Without it
            the spaces are unbounded.
        env_spec: Gymnasium's spec of the task, which ``recover_environment`` needs.
        author, algorithm_name, description: Minari's metadata.

    Returns:
        The dataset's folder.

    Raises:
        DataError: if the dataset exists, the name is not valid, or an observation within an episode differs from
            the next observation of the row before.

    Example:
        See :func:`read_minari`.
    """
    from minari import __version__
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage import get_dataset_path

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError) as error:  # TypeError, because minari calls int(None) for a name without a version
        raise DataError(
            "this is not a valid Minari name",
            "use name-v0 or namespace/name-v0, each of at least two letters, digits, _ or -",
            source=dataset_id,
        ) from error
    # absolute, because minari's writer changes the meaning of a relative folder
    folder = (get_dataset_path() if root is None else Path(root).expanduser().absolute()) / dataset_id
    _require_recordable(td, source=dataset_id)
    if env is not None:
        check_specs(td, env, source=dataset_id)
    make_buffer = cast("Any", EpisodeBuffer)  # annotated for lists; it takes arrays as well
    buffers = [
        make_buffer(
            observations=np.concatenate([_array(episode["observation"]), _array(episode["next", "observation"][-1:])]),
            actions=_array(episode["action"]),
            rewards=_array(episode["next", "reward"]).flatten(),
            terminations=_array(episode["next", "terminated"]).flatten(),
            truncations=_truncations(episode),
        )
        for episode in episodes(td)
    ]
    metadata = {
        "dataset_id": dataset_id,
        "minari_version": __version__,
        "algorithm_name": algorithm_name,
        "description": description,
        "author": None if author is None else {author},
    }
    observation_space, action_space = _spaces(td, env)
    with whole_folder(folder) as partial:
        storage = MinariStorage.new(
            partial / "data",
            observation_space=observation_space,
            action_space=action_space,
            env_spec=env_spec,
        )
        storage.update_metadata({key: value for key, value in metadata.items() if value})
        storage.update_episodes(buffers)
    return folder


def _open(source: str | Path) -> MinariDataset:
    import minari

    folder = Path(source).expanduser()
    data = folder if (folder / "metadata.json").is_file() else folder / "data"
    for name in ("metadata.json", _MAIN_FILE):
        if (data / name).exists():
            require_file(data / name)
    remedy = "give the folder that contains data/metadata.json, or a name in MINARI_DATASETS_PATH or to download"
    with unreadable("no Minari dataset can be opened", remedy, source=source):
        if data.is_dir():
            _require_plausible_count(data)
        dataset = minari.MinariDataset(data) if data.is_dir() else minari.load_dataset(str(source), download=True)
        _ = int(dataset.total_steps), dataset.spec  # minari checks these entries when they are asked for
        return dataset


def _require_plausible_count(data: Path) -> None:
    """Raise DataError if the metadata state more episodes than the file has bytes: minari makes a list of them."""
    metadata, main = data / "metadata.json", data / _MAIN_FILE
    stated = json.loads(metadata.read_text(encoding="utf-8")).get("total_episodes")
    if main.is_file() and not 0 <= stated <= main.stat().st_size:
        raise DataError(
            f"it states {stated} episodes, but the file of the data has {main.stat().st_size} bytes",
            "the dataset is damaged: copy or download it again",
            source=metadata,
        )


def _require_task(dataset: MinariDataset, task: str | None, source: str | Path) -> None:
    # dimensions do not identify a task: HalfCheetah and Walker2d both have 17 and 6
    spec = dataset.spec.env_spec
    if spec is None:
        warn_of_unknown_task(task, source)
    elif task is not None and spec.id.rpartition("-v")[0] != task.rpartition("-v")[0]:
        raise DataError(f"it was recorded in {spec.id}, not in {task}", "choose data of the same task", source=source)


def _read_episodes(dataset: MinariDataset, source: str | Path) -> dict[str, list[np.ndarray]]:
    from gymnasium.spaces import Box
    from tqdm import tqdm

    for name, space in (("observations", dataset.observation_space), ("actions", dataset.action_space)):
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise DataError(
                f"the space is {space}",
                "only flat vectors of real numbers are supported: flatten them and write the dataset again",
                source=source,
                column=name,
            )
    main = dataset.storage.data_path / _MAIN_FILE
    remedy = "the file is truncated or of another format: copy or download it again"
    if main.exists():  # absent from a dataset in Arrow's format
        import h5py

        with unreadable("the file cannot be read as HDF5", remedy, source=main), h5py.File(main, "r") as file:
            own_arrays(file, list(file), source=main)
    parts = {field: [] for field in _FIELDS}
    sizes = {"observations": dataset.observation_space.shape, "actions": dataset.action_space.shape}
    read = iter(dataset.iterate_episodes())
    for number in tqdm(range(dataset.total_episodes), desc=str(source), delay=5):
        with unreadable(f"episode {number} cannot be read", remedy, source=source):
            episode = next(read)
            steps = len(episode.rewards)
        for field in _FIELDS:
            values = getattr(episode, field)
            shape = (steps + (field == "observations"), *sizes.get(field, ()))
            place = {"column": f"episode_{number}/{field}", "source": source}
            if values.shape != shape:
                raise DataError(
                    f"the shape is {list(values.shape)}, expected {list(shape)}",
                    "the episode is truncated or does not match its space: write it again",
                    **place,
                )
            require_real(values, **place)
            parts[field].append(require_flags(values, **place) if field in _FLAGS else values)
    return parts


def _require_recordable(td: TensorDictBase, source: str) -> None:
    require_ted(td, source=source)
    if ("next", "reward") not in td.keys(True):
        raise DataError("the entry is missing", "Minari requires it", source=source, column="next.reward")
    # an episode is stored as one array of observations, which cannot represent a jump
    require_continuous(td, source=source)


def _truncations(episode: TensorDictBase) -> np.ndarray:
    truncated = _array(episode["next", "done"] & ~episode["next", "terminated"]).flatten()
    if ("next", "truncated") in episode.keys(True):
        truncated = _array(episode["next", "truncated"]).flatten()
    truncated[-1] |= not bool(episode["next", "terminated"][-1])
    return truncated


def _spaces(td: TensorDictBase, env: EnvBase | None) -> tuple:
    from gymnasium.spaces import Box

    low, high = -np.inf, np.inf
    if env is not None:
        space = cast("Any", env.action_spec_unbatched.space)
        low, high = _array(space.low).astype(np.float32), _array(space.high).astype(np.float32)
    return (
        Box(-np.inf, np.inf, td["observation"].shape[1:], np.float32),
        Box(low, high, td["action"].shape[1:], np.float32),
    )


def _array(tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()
