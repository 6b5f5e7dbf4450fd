"""Closing the loop with measured data: residual, effects that explain it, held-out errors, report."""

from torchrl_h2o.residuals.close_the_loop import close_the_loop, explain
from torchrl_h2o.residuals.estimated_states import estimate_states
from torchrl_h2o.residuals.evidence import Evidence, gather_evidence
from torchrl_h2o.residuals.explanation import Explanation
from torchrl_h2o.residuals.judge.held_out_error import explainable_floor
from torchrl_h2o.residuals.measured.outside import outside_intervals, outside_rows
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.simulated_transitions import simulate_transitions
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.search import search
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.simulation.state_map import StateMap

__all__ = [
    "Evidence",
    "Explanation",
    "Measured",
    "Report",
    "Simulation",
    "Split",
    "StateMap",
    "close_the_loop",
    "estimate_states",
    "explain",
    "explainable_floor",
    "gather_evidence",
    "outside_intervals",
    "outside_rows",
    "residuals",
    "search",
    "simulate_transitions",
]
