"""Real transitions and their simulated counterparts: the same observation and action, another next observation.

A classifier of real and simulated rows that is trained on such pairs can only use s', so its log-odds are the log of
P(s'|s, a) / P̂(s'|s, a).
"""

from __future__ import annotations

from typing import cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key


class PairedTransitions:
    """Batches of real rows and of simulated rows with the same observations and actions.

    Args:
        real: measured transitions, [T], preprocessed as the learner sees them.
        simulated_next: [T, n], the next observation that the simulator gives for each row, preprocessed alike; rows
            with NaN are left out. :func:`~torchrl_h2o.residuals.simulate_transitions` computes it in physical units.
        next_observation: entry that holds s'.
        device: device of the batches.

    Raises:
        ValueError: if the shapes differ, or the simulator gives no row.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_h2o.data import PairedTransitions
        >>> real = TensorDict(observation=torch.zeros(5, 2), action=torch.zeros(5, 1),
        ...                   next=TensorDict(observation=torch.ones(5, 2)), batch_size=5)
        >>> batch = PairedTransitions(real, torch.full((5, 2), 3.0)).sample((2, 2))
        >>> batch["real"].tolist(), batch["next", "observation"][:, 0].tolist()
        ([True, True, False, False], [1.0, 1.0, 3.0, 3.0])
    """

    def __init__(
        self,
        real: TensorDictBase,
        simulated_next: torch.Tensor,
        *,
        next_observation: NestedKey = ("next", "observation"),
        device: torch.device | str = "cpu",
    ) -> None:
        following = cast(torch.Tensor, real.get(next_observation))
        if simulated_next.shape != following.shape:
            raise ValueError(
                f"the simulated next observations have the shape {list(simulated_next.shape)}, the real ones "
                f"{list(following.shape)}: preprocess both alike"
            )
        known = simulated_next.isfinite().all(-1)
        if not known.any():
            raise ValueError("the simulator gives a next observation for none of the rows, so there are no pairs")
        self.device = torch.device(device)
        self.next_observation = unravel_key(next_observation)
        self._observation, self._action = (real.get(key)[known].to(self.device) for key in ("observation", "action"))
        self._real = following[known].to(self.device)
        self._simulated = simulated_next[known].to(self._real)

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self._real)

    def sample(self, batch_size: tuple[int, int], generator: torch.Generator | None = None) -> TensorDict:
        """Draw pairs uniformly with replacement.

        Args:
            batch_size: numbers of real and simulated rows. Row i of both streams is the same pair.
            generator: random generator, instead of torch's global one.

        Returns:
            TensorDict of batch size [real + simulated] with observation, action, the next observation and ``real``;
            the real rows come first.
        """
        n_real, n_sim = batch_size
        index = torch.randint(len(self), (max(n_real, n_sim),), device=self.device, generator=generator)
        both = torch.cat([index[:n_real], index[:n_sim]])
        following = torch.cat([self._real[index[:n_real]], self._simulated[index[:n_sim]]])
        batch = TensorDict(
            {
                "observation": self._observation[both],
                "action": self._action[both],
                "real": torch.arange(n_real + n_sim, device=self.device) < n_real,
            },
            batch_size=[n_real + n_sim],
            device=self.device,
        )
        return batch.set(self.next_observation, following)
