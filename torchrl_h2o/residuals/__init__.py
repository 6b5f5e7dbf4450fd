"""Closing the loop with measured data: find the residual, trace it to effects, add them, report."""

from torchrl_h2o.residuals.close_the_loop import close_the_loop
from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.report import Report
from torchrl_h2o.residuals.residual import residuals
from torchrl_h2o.residuals.simulation import Simulation
from torchrl_h2o.residuals.state_map import StateMap
from torchrl_h2o.residuals.trace import trace_effects
from torchrl_h2o.residuals.two_sample import two_sample_auc

__all__ = [
    "Measured",
    "Report",
    "Simulation",
    "StateMap",
    "close_the_loop",
    "residuals",
    "trace_effects",
    "two_sample_auc",
]
