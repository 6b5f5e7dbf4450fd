"""Options of a run, recipes/config/experiment.yaml and env/*.yaml."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import gymnasium
from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from torchrl_h2o.options.sources import AnyPath, Data, Layout, RunFolder
from torchrl_h2o.options.types import (
    Count,
    Gap,
    Inside,
    NotNegative,
    Options,
    Positive,
    Rows,
    Seed,
    Share,
    Trust,
    Widths,
    has_bf16,
)

POSTERIOR_WORLDS = 10  # smallest number of worlds with mend=posterior; each of them has one draw for the whole run


class MakeOptions(Options):
    """``env.make``: the class of an environment and its arguments, of which only some are known here."""

    model_config = ConfigDict(extra="allow")

    target: str = Field(alias="_target_")
    env_name: str | None = None
    max_episode_steps: Count | None = None

    @field_validator("env_name")
    @classmethod
    def _is_registered(cls, name: str | None, info: ValidationInfo) -> str | None:
        # Gymnasium itself completes names without a version, and imports the module in module:name
        if name is None or ":" in name or "-v" not in name or not str(info.data.get("target")).endswith("GymEnv"):
            return name
        try:
            gymnasium.spec(name)
        except gymnasium.error.Error as error:  # unknown, or a version that Gymnasium has removed
            raise ValueError(str(error).replace("`", "")) from None
        return name


class RecordingOptions(Options):
    """``env.recording``: how real data are recorded with ``data=recorded``."""

    num_transitions: Count
    seed: Seed


class EnvOptions(Options):
    """``env``: files in env/*.yaml, also those of users, which may have further entries."""

    model_config = ConfigDict(extra="allow")

    name: str
    make: MakeOptions
    simulator: list[dict[str, Any]]
    reality: list[dict[str, Any]]
    seconds_per_step: Positive
    batched: bool = False
    recording: RecordingOptions | None = None


class NormOptions(Options):
    """``observation_norm``: mean and standard deviation of each entry of the observation."""

    loc: list[float]
    scale: list[Positive]


class ExperimentOptions(Options):
    """The options that all methods share, each by itself."""

    env: EnvOptions
    seed: Seed
    gap: Gap | None
    gap_strength: float | None
    gap_fix: AnyPath | None
    mend: bool | Literal["posterior"] | None
    mended: dict[str, Any] | None
    data: Data
    columns: Layout | None
    data_seconds: Positive | None

    backbone: Literal["expectile", "sparse", "exponential"]
    expectile: Inside
    value_alpha: Positive
    mixing: Share
    ratio: bool
    ratio_estimator: Literal["paper", "change", "pairs"]
    input_noise: NotNegative
    change_noise: Literal["auto"] | NotNegative
    ratio_weight_penalty: NotNegative
    ratio_logit_bound: Positive | None

    updates: Count
    steps_per_epoch: Count
    num_worlds: Count
    updates_per_epoch: Count
    batch_size: Rows
    discriminator_batch_size: Rows
    sim_capacity: Positive
    sim_capacity_min: Count

    n_steps: Count
    gamma: Share
    num_cells: Widths
    layer_norm: bool
    num_qvalue_nets: Count
    lr: Positive
    lr_end_factor: Share
    tau: Annotated[float, Field(gt=0, le=1)]
    target_entropy: Literal["auto"] | float
    compiled: Literal["auto"] | bool | None
    precision: Literal["float32", "bf16"] = "float32"
    threads: Count

    reward_offset: float
    reward_scale: float
    normalise_observation: bool
    observation_norm: NormOptions | None
    frames: Count
    action_history: Annotated[int, Field(ge=0)] = 0

    eval_every: Count
    eval_episodes: Count
    overlap: bool = False
    keep: Literal["last", "best_in_simulator"]
    trial_episodes: Count = 10
    final_episodes: Count
    checkpoint_every: Count
    render: bool
    resume: RunFolder | None = None
    trust: Trust = False


class RunOptions(ExperimentOptions):
    """Options of h2o_plus.py, with the relations between them."""

    @model_validator(mode="after")
    def _fit_together(self) -> RunOptions:
        self._check_gap()
        self._check_steps()
        self._check_mending()
        self._check_precision()
        return self

    @property
    def worlds(self) -> int:
        """Number of worlds in which transitions are collected, in each worker."""
        return max(self.num_worlds, POSTERIOR_WORLDS) if self.mend == "posterior" else self.num_worlds

    @property
    def streams(self) -> int:
        """Number of worlds that share the steps of an epoch."""
        return self.worlds

    @property
    def _typed_streams(self) -> str:
        """The options that determine ``streams``, as typed on the command line."""
        return f"{'mend=posterior ' * (self.mend == 'posterior')}num_worlds={self.worlds}"

    def _check_gap(self) -> None:
        if self.gap is None and self.gap_strength is not None:
            raise ValueError(f"gap_strength={self.gap_strength} belongs to a gap: name one, such as gap=gravity")

    def _check_steps(self) -> None:
        per_world, rest = divmod(self.steps_per_epoch, self.streams)
        if rest:  # the collector would round up
            raise ValueError(
                f"{self._typed_streams}: steps_per_epoch={self.steps_per_epoch} must be a multiple of {self.streams}, "
                "because all worlds share the steps equally"
            )
        if not self.n_steps < max(2, per_world):
            raise ValueError(
                f"n_steps={self.n_steps}: must be from 1 to {max(1, per_world - 1)}, less than the {per_world} steps "
                f"of each world in an epoch (steps_per_epoch={self.steps_per_epoch} of num_worlds={self.streams})"
            )

    def _check_precision(self) -> None:
        if self.precision == "bf16" and not has_bf16():
            raise ValueError(
                "precision=bf16: this processor has no bfloat16 instructions; choose float32, which is faster on it"
            )

    def _check_mending(self) -> None:
        if not self.mend:
            return
        if self.gap_fix is not None:
            raise ValueError(
                f"gap_fix={self.gap_fix} mend={str(self.mend).lower()}: gap_fix takes the effects from a report, mend "
                "searches for them in the run's own data; leave one of them out"
            )
        if self.mend == "posterior" and not self.env.batched:
            raise ValueError(
                "mend=posterior gives each world of a batched simulator its own effects, and "
                f"env={self.env.name} is not batched: use mend=true, or set env.batched=true for a Gymnasium MuJoCo "
                "task"
            )
