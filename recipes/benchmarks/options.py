"""Types and bounds of the benchmarks' options; recipes/config/*_benchmark.yaml have their defaults and comments."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from torchrl_h2o.options import Options
from torchrl_h2o.options.sources import AnyPath
from torchrl_h2o.options.types import Count, Device, Inside, NotNegative, Positive, Rows, Seed, Widths

Counts = Annotated[list[Count], Field(min_length=1)]
Seeds = Annotated[list[Seed], Field(min_length=1)]
Numbers = list[Annotated[int, Field(ge=0)]]
Names = Annotated[list[str], Field(min_length=1)]


class TimingOptions(Options):
    """Options of the benchmarks that take turns; each has further ones of its own."""

    model_config = ConfigDict(extra="allow")

    seconds: Positive
    turns: Count
    threads: Count | None
    device: Device = "cpu"


class SimulatorOptions(TimingOptions):
    """Options of simulator.py."""

    task: str
    worlds: Counts


class UpdateOptions(TimingOptions):
    """Options of update.py."""

    observation_dim: Count
    action_dim: Count
    transitions: Count
    compiled: bool
    authors: AnyPath | None
    num_cells: Widths
    layer_norm: bool


class PopulationOptions(TimingOptions):
    """Options of population.py."""

    members: Counts
    compiled: list[Count]
    observation_dim: Count
    action_dim: Count
    transitions: Count
    calls: Count
    table: Annotated[list[Count], Field(min_length=3, max_length=3, description="three integers of at least 1")]


class ScalingOptions(TimingOptions):
    """Options of scaling.py."""

    observation_dim: Count
    action_dim: Count
    transitions: Count
    buffer_sizes: Counts
    batch_sizes: Counts
    widths: Counts
    populations: Counts
    worlds: Counts
    workers: Counts
    scratch: AnyPath | None


class CloseTheLoopBenchmarkOptions(Options):
    """Options of close_the_loop.py."""

    cases: Names
    draws: Count | None
    numbers: Numbers | None
    seed: Seed
    processes: Count
    logs: AnyPath | None


class CorruptionsOptions(Options):
    """Options of corruptions.py."""

    systems: Names
    numbers: Numbers | None
    seeds: Seeds
    draws: Annotated[int, Field(ge=0)]
    logs: AnyPath | None


class RatioOptions(Options):
    """Options of ratio.py."""

    estimators: Names
    systems: Names
    seeds: Seeds
    rows: Counts
    steps: Counts
    batch_size: Rows
    shuffled: list[str]
    lr: Positive
    input_noise: NotNegative
    change_noise: NotNegative
    ratio_weight_penalty: NotNegative
    ratio_logit_bound: Positive
    delayed: bool
    tau: Inside
    threads: Count
