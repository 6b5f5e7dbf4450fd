"""Closing the loop with measured data: find the residual, trace it to effects, add them, report."""

from torchrl_h2o.residuals.close_the_loop import close_the_loop
from torchrl_h2o.residuals.explanation import Explanation, explain
from torchrl_h2o.residuals.floor import explainable_floor
from torchrl_h2o.residuals.horizons import horizon_errors, linear_floor
from torchrl_h2o.residuals.initial_states import estimate_states, smoothed_states
from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.outside import outside_intervals, outside_rows
from torchrl_h2o.residuals.report import Report
from torchrl_h2o.residuals.residual import residuals
from torchrl_h2o.residuals.search import trace_effects
from torchrl_h2o.residuals.simulation import Simulation
from torchrl_h2o.residuals.state_map import StateMap
from torchrl_h2o.residuals.two_sample import two_sample_auc
from torchrl_h2o.residuals.undeclared import find_undeclared

__all__ = [
    "Explanation",
    "Measured",
    "Report",
    "Simulation",
    "StateMap",
    "close_the_loop",
    "estimate_states",
    "explain",
    "explainable_floor",
    "find_undeclared",
    "horizon_errors",
    "linear_floor",
    "outside_intervals",
    "outside_rows",
    "residuals",
    "smoothed_states",
    "trace_effects",
    "two_sample_auc",
]
