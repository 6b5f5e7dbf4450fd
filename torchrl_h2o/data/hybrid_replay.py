"""A TorchRL replay buffer whose batches contain real and simulated transitions, marked by the entry ``real``.

It is TorchRL's buffer of the simulated transitions, with a second, fixed one for the real transitions; only writing
and sampling are its own. TorchRL's ``ReplayBufferEnsemble`` stacks equal shares into [2, B/2] and cannot write to a
single member; its ``OfflineToOnlineReplayBuffer`` does not mark the rows and has no checkpoint. Both take three to five
times as long per batch, because they first gather TensorDicts of views: here each entry is gathered once per stream,
directly from the storage.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torchrl.data import (
    ImmutableDatasetWriter,
    LazyMemmapStorage,
    LazyTensorStorage,
    RoundRobinWriter,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.data.replay_buffers import RandomSampler, Sampler
from torchrl.envs import Compose

from torchrl_h2o.data.multi_step import STEPS, OngoingMultiStep, multi_step_keys, original_key
from torchrl_h2o.data.readers.memory_map import load_memory_map, map_to_files
from torchrl_h2o.data.readers.whole_folder import whole_folder
from torchrl_h2o.data.transition_checks import require_usable_real, require_usable_simulated, select_entries

TRANSITION_KEYS: tuple[NestedKey, ...] = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


class HybridReplayBuffer(TensorDictReplayBuffer):
    """A replay buffer of fixed real data and a ring buffer of simulated data, sampled together.

    A TorchRL ``ReplayBuffer``, so collectors write to it and trainers sample from it. ``storage``, ``sampler``,
    ``writer``, ``empty()`` and ``buffer[index]`` are those of the simulated transitions. The forward calls of
    transforms (:meth:`append_transform`) alter sampled batches, their inverse calls the simulated transitions that come
    in; real data are stored as given.

    Uniform indices are drawn from torch's global generator of ``device``, so ``torch.manual_seed`` repeats them and a
    restored generator state continues them. Other samplers draw as TorchRL lets them.

    Args:
        real: flat TED transitions of batch size [T], in memory or memory-mapped; copied only if they are on another
            device.
        sim_capacity: largest number of simulated transitions; then the oldest are overwritten.
        batch_size: numbers of real and simulated rows in a batch.
        n_steps: n of n-step targets. With n > 1 both streams pass through TorchRL's ``MultiStepTransform``: the reward
            is the discounted sum of up to n rewards, the next state is that after these steps, and a batch also has
            ``steps_to_next_obs`` [real + simulated, 1] and the one-step next state ``("next",
            "original_observation")``. The sums stop where ``("next", "done")`` is true. Real data that have
            ``steps_to_next_obs`` are taken as n-step rows already.
        gamma: discount factor of the sums; the same as that of the losses.
        keys: the entries of a batch. Both streams must have them; other entries of the streams are ignored.
        device: device of the data and the batches.
        scratch_dir: folder for memory-mapped simulated data, for capacities beyond the memory.
        sim_memory: tensors of batch size [sim_capacity] that hold the simulated data; their initial values are
            ignored.
        sampler: TorchRL sampler of the simulated rows, such as ``PrioritizedSampler(sim_capacity, 0.7, 0.5)``; uniform
            by default. With a sampler for either stream, batches also have ``index``, the row in its own stream, and
            ``priority_weight``, 1 for rows that are drawn uniformly.
        real_sampler: TorchRL sampler of the real rows; uniform by default.
        priority_key: the entry that :meth:`update_tensordict_priority` reads.

    Raises:
        ValueError: if the real data lack an entry of ``keys``, have a flag that is not boolean, or numbers that are NaN
            or infinite; the message gives a remedy.

    Attributes:
        real: the buffer of the real transitions.
        stream_keys: the entries that :meth:`extend` reads, ``keys`` as given.
        keys: the entries of a batch apart from ``real``; with ``n_steps`` above 1, more than ``stream_keys``.
        next_observation: the entry of the one-step next state, which discriminators read: ``("next", "observation")``,
            or ``("next", "original_observation")`` if ``n_steps`` is above 1.

    Example:
        >>> import torch
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.data import HybridReplayBuffer
        >>> env = GymEnv("Pendulum-v1")
        >>> buffer = HybridReplayBuffer(env.rollout(50), sim_capacity=1000, batch_size=(4, 4))
        >>> _ = buffer.extend(env.rollout(20))
        >>> buffer.sample()["real"].tolist()
        [True, True, True, True, False, False, False, False]

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716: 𝒟 and B of Eq. (8), with 128 rows of each.
    """

    _storage: TensorStorage
    _transform: Compose

    def __init__(
        self,
        real: TensorDictBase,
        sim_capacity: int,
        batch_size: tuple[int, int] = (128, 128),
        *,
        n_steps: int = 1,
        gamma: float = 0.99,
        keys: Sequence[NestedKey] = TRANSITION_KEYS,
        device: torch.device | str = "cpu",
        scratch_dir: str | Path | None = None,
        sim_memory: TensorDictBase | None = None,
        sampler: Sampler | None = None,
        real_sampler: Sampler | None = None,
        priority_key: str = "td_error",
    ):
        if sim_capacity < 1:
            raise ValueError(f"sim_capacity is {sim_capacity}; it must be at least 1")
        if real.ndim != 1 or not len(real):
            raise ValueError(f"the real data have the batch size {list(real.batch_size)}, expected [T], T > 0")
        self._sizes = _require_sizes(batch_size)
        self.stream_keys = [unravel_key(key) for key in keys]
        self.device = torch.device(device)
        self._multi_step = OngoingMultiStep(n_steps, gamma) if n_steps > 1 else None
        self.keys, self.next_observation = self.stream_keys, ("next", "observation")
        if self._multi_step is not None:
            self.keys = multi_step_keys(self.stream_keys)
            self.next_observation = original_key(self.next_observation)
            real = (
                real if STEPS in real.keys() else self._multi_step.whole(select_entries(real, self.stream_keys, "real"))
            )
        real = select_entries(real, self.keys, "real").to(self.device)
        require_usable_real(real, self.keys)
        self.real = TensorDictReplayBuffer(
            storage=TensorStorage(real, device=self.device),
            sampler=real_sampler or RandomSampler(),
            writer=ImmutableDatasetWriter(),
            priority_key=priority_key,
        )
        if sim_memory is not None:
            storage = TensorStorage(sim_memory, device=self.device)
        elif scratch_dir is not None:
            storage = LazyMemmapStorage(sim_capacity, scratch_dir=scratch_dir, device=self.device)
        else:
            storage = LazyTensorStorage(sim_capacity, device=self.device)
        super().__init__(
            storage=storage,
            sampler=sampler or RandomSampler(),
            writer=RoundRobinWriter(),  # TensorDictReplayBuffer's own writer would store an entry ``index``
            batch_size=sum(self._sizes),
            priority_key=priority_key,
        )
        self._real_rows = [real.get(key) for key in self.keys]
        self.empty()

    def __len__(self) -> int:
        """Return the number of transitions of both streams."""
        return len(self.real) + self.num_sim

    @property
    def num_sim(self) -> int:
        """Number of simulated transitions."""
        return len(self._storage)  # pyright: ignore[reportArgumentType]  (Storage.__len__ has no type)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(real={len(self.real)}, sim={len(self._storage)} of {self._storage.max_size}, "
            f"batch_size={self._sizes})"
        )

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> torch.Tensor:
        """Add simulated transitions.

        Args:
            tensordicts: transitions of any batch size, such as a collector's [N, T]. With ``n_steps`` above 1, time is
                the last dimension and each call continues the N runs of the call before; a run that does not go on
                ends with ``("next", "done")``. The last n rows of each run then wait for the next call.
            update_priority: ignored; a prioritised sampler draws new rows with the largest priority so far.

        Returns:
            The places of the new rows in the storage, [rows].

        Raises:
            ValueError: if an entry is missing, its shape differs from that of the real data, or a flag is not boolean.
            UnstableSimulatorError: a ValueError, if the simulator produced NaN or infinite numbers; no row is added.
        """
        none = torch.zeros(0, dtype=torch.long)
        transitions = self._transform.inv(tensordicts) if len(self._transform) else tensordicts
        if transitions is None:
            return none
        rows = select_entries(transitions, self.stream_keys, "simulated")
        like = dict(zip(self.keys, self._real_rows, strict=True))
        # before the sums over n steps, which would spread a NaN and keep it for the next call
        require_usable_simulated(rows, self.stream_keys, [like[key] for key in self.stream_keys])
        if self._multi_step is not None:
            rows = self._multi_step.transform(rows)
            if rows is None:
                return none
        rows = rows.select(*self.keys).reshape(-1)
        for key, real in like.items():
            # converted to the dtype of the real data, because Gymnasium's observations are float64
            rows.set(key, rows.get(key).detach().to(real))
        return self._extend(rows)

    def add(self, data: TensorDictBase) -> torch.Tensor:
        """Add one simulated transition, without batch dimensions; see :meth:`extend`."""
        return self.extend(data.unsqueeze(0))

    def empty(self, empty_write_count: bool = True) -> None:
        """Remove all simulated transitions, also those that wait for their successors."""
        super().empty(empty_write_count)
        self._sim_rows: list[torch.Tensor] = []
        if self._multi_step is not None:
            self._multi_step.waiting = None

    def sample(
        self,
        batch_size: int | tuple[int, int] | None = None,
        return_info: bool = False,
        generator: torch.Generator | None = None,
    ) -> Any:
        """Draw real and simulated rows, by default each uniformly with replacement.

        Args:
            batch_size: numbers of real and simulated rows, instead of the buffer's own; or their sum, which is split in
                the same proportion. (n, 0) draws real rows only and works without simulated data.
            return_info: whether to also return a dictionary of the entries that samplers add.
            generator: random generator of uniform draws, instead of torch's global one.

        Returns:
            TensorDict of batch size [real + simulated] with the buffer's entries and ``real``, a boolean of shape
            [real + simulated]; the real rows come first.

        Raises:
            RuntimeError: if simulated rows are requested and there are none.
        """
        n_real, n_sim = self._share(batch_size)
        if n_sim and not len(self._storage):
            raise RuntimeError(
                "there are no simulated transitions yet; extend() the buffer first, or "
                f"sample(({n_real + n_sim}, 0)) for real rows only"
            )
        streams, drawn = [], []
        for buffer, rows_of, count in ((self.real, self._real_rows, n_real), (self, self._stored_rows(), n_sim)):
            if count:
                index, weight = _draw(buffer, count, generator)
                streams.append((rows_of, index.to(self.device)))
                drawn.append(weight.to(self.device))
        batch = {
            key: torch.cat([rows[i].index_select(0, index) for rows, index in streams])
            for i, key in enumerate(self.keys)
        }
        batch["real"] = torch.arange(n_real + n_sim, device=self.device) < n_real
        info = {}
        if not all(type(buffer.sampler) is RandomSampler for buffer in (self, self.real)):
            info = {"index": torch.cat([index for _, index in streams]), "priority_weight": torch.cat(drawn)}
        sampled = TensorDict(batch | info, batch_size=[n_real + n_sim], device=self.device)
        if len(self._transform):
            sampled = self._transform(sampled)
        return (sampled, info) if return_info else sampled

    def update_tensordict_priority(self, data: TensorDictBase) -> None:
        """Set the priorities of a batch's rows, each in its own stream; streams that are drawn uniformly have none.

        Args:
            data: a batch from :meth:`sample`, with the entry ``priority_key``, such as ``td_error`` from the losses.
        """
        if "index" not in data.keys():  # of two streams that are drawn uniformly
            return
        for buffer, of_stream in ((self.real, data["real"]), (super(), ~data["real"])):
            if of_stream.any():
                rows = cast(TensorDictBase, data.select("index", self.priority_key)[of_stream])
                # TorchRL's trees read the bytes of float64 priorities as float32
                buffer.update_tensordict_priority(rows.set(self.priority_key, rows[self.priority_key].float()))

    def state_dict(self) -> dict[str, Any]:
        """Return the simulated stream. The real data are not included, because they can be read again."""
        return {
            "real": self._fingerprint(),
            "cursor": self._writer.state_dict(),
            # clones, because a view would be saved together with the whole storage
            "rows": [rows.clone() for rows in self._stored_rows()],
            "waiting": [rows.clone() for rows in self._waiting_rows()],
            "samplers": [self._sampler.state_dict(), self.real.sampler.state_dict()],
            "transform": self._transform.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the simulated stream of a buffer with the same real data, keys, capacity and kinds of samplers.

        Raises:
            ValueError: if the state belongs to other real data, other keys or a larger buffer.
        """
        self._restore(state_dict)
        self._sampler.load_state_dict(state_dict["samplers"][0])
        self.real.sampler.load_state_dict(state_dict["samplers"][1])
        self._transform.load_state_dict(state_dict["transform"])

    def dumps(self, path: str | Path) -> None:
        """Write the simulated stream to a folder of memory-mapped rows.

        An existing folder is replaced once the new one is complete.

        Args:
            path: the folder.
        """
        state = {"real": self._fingerprint(), "cursor": self._writer.state_dict()}
        with whole_folder(path, replace=True) as folder:
            (folder / "stream.json").write_text(json.dumps(state), encoding="utf-8")
            if stored := self._stored_rows():
                rows = TensorDict(dict(zip(self.keys, stored, strict=True)), [len(self._storage)])
                map_to_files(rows.cpu(), folder / "rows")
            if waiting := self._waiting_rows():
                rows = TensorDict(dict(zip(self.stream_keys, waiting, strict=True)), waiting[0].shape[:-1])
                map_to_files(rows.cpu(), folder / "waiting")
            self._sampler.dumps(folder / "sampler")
            self.real.sampler.dumps(folder / "real_sampler")
            if transform := self._transform.state_dict():
                torch.save(transform, folder / "transform.pt")

    def loads(self, path: str | Path) -> None:
        """Read a folder written by :meth:`dumps` into a buffer with the same real data and keys.

        Args:
            path: the folder.

        Raises:
            ValueError: as for :meth:`load_state_dict`, and for a truncated file.
        """
        folder = Path(path)
        state = json.loads((folder / "stream.json").read_text(encoding="utf-8"))
        self._require_same_real(state["real"])
        for name, keys in (("rows", self.keys), ("waiting", self.stream_keys)):
            state[name] = []
            if (folder / name).is_dir():
                rows = load_memory_map(folder / name)
                state[name] = [rows.get(key) for key in keys]
        self._restore(state)
        self._sampler.loads(folder / "sampler")
        self.real.sampler.loads(folder / "real_sampler")
        if (folder / "transform.pt").exists():
            self._transform.load_state_dict(torch.load(folder / "transform.pt", weights_only=True))

    def _restore(self, state: dict[str, Any]) -> None:
        """Replace the simulated rows, those that wait and the cursor by those of a saved state."""
        self._require_same_real(state["real"])
        self.empty()
        if state["rows"]:
            count = len(state["rows"][0])
            if count > self._storage.max_size:
                raise ValueError(
                    f"the checkpoint holds {count} simulated transitions, this buffer has room "
                    f"for {self._storage.max_size}: use the capacity of the saved buffer"
                )
            rows = dict(zip(self.keys, state["rows"], strict=True))
            self._extend(TensorDict(rows, [count]).to(self.device))
        if self._multi_step is not None and (waiting := state["waiting"]):
            entries = dict(zip(self.stream_keys, waiting, strict=True))
            # all entries of a transition have one dimension after those of the batch
            self._multi_step.waiting = TensorDict(entries, waiting[0].shape[:-1])
        # the cursor is restored too, so that a restored generator draws the same rows
        self._writer.load_state_dict(state["cursor"])

    def _share(self, batch_size: int | tuple[int, int] | None) -> tuple[int, int]:
        """Return the numbers of real and simulated rows of a batch."""
        if batch_size is None:
            return self._sizes
        if not isinstance(batch_size, int):
            return _require_sizes(batch_size)
        n_real = round(batch_size * self._sizes[0] / sum(self._sizes))
        return _require_sizes((n_real, batch_size - n_real))

    def _stored_rows(self) -> list[torch.Tensor]:
        """Return the filled part of each tensor. It is kept, because finding it is slower than gathering rows."""
        count = len(self._storage)
        if count and (not self._sim_rows or len(self._sim_rows[0]) != count):
            stored = self._storage[:]
            self._sim_rows = [stored.get(key) for key in self.keys]
        return self._sim_rows

    def _waiting_rows(self) -> list[torch.Tensor]:
        """Return the simulated rows whose successors are not known yet, one tensor [*B, T, n] per entry."""
        waiting = None if self._multi_step is None else self._multi_step.waiting
        return [] if waiting is None else [waiting.get(key) for key in self.stream_keys]

    def _fingerprint(self) -> dict[str, Any]:
        # 64 rows distinguish two recordings without reading a whole mapped file; the number is part of the format
        some = torch.linspace(0, len(self.real) - 1, 64, dtype=torch.double).long()
        digest = hashlib.sha256()
        for rows in self._real_rows:
            digest.update(rows[some.to(rows.device)].cpu().numpy().tobytes())
        return {
            "transitions": len(self.real),
            "sha256_of_64": digest.hexdigest(),
            "keys": [key if isinstance(key, str) else list(key) for key in self.keys],
        }

    def _require_same_real(self, saved: dict[str, Any]) -> None:
        own = self._fingerprint()
        if saved != own:
            raise ValueError(
                f"the checkpoint was made with {saved['transitions']} real transitions and the "
                f"entries {saved['keys']}; this buffer has {own['transitions']} and "
                f"{own['keys']}, or other values: load the same real data first"
            )


def _draw(
    buffer: TensorDictReplayBuffer, count: int, generator: torch.Generator | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw places in one stream's storage, [count], and the weights that correct for their probabilities, [count]."""
    storage = cast(TensorStorage, buffer.storage)
    if type(buffer.sampler) is RandomSampler:
        index = torch.randint(len(storage), (count,), device=storage.device, generator=generator)
        return index, torch.ones(count, device=storage.device)
    index, info = buffer.sampler.sample(storage, count)
    return index, torch.as_tensor(info.get("priority_weight", torch.ones(count)))


def _require_sizes(sizes: tuple[int, int]) -> tuple[int, int]:
    n_real, n_sim = sizes
    if n_real < 0 or n_sim < 0 or n_real + n_sim < 1:
        raise ValueError(f"batch_size is {sizes}, expected (real, simulated) rows with at least one in total")
    return int(n_real), int(n_sim)
