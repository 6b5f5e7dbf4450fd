"""Options of train.py, recipes/config/any_method.yaml and collector/*.yaml."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from torchrl_h2o.options.run import ExperimentOptions, RunOptions
from torchrl_h2o.options.types import (
    Count,
    Device,
    DeviceName,
    Gap,
    Inside,
    NotNegative,
    Options,
    Positive,
    Seed,
    Share,
)

Method = Literal["sac", "cql", "iql", "darc", "h2o", "h2o_plus", "rlpd", "td3"]


def _each_once(values: list) -> list:
    twice = [value for value in values if values.count(value) > 1]
    if twice:
        raise ValueError(f"{twice[0]} is in the population twice; name each value once")
    return values


Seeds = Annotated[list[Seed], Field(min_length=1, examples=[[0, 1, 2]]), AfterValidator(_each_once)]
Gaps = Annotated[list[Gap | None], Field(min_length=1), AfterValidator(_each_once)]
Mixings = Annotated[list[Share], Field(min_length=1, examples=[[0.1, 0.5]]), AfterValidator(_each_once)]


class H2OOptions(Options):
    """``h2o``: the conservative term."""

    alpha_c: NotNegative
    num_samples: Count


class IQLOptions(Options):
    """``iql``: arguments of TorchRL's IQLLoss, of which others may be added."""

    model_config = ConfigDict(extra="allow")

    expectile: Inside
    temperature: Positive


class CQLOptions(Options):
    """``cql``: arguments of TorchRL's CQLLoss, of which others may be added."""

    model_config = ConfigDict(extra="allow")

    min_q_weight: NotNegative
    num_random: Count


class CollectorOptions(Options):
    """``collector``: where the simulators run."""

    model_config = ConfigDict(extra="allow")

    backend: Literal["direct", "process", "ray"]
    workers: Count = 1
    resources: dict[str, Any] | None = None
    init: dict[str, Any] | None = None


class AnyMethodOptions(ExperimentOptions):
    """The options of any_method.yaml, each by itself."""

    collector: CollectorOptions
    method: Method
    baselines: list[Method]
    seeds: Seeds | None
    gaps: Gaps | None
    mixings: Mixings | None
    device: DeviceName = "cpu"
    h2o: H2OOptions
    iql: IQLOptions
    cql: CQLOptions
    results: str | None
    overrides: list[str] | None


class TrainOptions(AnyMethodOptions, RunOptions):
    """Options of train.py, with the relations between them."""

    device: Device = "cpu"

    @model_validator(mode="after")
    def _fit_the_method(self) -> TrainOptions:
        self._check_collector()
        self._check_population()
        return self

    @property
    def streams(self) -> int:
        """Number of worlds of all workers, which share the steps of an epoch."""
        return self.worlds * self.collector.workers

    @property
    def _typed_streams(self) -> str:
        workers = self.collector.workers
        return f"collector.workers={workers} " * (workers > 1) + super()._typed_streams

    def _check_gap(self) -> None:
        if self.gaps is None:
            super()._check_gap()

    def _check_precision(self) -> None:
        others = {self.method, *self.baselines} - {"h2o_plus", "rlpd"}
        if self.precision == "bf16" and (others or self.is_population):
            raise ValueError(
                "precision=bf16 is for single runs of h2o_plus and rlpd: leave it out with "
                f"{', '.join(sorted(others)) or 'a population'}"
            )
        if self.precision == "bf16" and self.device != "cpu":
            raise ValueError(f"precision=bf16 device={self.device}: bf16 is for the CPU; leave one of them out")
        super()._check_precision()

    @property
    def is_population(self) -> bool:
        """Whether several runs are trained together in one process."""
        return self.seeds is not None or self.gaps is not None or self.mixings is not None

    def _check_population(self) -> None:
        if not self.is_population:
            return
        if self.overlap:
            raise ValueError("overlap=true is for single runs: leave it out with a population")
        if self.method != "h2o_plus" or self.baselines:
            raise ValueError(
                f"method={self.method} baselines=[{','.join(self.baselines)}]: a population trains h2o_plus alone; "
                "use --multirun for other methods"
            )

    def _check_collector(self) -> None:
        if self.collector.backend == "ray" and find_spec("ray") is None:
            raise ValueError("collector=ray needs Ray: pip install 'torchrl_h2o[ray]', here and where workers run")
