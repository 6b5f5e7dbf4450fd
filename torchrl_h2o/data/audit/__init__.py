"""Audit of measured data before a search: time, rows, kinematics, units and zeros, actions, excitation."""

from torchrl_h2o.data.audit.audit import Audit, audit
from torchrl_h2o.data.audit.finding import Finding, Rows

__all__ = ["Audit", "Finding", "Rows", "audit"]
