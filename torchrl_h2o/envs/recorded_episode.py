"""An episode of action and observation effects that can be saved and continued elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from torchrl_h2o.effects import Episode


class RecordedEpisode:
    """The effects of one episode, with their seed and all values they were given since its start.

    Effects such as delays keep their state in closures, which cannot be saved. A saved episode therefore holds what it
    was given, and is restored by giving it the same again.

    Args:
        begin: begins the episode with a random generator, or without one.
        seed: seed of the random effects; None if there are none.

    Examples:
        >>> import numpy as np
        >>> from torchrl_h2o.effects import ActionDelay, Pipeline
        >>> pipeline = Pipeline((ActionDelay(0.01),))
        >>> def begin(rng):
        ...     return pipeline.begin(0.01, rng)
        >>> episode = RecordedEpisode(begin, seed=None)
        >>> _ = episode.executed(np.array([3.0]))
        >>> RecordedEpisode.restored(begin, episode.state()).executed(np.array([5.0]))
        array([3.])
    """

    def __init__(self, begin: Callable[[np.random.Generator | None], Episode], seed: int | None) -> None:
        self._seed = seed
        self._effects = begin(None if seed is None else np.random.default_rng(seed))
        self._actions: list[np.ndarray] = []
        self._observations: list[np.ndarray] = []

    def executed(self, action: np.ndarray) -> np.ndarray:
        """Returns the action that the simulator executes, (nu,)."""
        self._actions.append(action.copy())
        return self._effects.executed(action)

    def observed(self, observation: np.ndarray) -> np.ndarray:
        """Returns the observation that the sensors report, (n,)."""
        self._observations.append(observation.copy())
        return self._effects.observed(observation)

    def state(self) -> dict[str, Any]:
        """Returns the seed, the actions (T, nu) and the observations (T, n) so far."""
        given = {"actions": self._actions, "observations": self._observations}
        return {"seed": self._seed, **{name: torch.from_numpy(np.array(values)) for name, values in given.items()}}

    @classmethod
    def restored(cls, begin: Callable[[np.random.Generator | None], Episode], state: dict[str, Any]) -> RecordedEpisode:
        """Begins an episode and brings it to a saved state."""
        episode = cls(begin, state["seed"])
        actions, observations = state["actions"].numpy(), state["observations"].numpy()
        for step in range(max(len(actions), len(observations))):  # an observation precedes the action that it causes
            if step < len(observations):
                episode.observed(observations[step])
            if step < len(actions):
                episode.executed(actions[step])
        return episode
