"""Replay buffers of many runs with the same real data, sampled in one call.

Each run has its own ``HybridReplayBuffer``. The simulated rows of all runs are stored in one tensor, so that one index
operation gathers the batches of all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from torchrl_h2o.data.hybrid_replay import TRANSITION_KEYS, HybridReplayBuffer
from torchrl_h2o.data.multi_step import OngoingMultiStep, multi_step_keys


class PopulationReplay:
    """N replay buffers that share their real data.

    Args:
        real: flat TED transitions, batch size [T], shared by all runs.
        sim_capacity: number of simulated transitions that each run stores.
        batch_size: (real, simulated) rows of a run's batch.
        num_members: number of runs, N.
        n_steps: n of n-step targets, as in :class:`HybridReplayBuffer`.
        gamma: discount factor of the n-step rewards.
        keys: the entries of a batch, as in :class:`HybridReplayBuffer`.
        device: device of the data and of the batches.

    Attributes:
        buffers: one per member; they are extended and saved separately.

    Example:
        >>> import torch
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.training.populations import PopulationReplay
        >>> env = GymEnv("Pendulum-v1")
        >>> replay = PopulationReplay(env.rollout(50), sim_capacity=1000, batch_size=(4, 4), num_members=3)
        >>> for buffer in replay.buffers:
        ...     _ = buffer.extend(env.rollout(20))
        >>> replay.sample()["next", "reward"].shape
        torch.Size([3, 8, 1])
    """

    def __init__(
        self,
        real: TensorDictBase,
        sim_capacity: int,
        batch_size: tuple[int, int],
        num_members: int,
        *,
        n_steps: int = 1,
        gamma: float = 0.99,
        keys: Sequence[NestedKey] = TRANSITION_KEYS,
        device: torch.device | str = "cpu",
    ) -> None:
        real = real.select(*keys).to(device)
        if n_steps > 1:
            real = OngoingMultiStep(n_steps, gamma).whole(real).select(*multi_step_keys(keys))
        wide = cast(TensorDictBase, real[:1].expand(num_members, sim_capacity))
        memory = cast(TensorDictBase, wide.apply(lambda rows: rows.new_empty(rows.shape)))
        self.buffers = [
            HybridReplayBuffer(
                real,
                sim_capacity,
                batch_size,
                n_steps=n_steps,
                gamma=gamma,
                keys=keys,
                device=device,
                sim_memory=memory[member],
            )
            for member in range(num_members)
        ]
        self.batch_size, self.device = tuple(batch_size), torch.device(device)
        self._real = {key: real.get(key) for key in self.buffers[0].keys}
        self._sim = {key: memory.get(key).flatten(0, 1) for key in self.buffers[0].keys}
        self._first_sim = sim_capacity * torch.arange(num_members, device=device)[:, None]
        self._lengths = torch.zeros(2, num_members, 1, dtype=torch.long, device=device)  # of both streams
        self._known_lengths: tuple[list[int], list[int]] = ([], [])

    def sample(self, batch_size: tuple[int, int] | None = None) -> TensorDict:
        """Draw a batch for every member, from torch's global generator.

        Args:
            batch_size: (real, simulated) rows of a member's batch. Defaults to the batch size of the buffers.

        Returns:
            TensorDict of batch size [N, real + simulated] with the buffers' entries and the boolean ``real``. The real
            rows come first.
        """
        n_real, n_sim = self.batch_size if batch_size is None else batch_size
        self.find_lengths()
        if n_sim and not all(self._known_lengths[1]):
            raise RuntimeError(
                f"member {self._known_lengths[1].index(0)} has no simulated transitions yet; extend() its buffer "
                "first, or sample((n, 0)) for real rows alone"
            )
        index_real = self._draw(0, n_real)
        index_sim = self._draw(1, n_sim) + self._first_sim
        batch = {
            key: torch.cat([_gather(self._real[key], index_real), _gather(self._sim[key], index_sim)], 1)
            for key in self._real
        }
        size = [len(self.buffers), n_real + n_sim]
        batch["real"] = (torch.arange(size[1], device=self.device) < n_real).expand(size)
        return TensorDict(batch, batch_size=size, device=self.device)

    def find_lengths(self) -> None:
        """Copy the buffers' lengths to the device if they changed, to avoid a synchronising copy for every batch.

        :meth:`sample` does so itself. Where a CUDA graph replays it, call this method first.
        """
        lengths = [len(buffer.real) for buffer in self.buffers], [buffer.num_sim for buffer in self.buffers]
        if lengths != self._known_lengths:
            self._known_lengths = lengths
            self._lengths.copy_(torch.tensor(lengths)[..., None])

    def _draw(self, stream: int, count: int) -> torch.Tensor:
        """Draw row numbers below the length of each member's buffer, ``[N, count]``."""
        uniform = torch.rand(len(self.buffers), count, device=self.device, dtype=torch.double)
        return (uniform * self._lengths[stream]).long()


def _gather(rows: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    return rows.index_select(0, index.flatten()).unflatten(0, index.shape)
