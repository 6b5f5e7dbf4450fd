"""The report: its data, its words, its JSON file and its page."""

from torchrl_h2o.residuals.report.report import Report

__all__ = ["Report"]
