"""What the learner sees of a transition: normalised, stacked observations and a scaled reward."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

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
    def fit(
        cls,
        real: TensorDictBase,
        *,
        normalise: bool = False,
        norm: Mapping[str, Sequence[float]] | None = None,
        **options,
    ) -> Preprocessing:
        """Takes mean and standard deviation of the observations from the real data.

        Args:
            real: the measured transitions, ``[T]``.
            normalise: whether observations are normalised.
            norm: ``loc`` and ``scale`` to use instead of the data's own.
            **options: ``frames``, ``reward_scale`` and ``reward_offset``.
        """
        if norm is not None:
            return cls(tuple(norm["loc"]), tuple(norm["scale"]), **options)
        if not normalise:
            return cls(**options)
        observation = real["observation"]
        scale = observation.std(0).clamp_min(1e-6)
        return cls(tuple(observation.mean(0).tolist()), tuple(scale.tolist()), **options)

    @property
    def norm(self) -> dict[str, list[float]] | None:
        """Mean and standard deviation as a configuration holds them; None without normalisation."""
        if self.loc is None or self.scale is None:
            return None
        return {"loc": list(self.loc), "scale": list(self.scale)}

    def transforms(self) -> list[Transform]:
        """The transforms that show an environment's observations in this way."""
        chosen: list[Transform] = []
        if self.loc is not None:
            norm = self._tensors()
            loc, scale = norm.get("loc"), norm.get("scale")
            chosen.append(ObservationNorm(loc, scale, in_keys=["observation"], standard_normal=True))
        if self.frames > 1:
            chosen.append(CatFrames(N=self.frames, dim=-1, in_keys=["observation"]))
        return chosen

    def apply(self, real: TensorDictBase) -> TensorDictBase:
        """The real transitions ``[T]`` as the learner sees them, in a new tensordict."""
        real = real.copy()
        real["next"] = cast(TensorDictBase, real["next"]).copy().set("reward", self.reward(real["next", "reward"]))
        if self.loc is not None:
            norm = self._tensors()
            for part in (real, cast(TensorDictBase, real["next"])):
                part["observation"] = (part["observation"] - norm["loc"]) / norm["scale"]
        if self.frames > 1:
            both = CatFrames(N=self.frames, dim=-1, in_keys=["observation", ("next", "observation")])
            real = both.unfolding(real.refine_names("time"))
            real.names = None
        return real

    def reward(self, reward: torch.Tensor) -> torch.Tensor:
        """The reward of the losses, from the task's own; reported returns are the task's own."""
        return self.reward_scale * (reward + self.reward_offset)

    def _tensors(self) -> dict[str, torch.Tensor]:
        return {name: torch.tensor(values) for name, values in (self.norm or {}).items()}
