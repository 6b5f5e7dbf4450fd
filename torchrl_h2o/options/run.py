"""Options of a run: type, bounds, default value and meaning, one line each.

The default values are those of the authors' published code, except for ``n_steps`` and ``layer_norm``, which
``preset=paper`` sets to the authors' values too. An environment's file env/*.yaml can set different ones.

Hydra stays for what it composes: environments, presets, sweeps and launchers. Its ConfigStore holds the default values
of these models (see :mod:`torchrl_h2o.options.defaults`), so that an option is one line here and no second one in YAML.
tyro and jsonargparse would add a second parser beside it, with messages that neither name the allowed values of a gap
or a file nor suggest the nearest name.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import gymnasium
from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from torchrl_h2o.options.sources import Data, Layout, Mend, RunFolder, WarmStart
from torchrl_h2o.options.types import (
    MOST,
    Count,
    Few,
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
    option,
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
    seed: Seed = option(0)
    gap: Gap | None = option(None, "dynamics gap of the paper for the simulator")
    gap_strength: float | None = option(None, "strength of the gap; null for the paper's")
    mend: Mend | None = option(None, "adds effects that the simulator lacks, draws of them, or those of a report")
    mended: dict[str, Any] | None = option(None, "these effects; written by the run")
    data: Data = option("recorded", "recorded, Minari name, D4RL file, robot's log or TED folder; several: [a,b]")
    columns: Layout | None = option(None, "YAML file that describes a log's columns, or a name of the library's")
    data_seconds: Positive | None = option(None, "only the first seconds of the real data, s; null uses all")
    warm_start: WarmStart = option(False, "begins at the data's behaviour, or a run's policy, held for 1,000 updates")

    # H2O+
    backbone: Literal["expectile", "sparse", "exponential"] = option("expectile", "value loss: IQL's, SQL's or EQL's")
    expectile: Inside = option(0.7, "tau of the expectile backbone, IQL's own; the authors' robot script has 0.9")
    value_alpha: Positive = option(1.0, "alpha of sparse and exponential, in units of the scaled return")
    mixing: Share = option(0.1, "lambda of Eq. (7)")
    ratio: bool = option(True, "whether simulated rows are weighted by the dynamics ratio")
    ratio_estimator: Literal["paper", "change", "pairs"] = option("paper", "see torchrl_h2o/training/ratio.py")
    input_noise: NotNegative = option(0.1, "paper: standard deviation of the noise on the discriminators' inputs")
    change_noise: Literal["auto"] | NotNegative = option("auto", "change, pairs: noise on s' - s; auto: 1, 0.05")
    ratio_weight_penalty: NotNegative = option(2e-3, "pairs: L2 penalty of the discriminator's weights")
    ratio_logit_bound: Positive | None = option(4.0, "change, pairs: bound of each logit given (s, a, s')")

    # Budget: steps_per_epoch simulator steps, then updates_per_epoch updates, repeated
    updates: Count = option(1_000_000, "updates of the networks, rounded up to whole epochs")
    steps_per_epoch: Count = option(1000, "simulator steps between two blocks of updates, of all worlds together")
    num_worlds: Few = option(1, "simulator worlds that are stepped at once")
    updates_per_epoch: Count = option(1000)
    batch_size: Rows = option([128, 128], "real, simulated")
    discriminator_batch_size: Rows = option([256, 256], "real, simulated")
    sim_capacity: Positive = option(10.0, "size of the simulated buffer, in multiples of the real transitions")
    sim_capacity_min: Count = option(100_000, "smallest size of the simulated buffer, for runs with little real data")

    # Targets of Q
    n_steps: Count = option(5, "rewards that are summed before the bootstrap; 1 is Eq. (7) of the paper")
    gamma: Share = option(0.99)

    # Networks and optimiser
    num_cells: Widths = option([256, 256], "hidden layers")
    layer_norm: bool = option(True, "layer normalisation in Q")
    num_qvalue_nets: Few = option(2, "ensemble of Q; targets use its minimum")
    lr: Positive = option(3e-4)
    lr_end_factor: Share = option(1.0, "final learning rate as a fraction of lr; it changes linearly")
    tau: Annotated[float, Field(gt=0, le=1)] = option(0.005, "weight of the online networks in an update of targets")
    target_entropy: Literal["auto"] | float = option("auto", "in nats; auto is -dim(A)")
    compiled: Literal["auto"] | bool = option("auto", "torch.compile: true, false, or auto (from 10,000 updates on)")
    threads: Count = option(2, "number of threads of torch")

    # Preprocessing
    reward_offset: float = option(0.0, "the reward in the losses is reward_scale * (reward + reward_offset)")
    reward_scale: float = option(1.0)
    normalise_observation: bool = option(False, "standardises observations with the real data's mean and std")
    observation_norm: NormOptions | None = option(None, "{loc: [...], scale: [...]} for that; null measures them")
    frames: Few = option(1, "number of successive observations that are stacked")
    action_history: Annotated[int, Field(ge=0, le=MOST)] = option(0, "number of past actions beside the observations")

    # Evaluation and files
    eval_every: Count = option(10, "epochs")
    eval_episodes: Few = option(5)
    overlap: bool = option(False, "whether a second process evaluates during the next updates (same results)")
    keep: Literal["last", "best_in_simulator"] = option("last", "policy that the run returns; the latter for mend=true")
    trial_episodes: Few = option(10, "best_in_simulator: episodes of each policy in the simulator")
    final_episodes: Few = option(5)
    checkpoint_every: Count = option(1, "epochs")
    render: bool = option(True, "whether to film the policy, where MuJoCo can render")
    resume: RunFolder | None = option("???", "folder of an interrupted run")
    trust: Trust = option(
        False, "with resume: foreign names in the folder's config.yaml whose code is run: read it first"
    )


class RunOptions(ExperimentOptions):
    """Options of h2o_plus.py, with the relations between them."""

    @model_validator(mode="after")
    def _fit_together(self) -> RunOptions:
        self._check_gap()
        self._check_steps()
        self._check_mending()
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
        return f"{'mend=posterior ' * (self.worlds > self.num_worlds)}num_worlds={self.worlds}"

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

    def _check_mending(self) -> None:
        if self.mend == "posterior" and not self.env.batched:
            raise ValueError(
                "mend=posterior gives each world of a batched simulator its own effects, and "
                f"env={self.env.name} is not batched: use mend=true, or set env.batched=true for a Gymnasium MuJoCo "
                "task"
            )
