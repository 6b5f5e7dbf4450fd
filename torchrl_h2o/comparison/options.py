"""Options of paper.py and report.py, recipes/config/paper.yaml and report.yaml."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from torchrl_h2o.comparison.grids import FIGURES, TABLES
from torchrl_h2o.options import AnyMethodOptions, Options
from torchrl_h2o.options.sources import AnyPath, DataSource
from torchrl_h2o.options.train import Seeds
from torchrl_h2o.options.types import Count, Gap, OneOf, option

Names = Annotated[list[str], Field(min_length=1, description="a list of names, such as [iql,sac] or [wheel_legged]")]
Returns = Annotated[list[float], Field(min_length=2, max_length=2)]


class PaperOptions(AnyMethodOptions):
    """Options of paper.py. Relations between a run's options are checked for each run, with its own environment."""

    table: Annotated[str, OneOf(tuple(TABLES))] | None
    figure: Annotated[str, OneOf(tuple(FIGURES))] | None
    methods: Names | None
    datasets: Annotated[list[DataSource], Field(min_length=1)] | None
    gaps: Annotated[list[Gap], Field(min_length=1)] | None = None
    strengths: Annotated[list[float | None], Field(min_length=1)] | None
    tasks: Names | None
    folder_of_data: AnyPath | None
    seeds: Seeds = option([0, 1, 2, 3, 4])
    retries: Annotated[int, Field(ge=0)]
    folder: str | None

    @model_validator(mode="after")
    def _is_one_grid(self) -> PaperOptions:
        if (self.table is None) == (self.figure is None):
            raise ValueError(f"name one: table={' | '.join(TABLES)}, or figure={' | '.join(FIGURES)}")
        return self


class ReportOptions(Options):
    """Options of report.py."""

    groups: list[str]
    by_seed: list[str]
    at: list[Count]
    results: AnyPath | None
    to: str | None
    updates: Count | None
    references: dict[str, Returns] = Field(
        description="the returns that score 0 and 100 for each environment, such as +references.mine=[0,1000]"
    )
    reps: Count
    runs: str
