"""Simulators that take effects and are stepped from many measured states at once."""

from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.simulation.state_map import StateMap

__all__ = ["Simulation", "StateMap"]
