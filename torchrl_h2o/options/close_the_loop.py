"""Options of close-the-loop, and simulator/*.yaml."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

import torchrl_h2o.effects
from torchrl_h2o.effects import Effect
from torchrl_h2o.experiment.limits import Envelope
from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.options.run import MakeOptions
from torchrl_h2o.options.sources import AnyPath, Data, Layout, NewFolder
from torchrl_h2o.options.types import Count, Gap, Inside, Options, Positive, Seed, option

EFFECTS = sorted(
    name for name, one in vars(torchrl_h2o.effects).items() if isinstance(one, type) and issubclass(one, Effect)
)


def _require_match(pattern: str) -> str:
    if not any(fnmatchcase(name, pattern) for name in EFFECTS):
        near = did_you_mean(pattern, EFFECTS)
        raise ValueError(f"matches no effect{near or '; choose from ' + ', '.join(EFFECTS)}")
    return pattern


Pattern = Annotated[
    str, AfterValidator(_require_match), Field(description="a pattern of effects' names, such as Joint*")
]

HeldOut = Annotated[
    Inside | str | list[str],
    Field(description="a share of the rows above 0 and below 1, or the names of logs, such as [c.csv]"),
]


class SimulatorOptions(Options):
    """``simulator``: files in simulator/*.yaml, also those of users, which may have further entries."""

    model_config = ConfigDict(extra="allow")

    path: AnyPath | None = None
    make: MakeOptions | None = None
    task: str | None = None
    coordinates: list[str] | dict[str, str] | None = None
    control_step: Positive | None = None
    gap: Gap | None = None
    gap_strength: float | None = None
    effects: list[dict[str, Any]]
    columns: Layout | None = None
    recorded: str | None = None

    @model_validator(mode="after")
    def _has_a_gap(self) -> SimulatorOptions:
        if self.gap is None and self.gap_strength is not None:
            raise ValueError(
                f"simulator.gap_strength={self.gap_strength} belongs to a gap: choose one, such as "
                "simulator.gap=gravity"
            )
        return self


class CloseTheLoopOptions(Options):
    """Options of close-the-loop."""

    simulator: SimulatorOptions
    data: Data = option(
        "recorded",
        "recorded, Minari name, D4RL file, log, TED folder; several: [a.csv,b.csv], *.csv; one run in "
        "several files: {position: a.csv, effort: b.csv}",
    )
    columns: Layout | None = option(None, "layout of a log: a YAML file, or the name of one of the library's")
    transitions: Count | None = option(5_000, "consecutive rows to use of each log; null for all")
    first_row: Annotated[int, Field(ge=0)] = option(0, "index of the first row used, of each log")
    held_out: HeldOut = option(0.25, "rows, from the end, on which errors are reported; or names of logs: [c.csv]")
    audit: bool | Literal["warn"] = option(True, "looks for faults in the data; severe ones stop the run, unless warn")
    start_from: AnyPath | None = option(None, "report.json of an unfinished run, with whose effects the search begins")
    minutes: Positive | None = option(None, "for the command, with the audit and the report; null: as long as it takes")
    catalogue: Pattern | list[Pattern] | None = option(None, "effects to try, as patterns: [Gravity,Joint*]; null: all")
    export: NewFolder | None = option(
        None, "folder for the ranges of the values, for domain randomisation in other projects"
    )
    next: AnyPath | None = option(
        None, "report.json of these data: designs the experiment that decides what it leaves open"
    )
    plan: AnyPath | None = option(None, "MJCF model: designs the first log, and says which effects it would show")
    noise: Positive = option(0.001, "noise of the encoders with plan: its standard deviation, rad or m")
    seconds: Positive = option(Envelope.seconds, "duration of the experiment of next or plan, s")
    within: Positive = option(Envelope.within, "largest distance of a joint from its position at rest in it, rad or m")
    speed: Positive = option(Envelope.speed, "largest velocity of a joint in it, rad/s or m/s")
    band: Positive = option(Envelope.band, "highest frequency of its commands, Hz")
    contact: bool = option(Envelope.contact, "whether parts may touch in it that do not touch at rest")
    seed: Seed = option(0)
