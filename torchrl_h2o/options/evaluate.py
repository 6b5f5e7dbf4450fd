"""Options of h2o-evaluate, config/evaluate.yaml."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from torchrl_h2o.options.sources import RunFolder
from torchrl_h2o.options.types import Count, Options, Positive, Seed, Trust


class EvaluateOptions(Options):
    """Options of h2o-evaluate."""

    checkpoint: RunFolder = Field(description="the folder of a run")
    method: str | None
    world: Literal["reality", "simulator"] = Field(alias="in")
    episodes: Count
    seed: Seed
    film: str | None
    seconds: Positive
    trust: Trust
