"""What the learner sees of a transition: normalised, stacked observations and a scaled reward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.envs import CatFrames, ObservationNorm, Transform


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing that real data and environments share.

    Args:
        loc: ``[n]``, mean that is subtracted from each observation; None for no normalisation.
        scale: ``[n]``, standard deviation that observations are divided by.
        frames: number of successive observations that the learner sees at once.
        reward_scale: factor of the reward.
        reward_offset: added to the reward before it is scaled.
    """

    loc: tuple[float, ...] | None = None
    scale: tuple[float, ...] | None = None
    frames: int = 1
    reward_scale: float = 1.0
    reward_offset: float = 0.0

    @classmethod
    def fit(cls, real: TensorDictBase, *, normalise: bool = False, **options) -> Preprocessing:
        """Takes mean and standard deviation of the observations from the real data.

        Args:
            real: the measured transitions, ``[T]``.
            normalise: whether observations are normalised.
            **options: ``frames``, ``reward_scale`` and ``reward_offset``.
        """
        if not normalise:
            return cls(**options)
        observation = real["observation"]
        scale = observation.std(0).clamp_min(1e-6)
        return cls(tuple(observation.mean(0).tolist()), tuple(scale.tolist()), **options)

    def transforms(self) -> list[Transform]:
        """The transforms that show an environment's observations in this way."""
        chosen: list[Transform] = []
        if self.loc is not None:
            chosen.append(ObservationNorm(**self._norm(), in_keys=["observation"], standard_normal=True))
        if self.frames > 1:
            chosen.append(CatFrames(N=self.frames, dim=-1, in_keys=["observation"]))
        return chosen

    def apply(self, real: TensorDictBase) -> TensorDictBase:
        """The real transitions ``[T]`` as the learner sees them, in a new tensordict."""
        real = real.copy()
        real["next"] = real["next"].copy().set("reward", self.reward(real["next", "reward"]))
        if self.loc is not None:
            norm = self._norm()
            for part in (real, real["next"]):
                part["observation"] = (part["observation"] - norm["loc"]) / norm["scale"]
        if self.frames > 1:
            both = CatFrames(N=self.frames, dim=-1, in_keys=["observation", ("next", "observation")])
            real = both.unfolding(real.refine_names("time"))
            real.names = None
        return real

    def reward(self, reward: torch.Tensor) -> torch.Tensor:
        """The reward of the losses, from the task's own; reported returns are the task's own."""
        return self.reward_scale * (reward + self.reward_offset)

    def _norm(self) -> dict[str, torch.Tensor]:
        return {"loc": _tensor(self.loc), "scale": _tensor(self.scale)}


def _tensor(values: Sequence[float] | None) -> torch.Tensor:
    return torch.tensor(list(values or ()))
