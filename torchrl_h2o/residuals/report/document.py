"""The report as a document: its sentence, its JSON file and its page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase, TransformedEnv

from torchrl_h2o.effects import ActionEffect, Effect
from torchrl_h2o.envs import DynamicsGap
from torchrl_h2o.envs.dynamics_gap import transforms_of
from torchrl_h2o.residuals.report.contents import ReportContents
from torchrl_h2o.residuals.report.json_file import entries_from_json, read_json, report_to_json, write_json
from torchrl_h2o.residuals.report.page import write_page
from torchrl_h2o.residuals.report.sampling import sample
from torchrl_h2o.residuals.report.sentence import sentence
from torchrl_h2o.whole_file import whole_files


@dataclass(frozen=True, kw_only=True)
class Report(ReportContents):
    """Result of closing the loop; :meth:`mended` mends the simulator.

    The fields are those of :class:`ReportContents`.

    Examples:
        >>> from torchrl_h2o.effects import Gravity
        >>> from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect
        >>> from torchrl_h2o.residuals.report.errors import ErrorSummary
        >>> found = FoundEffect(Gravity(0.5), declared=True, ci95={"scale": (0.49, 0.51)}, error_after=0.004)
        >>> report = Report(
        ...     simulator="pendulum.xml",
        ...     data=DataSummary("swing.csv", transitions=5000, held_out=1500),
        ...     error=ErrorSummary("held-out one-step RMSE", "rad/s", before=0.031, after=0.004, floor=0.003),
        ...     found=(found,),
        ... )
        >>> report.sentence()
        'Your simulator lacks: gravity × 0.5; one-step error 0.031 → 0.004 rad/s (−87 %), floor 0.003.'
        >>> report.effects
        (Gravity(scale=0.5),)
    """

    def sentence(self) -> str:
        """The result in words: one sentence, and a further one for each qualification."""
        return sentence(self)

    def mended(self, env: EnvBase) -> TransformedEnv:
        """Puts the effects found into an env of the simulator that the report is about.

        Args:
            env: the simulator: a GymEnv of a MuJoCo task or a :class:`~torchrl_h2o.envs.WheelLeggedEnv`, with the
                dynamics gaps that it had when the loop was closed. The env must not be used by itself afterwards,
                because its model is replaced.

        Returns:
            The env with ``DynamicsGap(*report.effects)``; without effects, the env with a gap that changes nothing.

        Raises:
            ValueError: if the model has no element that an effect could act on, if the env is batched or does not run
                on MuJoCo, if it has transforms other than dynamics gaps and an effect alters actions or observations,
                or if an effect and a gap of the env both alter actions, because the gap would come second.

        Examples:
            >>> from torchrl.envs import GymEnv
            >>> from torchrl_h2o.effects import Gravity
            >>> from torchrl_h2o.envs import mujoco_model
            >>> from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect
            >>> found = FoundEffect(Gravity(0.5), declared=True, ci95={"scale": (0.49, 0.51)}, error_after=0.004)
            >>> report = Report(simulator="HalfCheetah-v5", data=DataSummary("run.csv", 5000, 1500), found=(found,))
            >>> env = report.mended(GymEnv("HalfCheetah-v5"))
            >>> float(mujoco_model(env).opt.gravity[2])
            -4.905
            >>> env.rollout(3)["next", "reward"].shape
            torch.Size([3, 1])
        """
        own = [effect for gap in transforms_of(env) if isinstance(gap, DynamicsGap) for effect in gap.effects]
        if all(any(isinstance(effect, ActionEffect) for effect in effects) for effects in (own, self.effects)):
            raise ValueError(
                "a gap of the env and an effect of the report both alter actions, and the gap has to come first: put "
                "both into one gap of a new env, TransformedEnv(env, DynamicsGap(*gap.effects, *report.effects))"
            )
        return TransformedEnv(env, DynamicsGap(*self.effects))

    def sample(self, n: int, *, seed: int = 0) -> list[tuple[Effect, ...]]:
        """Draws lists of effects from what the data leave open, for domain randomisation.

        Each draw chooses an explanation: the effects found, those with one of them replaced by an alternative, as they
        were fitted together, or another set of effects. All explanations have the same weight, because the search's
        test found none of them worse than the first at its level; a likelihood computed from their errors would treat
        successive rows as independent and decide by differences that are smaller than the scatter between blocks of
        the data. Then each
        parameter with a 95 % interval is drawn from a normal distribution around the fitted value with this interval,
        truncated to the parameter's bounds. Parameters are drawn independently, because a report has no covariances; a
        parameter without an interval keeps its value.

        Args:
            n: number of draws.
            seed: the same seed gives the same draws; the first draws do not depend on n.

        Returns:
            n tuples of effects, each for one simulator; empty tuples if the report contains no effects.

        Raises:
            ValueError: for a negative n.

        Examples:
            >>> from torchrl_h2o.effects import Gravity
            >>> from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect
            >>> found = FoundEffect(Gravity(0.5), declared=True, ci95={"scale": (0.45, 0.55)}, error_after=0.004)
            >>> report = Report(simulator="pendulum.xml", data=DataSummary("swing.csv", 5000, 1500), found=(found,))
            >>> [0.4 < gravity.scale < 0.6 for (gravity,) in report.sample(3)]
            [True, True, True]
        """
        return sample(self, n, seed=seed)

    def to_json(self) -> dict[str, Any]:
        """The contents of ``report.json``; numbers that are not finite become None."""
        return report_to_json(self)

    @classmethod
    def from_json(cls, entries: Mapping[str, Any]) -> Report:
        """The report whose :meth:`to_json` returned these entries.

        Raises:
            KeyError, TypeError, ValueError, AttributeError, IndexError: if the entries are not those of a report.
        """
        return cls(**entries_from_json(entries))

    def save(self, folder: str | Path) -> Path:
        """Writes ``report.json`` and ``report.html``.

        Args:
            folder: created if it does not exist.

        Returns:
            The path of ``report.json``.
        """
        with whole_files(folder) as files:
            path = write_json(self, files)
            write_page(self, files)
        return Path(folder) / path.name

    @classmethod
    def load(cls, path: str | Path) -> Report:
        """Reads a report.

        Args:
            path: ``report.json``, or the folder that contains it.

        Returns:
            The report with its trace thinned; numbers that were not finite are None or NaN.

        Raises:
            DataError: if there is no such file, or it is not a report.
        """
        return read_json(path, cls.from_json)
