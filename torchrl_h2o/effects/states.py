"""Many states of a model at once, and what depends on them: forces, and numbers of the model that vary."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import mujoco
import numpy as np


class States(NamedTuple):
    """B states of one model, with what drives it.

    Args:
        qpos: positions, (B, nq).
        qvel: velocities, (B, nv).
        act: activations of the actuators, (B, na).
        ctrl: executed controls, (B, nu).
        time: time in s, (B,).
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    time: np.ndarray

    @classmethod
    def of(cls, data: mujoco.MjData) -> "States":
        """The one state of a simulation, as a batch of one."""
        return cls(data.qpos[None], data.qvel[None], data.act[None], data.ctrl[None], np.array([data.time]))


BatchedForce = Callable[[States], np.ndarray]


class Memory(Protocol):
    """What a variation remembers of each world between its calls, beside the state of the model."""

    size: int

    def read(self) -> np.ndarray:
        """What it remembers after its last call, (B, size)."""
        ...

    def write(self, remembered: np.ndarray) -> None:
        """Begins anew in worlds that remember this, (B, size); NaN where that is not known."""
        ...


class Variation(NamedTuple):
    """How numbers of a model depend on its state.

    Args:
        fields: fields of ``mujoco.MjModel`` that vary.
        apply: changes their values, (B, ...) by field, in place for the next physics step from B states, and returns
            the generalised forces of that step, (B, nv), or 0.
        memory: what it remembers; None for a function of the state alone.
    """

    fields: tuple[str, ...]
    apply: Callable[[States, dict[str, np.ndarray]], np.ndarray | float]
    memory: Memory | None = None
