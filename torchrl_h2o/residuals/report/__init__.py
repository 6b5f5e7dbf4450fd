"""The report of closing the loop: its contents, its sentence, its JSON file and its page."""

from torchrl_h2o.residuals.report.document import Report

__all__ = ["Report"]
