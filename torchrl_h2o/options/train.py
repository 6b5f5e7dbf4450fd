"""Options of train.py in addition to those of a run, and collector/*.yaml."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from torchrl_h2o.options.run import ExperimentOptions, RunOptions
from torchrl_h2o.options.types import (
    Device,
    DeviceName,
    Few,
    Gap,
    Inside,
    NotNegative,
    Options,
    Positive,
    Seed,
    Share,
    option,
)

Method = Literal["sac", "cql", "iql", "td3_bc", "darc", "h2o", "h2o_plus", "rlpd", "td3", "par", "dara", "vgdf"]
OFFLINE = ("cql", "iql", "td3_bc")  # they use no simulator, so a gap has no effect and one run counts for every gap


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

    alpha_c: NotNegative = option(0.01, "weight of the conservative term, Eq. (1)")
    num_samples: Few = option(10, "next states per row, for the estimate of the KL divergence")


class IQLOptions(Options):
    """``iql``: arguments of TorchRL's IQLLoss, of which others may be added."""

    model_config = ConfigDict(extra="allow")

    expectile: Inside = option(0.7)
    temperature: Positive = option(3.0, "inverse temperature: advantages are multiplied by it")


class CQLOptions(Options):
    """``cql``: arguments of TorchRL's CQLLoss, of which others may be added."""

    model_config = ConfigDict(extra="allow")

    min_q_weight: NotNegative = option(5.0)
    num_random: Few = option(10)


class TD3BCOptions(Options):
    """``td3_bc``: arguments of TorchRL's TD3BCLoss, of which others may be added."""

    model_config = ConfigDict(extra="allow")

    alpha: Positive = option(2.5, "weight of Q over that of the distance to the data's actions")
    critic_penalty: NotNegative = option(0.0, "ReBRAC's beta_2: weight of that distance in the target of Q")


class PAROptions(Options):
    """``par``: the penalty of simulated rewards and the term of behaviour cloning."""

    beta: NotNegative = option(0.1, "penalty per unit of the representation deviation, in the task's reward")
    cloning: Positive = option(5.0, "weight of Q over that of the distance to the real data's actions")


class DARAOptions(Options):
    """``dara``: the correction of simulated rewards."""

    eta: NotNegative = option(0.1, "weight of the log dynamics ratio, in the task's reward per nat")
    clip: Positive = option(10.0, "bound of the log dynamics ratio, nats")


class VGDFOptions(Options):
    """``vgdf``: the filter of simulated rows."""

    share: Annotated[float, Field(gt=0, le=1)] = option(0.25, "share of a batch's simulated rows that Q learns from")
    num_models: Annotated[int, Field(ge=2, le=100)] = option(7, "models of the real dynamics")


class CollectorOptions(Options):
    """``collector``: where the simulators run."""

    model_config = ConfigDict(extra="allow")

    backend: Literal["direct", "process", "ray"] = "direct"
    workers: Few = 1
    resources: dict[str, Any] | None = None
    init: dict[str, Any] | None = None


class AnyMethodOptions(ExperimentOptions):
    """The options of train.py, each by itself."""

    collector: CollectorOptions = CollectorOptions()
    method: Method = option("h2o_plus")
    baselines: list[Method] = option([], "further methods, trained on the same data for comparison, such as [sac]")
    device: DeviceName = option(
        "cpu", "cuda: networks and batches on a GPU, an update a CUDA graph unless compiled=false"
    )

    # Population (method=h2o_plus only): every combination of these lists is trained together in one process
    seeds: Seeds | None = option(None, "null uses the option seed")
    gaps: Gaps | None = option(None, "such as [gravity,friction], each with gap_strength; null uses the option gap")
    mixings: Mixings | None = option(None, "null uses the option mixing")

    # Options of single methods
    h2o: H2OOptions = H2OOptions()
    iql: IQLOptions = IQLOptions()
    cql: CQLOptions = CQLOptions()
    td3_bc: TD3BCOptions = TD3BCOptions()
    par: PAROptions = PAROptions()
    dara: DARAOptions = DARAOptions()
    vgdf: VGDFOptions = VGDFOptions()

    results: str | None = option(
        None, "CSV file to which the run's results are appended; its curve goes to a second file"
    )
    overrides: list[str] | None = option(None, "overrides on the command line of this run; written by the recipe")


class TrainOptions(AnyMethodOptions, RunOptions):
    """Options of train.py, with the relations between them."""

    device: Device = option("cpu", "cuda: networks and batches on a GPU, an update a CUDA graph unless compiled=false")

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

    @property
    def is_population(self) -> bool:
        """Whether several runs are trained together in one process."""
        return self.seeds is not None or self.gaps is not None or self.mixings is not None

    def _check_population(self) -> None:
        if not self.is_population:
            return
        if self.overlap:
            raise ValueError("overlap=true is for single runs: leave it out with a population")
        if self.compiled is True and self.device == "cpu":
            raise ValueError("compiled=true is for single runs: stacked networks are slower with it, leave it out")
        if self.method != "h2o_plus" or self.baselines:
            raise ValueError(
                f"method={self.method} baselines=[{','.join(self.baselines)}]: a population trains h2o_plus alone; "
                "use --multirun for other methods"
            )

    def _check_collector(self) -> None:
        if self.collector.backend == "ray" and find_spec("ray") is None:
            raise ValueError("collector=ray needs Ray: pip install 'torchrl_h2o[ray]', here and where workers run")


class SimToRealOptions(TrainOptions):
    """Options of sim_to_real.py, with the relations between them."""

    rounds: Few = option(5)
    seconds: Positive = option(10.0, "longest run in reality of each round, s")
    randomise: Share = option(0.0, "half width of the range of every number of the model in training, such as 0.2")

    @model_validator(mode="after")
    def _is_one_run(self) -> SimToRealOptions:
        if self.baselines or self.is_population:
            raise ValueError("sim_to_real.py makes one run: leave out baselines, seeds, gaps and mixings")
        if self.randomise and self.mend:
            raise ValueError(f"randomise={self.randomise:g} is for a simulator that is not mended: add mend=false")
        if self.randomise and not self.env.batched:
            raise ValueError(f"randomise needs a batched simulator, and env={self.env.name} is not: env.batched=true")
        return self
