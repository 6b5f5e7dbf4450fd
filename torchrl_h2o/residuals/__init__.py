"""Closing the loop with measured data: find the residual, trace it to effects, add them, report."""

from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.residual import residuals
from torchrl_h2o.residuals.simulation import Simulation
from torchrl_h2o.residuals.state_map import StateMap

__all__ = ["Measured", "Simulation", "StateMap", "residuals"]
