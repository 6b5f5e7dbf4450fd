"""The description of a simulator from which a :class:`Simulation` is built."""

from collections.abc import Callable
from typing import NamedTuple

import mujoco

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.simulation.state_map import StateMap


class SimulatorSource(NamedTuple):
    """A model, its control step, its observation and its effects, as read from an env or a file.

    Args:
        spec: returns the model's specification, parsed anew at each call.
        frame_skip: physics steps per control step.
        state_map: the map between observations and states, hidden coordinates not yet marked.
        effects: the effects in the simulator, in their order.
        name: the name for reports.
    """

    spec: Callable[[], mujoco.MjSpec]
    frame_skip: int
    state_map: StateMap
    effects: tuple[Effect, ...]
    name: str
