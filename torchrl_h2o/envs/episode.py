"""One episode of a dynamics gap in a TorchRL env: applies its effects to tensordicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_h2o.effects import Episode, Pipeline


class GapEpisode(NamedTuple):
    """The effects of one gap in one episode, and the tensordict entries that they alter.

    Args:
        effects: the action, observation and force effects. Model effects are already in the compiled model.
        action_keys: the entries of the action.
        observation_keys: the floating-point entries of the observation.
    """

    effects: Episode = Episode()
    action_keys: Sequence[NestedKey] = ()
    observation_keys: Sequence[NestedKey] = ()

    @classmethod
    def begin(
        cls, pipeline: Pipeline, env: EnvBase, dt: float, model: mujoco.MjModel, rng: np.random.Generator | None
    ) -> GapEpisode:
        """Begins an episode.

        Args:
            pipeline: the effects of the gap, with negative noise subtracted across all gaps.
            env: the env without transforms.
            dt: the control step, in s.
            model: the compiled model.
            rng: the generator of the random effects; None if there are none.

        Raises:
            ValueError: if the model or the observation has no element that an effect could act on, or if an effect that
                is not marked random draws random numbers.
        """
        effects = pipeline.begin(dt, rng, model)
        observed = [key for key, spec in env.observation_spec.items(True, True) if spec.dtype.is_floating_point]
        if effects.observations and not observed:
            raise ValueError(
                f"{env} has no floating-point observations that an observation effect could alter, only "
                f"{', '.join(map(str, env.observation_spec.keys(True, True)))}; leave the effect out or let "
                "the env observe its state too (pixels_only=False)"
            )
        return cls(effects, env.action_keys, observed)

    def execute(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the actions in a tensordict by those that the simulator executes."""
        if not self.effects.actions:
            return tensordict
        return _replace(tensordict, self.action_keys, self.effects.executed)

    def observe(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the observations in a tensordict by those that the sensors report."""
        if not self.effects.observations:
            return tensordict
        return _replace(tensordict, self.observation_keys, self.effects.observed)


class GapEpisodes(dict):
    """The current episodes of a simulation's gaps, by gap. A copy or a pickle of it is empty."""

    def __reduce__(self) -> tuple:
        return GapEpisodes, ()


def _replace(
    tensordict: TensorDictBase, keys: Sequence[NestedKey], alter: Callable[[np.ndarray], np.ndarray]
) -> TensorDictBase:
    """Passes the entries under the keys through a function, as one vector (n,), and writes them back."""
    tensors = [tensordict.get(key) for key in keys]
    parts = [tensor.detach().cpu().double().flatten().numpy() for tensor in tensors]
    vector = alter(np.concatenate(parts))
    ends = np.cumsum([part.size for part in parts])[:-1]
    for key, tensor, part in zip(keys, tensors, np.split(vector, ends), strict=True):
        altered = torch.as_tensor(part, dtype=tensor.dtype, device=tensor.device)
        tensordict.set(key, altered.view(tensor.shape))
    return tensordict
