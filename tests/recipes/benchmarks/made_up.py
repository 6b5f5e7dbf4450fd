"""Reports that no search has written, for the tests of scores and of runs."""

from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect, IndistinguishableGroup
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.errors import ErrorSummary


def report(*effects, before=1.0, after=0.0, floor=None, declared=True, groups=(), conclusion=None):
    return Report(
        simulator="made up",
        data=DataSummary("made up", 100, 30),
        error=ErrorSummary("one-step RMSE", "1", before, after, floor),
        found=tuple(FoundEffect(effect, declared, {}, after) for effect in effects),
        indistinguishable=tuple(IndistinguishableGroup(tuple(g), (after,) * len(g)) for g in groups),
        conclusion=conclusion,
    )
