"""A case with the log of driven joints that hang from the ceiling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from cases import Case
from chains import MODEL_STEPS, Chain
from servos import Arm
from systems import with_sensor_noise
from tensordict import TensorDict

from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.residuals import Simulation, StateMap


@dataclass(frozen=True, kw_only=True)
class JointCase(Case):
    """A case with the log of a chain or of an arm.

    Args:
        machine: the chain or the arm.
        velocities: whether the log has velocities.
    """

    machine: Chain | Arm
    velocities: bool

    def simulation(self) -> Simulation:
        names, xml = self.machine.names, self.machine.xml()
        count, observed, units = len(names), names, ["rad"] * len(names)
        if self.velocities:
            observed, units = [*names, *(f"{name}_velocity" for name in names)], [*units, *["rad/s"] * count]
        state_map = StateMap.of_coordinates(observed, units, range(len(observed)), 2 * count)
        if not self.velocities:
            state_map = replace(state_map, hidden=tuple(range(count, 2 * count)))
        return Simulation(lambda: mujoco.MjSpec.from_string(xml), MODEL_STEPS, state_map, name=self.system)

    def measure(self) -> TensorDict:
        states, commands = self.machine.record(self.transitions, self.seed)
        seen = states if self.velocities else states[:, : len(self.machine.names)]
        ends = np.zeros(len(commands), bool)
        data = to_ted(
            observation=seen[:-1], action=commands, next_observation=seen[1:], terminated=ends, truncated=ends
        )
        return with_sensor_noise(data, self.noise, self.seed)
