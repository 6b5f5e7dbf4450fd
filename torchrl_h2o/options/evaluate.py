"""Options of h2o-evaluate."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from torchrl_h2o.options.sources import RunFolder
from torchrl_h2o.options.types import Few, Options, Positive, Seed, Trust, option


class EvaluateOptions(Options):
    """Options of h2o-evaluate."""

    checkpoint: RunFolder = Field(description="the folder of a run")
    method: str | None = option(None, 'null: the run\'s main method; otherwise a baseline: "SAC in the simulator"')
    world: Literal["reality", "simulator"] = Field("reality", alias="in")
    episodes: Few = option(5)
    seed: Seed = option(1_000_000, "the default gives the same episodes as the table of the run")
    film: str | None = option("evaluation.mp4", "in the run's folder, or here; without suffix, a folder of PNG frames")
    seconds: Positive = option(10.0, "length of the film")
    trust: Trust = option(False, "foreign names in the folder's config.yaml whose code is run: first read what it does")
