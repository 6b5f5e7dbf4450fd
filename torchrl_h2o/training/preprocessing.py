"""Preprocessing of transitions for the learner: normalised, stacked observations, past actions and a scaled reward."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torchrl.envs import CatFrames, ObservationNorm, Transform

from torchrl_h2o.envs import ActionHistory


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing that is applied to real data and environments alike.

    Args:
        loc: ``[n]``, mean that is subtracted from each observation; None for no normalisation.
        scale: ``[n]``, standard deviation by which observations are divided.
        frames: number of successive observations that are stacked into one input.
        action_history: number of past actions in front of these observations.
        reward_scale: factor of the reward.
        reward_offset: constant that is added to the reward before scaling.
    """

    loc: tuple[float, ...] | None = None
    scale: tuple[float, ...] | None = None
    frames: int = 1
    action_history: int = 0
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
        """Builds a preprocessing with the mean and standard deviation of the real observations.

        The scale of an entry that does not vary in the data, beyond the rounding of float32, is 1.

        Args:
            real: the measured transitions, ``[T]``.
            normalise: whether observations are normalised.
            norm: ``loc`` and ``scale`` to use instead of those measured in ``real``.
            **options: the other arguments of the class.
        """
        if norm is not None:
            return cls(tuple(norm["loc"]), tuple(norm["scale"]), **options)
        if not normalise:
            return cls(**options)
        observation = real["observation"]
        scale = observation.std(0)
        float32 = torch.finfo(torch.float32)
        rounding = 4 * float32.eps * observation.abs().amax(0) + float32.tiny
        scale = torch.where(scale > rounding, scale, 1.0)
        return cls(tuple(observation.mean(0).tolist()), tuple(scale.tolist()), **options)

    @property
    def norm(self) -> dict[str, list[float]] | None:
        """Mean and standard deviation in the form of the option ``observation_norm``; None without normalisation."""
        if self.loc is None or self.scale is None:
            return None
        return {"loc": list(self.loc), "scale": list(self.scale)}

    def transforms(self) -> list[Transform]:
        """Builds the TorchRL transforms that preprocess an environment's observations."""
        chosen: list[Transform] = []
        if self.loc is not None:
            norm = self._tensors()
            loc, scale = norm.get("loc"), norm.get("scale")
            chosen.append(ObservationNorm(loc, scale, in_keys=["observation"], standard_normal=True))
        if self.frames > 1:
            chosen.append(CatFrames(N=self.frames, dim=-1, in_keys=["observation"]))
        if self.action_history:
            chosen.append(ActionHistory(self.action_history))
        return chosen

    def apply(self, real: TensorDictBase) -> TensorDictBase:
        """Preprocesses the real transitions ``[T]`` and returns them in a new tensordict."""
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
        return ActionHistory(self.action_history).unfolding(real) if self.action_history else real

    def physical(self, observation: torch.Tensor, size: int) -> torch.Tensor:
        """Recovers the latest observation in physical units, in float64.

        Args:
            observation: preprocessed observations, ``[*B, k]``.
            size: size n of the observation before preprocessing.

        Returns:
            The last of the stacked observations, not normalised, ``[*B, n]``.

        Example:
            >>> preprocessing = Preprocessing(loc=(1.0,), scale=(10.0,), frames=2)
            >>> preprocessing.physical(torch.tensor([0.0, 0.5]), size=1).tolist()
            [6.0]
        """
        latest = observation[..., -size:].double()
        norm = self._tensors()
        return latest * norm["scale"] + norm["loc"] if norm else latest

    def next_observation(self, preprocessed: TensorDictBase, following: torch.Tensor) -> torch.Tensor:
        """Preprocesses other next observations of real transitions, such as those of the simulator.

        Args:
            preprocessed: the real transitions, ``[T]``, as :meth:`apply` returns them.
            following: the other next observations in physical units, ``[T, n]``.

        Returns:
            ``[T, k]``; the past actions and the earlier frames are those of the real transitions.
        """
        if self.loc is not None:
            norm = self._tensors()
            following = (following - norm["loc"]) / norm["scale"]
        earlier = preprocessed["next", "observation"][:, : -following.shape[1]]
        return torch.cat([earlier, following], -1)

    def reward(self, reward: torch.Tensor) -> torch.Tensor:
        """Computes the reward for the losses from the task's reward. Reported returns use the task's reward."""
        return self.reward_scale * (reward + self.reward_offset)

    def _tensors(self) -> dict[str, torch.Tensor]:
        return {name: torch.tensor(values) for name, values in (self.norm or {}).items()}
