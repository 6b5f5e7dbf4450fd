"""One episode of a dynamics gap: its effects at work, with what they remember since the reset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tensordict import NestedKey

from torchrl_h2o.effects import ActionEffect, Effect, ForceEffect, ObservationEffect
from torchrl_h2o.effects.effect import Force, Process

if TYPE_CHECKING:
    from torchrl_h2o.envs.backends.backend import Simulator


class Episode(NamedTuple):
    """The effects of one gap at work in one episode; those in the model need no work."""

    actions: Sequence[Process] = ()
    action_keys: Sequence[NestedKey] = ()
    observations: Sequence[Process] = ()
    observation_keys: Sequence[NestedKey] = ()
    forces: Sequence[Force] = ()

    @classmethod
    def begin(cls, effects: Sequence[Effect], simulator: Simulator, rng: np.random.Generator | None) -> Episode:
        """Begins an episode.

        Args:
            effects: those of the gap, with no noise left to take away: see :func:`balanced`.
            simulator: where the episode takes place.
            rng: for the random effects; None where there is none among them.

        Raises:
            ValueError: if an effect finds nothing to act on, or draws random numbers unannounced.
        """

        def processes(kind: type[Effect], of: Any) -> list:
            return [
                effect.process(of, rng if effect.random else _NoGenerator(effect))
                for effect in effects
                if isinstance(effect, kind) and not effect.is_neutral
            ]

        env, dt = simulator.env, simulator.control_step
        observed = [key for key, spec in env.observation_spec.items(True, True) if spec.dtype.is_floating_point]
        observations = processes(ObservationEffect, dt)
        if observations and not observed:
            raise ValueError(
                f"{env} has no floating-point observations that an observation effect could alter, only "
                f"{', '.join(map(str, env.observation_spec.keys(True, True)))}; leave the effect out or let "
                "the env observe its state too (pixels_only=False)"
            )
        return cls(
            actions=processes(ActionEffect, dt),
            action_keys=env.action_keys,
            observations=observations,
            observation_keys=observed,
            forces=processes(ForceEffect, simulator.model),
        )


class Episodes(dict):
    """The present episodes of a simulation's gaps. A copy of the simulation starts without any."""

    def __reduce__(self) -> tuple:
        return Episodes, ()


class _NoGenerator:
    """Stands where an effect that is not ``random`` would find the random generator."""

    def __init__(self, effect: Effect):
        self.effect = effect

    def __getattr__(self, name: str) -> Any:
        raise ValueError(
            f"{self.effect} draws random numbers, but does not say so: write "
            f"'random: ClassVar[bool] = True' into the class {type(self.effect).__name__}"
        )
