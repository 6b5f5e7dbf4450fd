"""Rounds between a simulator and reality: the return that one predicts and measures, a table and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.data import read_ted, write_ted
from torchrl_h2o.residuals import close_the_loop
from torchrl_h2o.residuals.close_the_loop import FAILURES
from torchrl_h2o.residuals.report.contents import NOTHING_MISSING
from torchrl_h2o.training.environments import preprocessing_of, task_of, unmended_task_of
from torchrl_h2o.training.mending import draws_of, report_of_run
from torchrl_h2o.training.returns import Evaluation, evaluate, run_episode
from torchrl_h2o.whole_file import whole_file

#: Episodes of a prediction. The lowest and the highest of n returns enclose a further one of the same distribution with
#: a probability of (n - 1) / (n + 1).
PREDICTED = 39
PREDICTION_SEED = 3_000_000  # start states and worlds that neither chose the policy nor are those of reality
REALITY_SEED = 4_000_000


@dataclass(frozen=True)
class Round:
    """What one round predicted and measured. Returns are those of one run of at most the round's duration.

    Args:
        seconds: of data from reality that the round used, in s.
        found: effects that were added to the simulator, in words.
        predicted: mean return in the simulated worlds.
        low: lowest of :data:`PREDICTED` returns there.
        high: highest of them; a further return lies between both with a probability of 95 %.
        measured: return in reality.
        lasted: duration of the run in reality, in s.
        lacks: when and where the log of this run differs from the simulator, in words, if the prediction was wrong.
    """

    seconds: float
    found: tuple[str, ...]
    predicted: float
    low: float
    high: float
    measured: float
    lasted: float
    lacks: str | None = None

    @property
    def is_inside(self) -> bool:
        """Whether the measured return lies in the predicted interval."""
        return self.low <= self.measured <= self.high

    def lacking(self, words: str) -> Round:
        """Returns the round with words on what the simulator still lacks."""
        return replace(self, lacks=words)

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"inside": self.is_inside}


def predict_return(cfg: DictConfig, policy: torch.nn.Module, directory: Path) -> Evaluation:
    """Evaluates a policy in worlds that are drawn anew from the round's report, each with its own start.

    Args:
        cfg: the round's configuration. Without ``mend``, the worlds are those of the training.
        policy: the trained policy.
        directory: the round's folder, which contains the report.
    """
    task, report = task_of(cfg), report_of_run(directory)
    if report is not None and task.worlds:
        sheet = unmended_task_of(cfg)
        draws = draws_of(report, sheet, PREDICTED, PREDICTION_SEED)
        task = replace(task, worlds=tuple((*sheet.simulator, *draw) for draw in draws))
    worlds = task.make_training_simulator(PREDICTED, preprocessing_of(cfg))
    return evaluate(worlds, policy, PREDICTED, PREDICTION_SEED)


def run_in_reality(cfg: DictConfig, policy: torch.nn.Module, directory: Path, real: TensorDictBase) -> TensorDictBase:
    """Runs a policy once in reality, and stores the log in the round's folder; reads it if it is there.

    Args:
        cfg: the round's configuration; ``env.make.max_episode_steps`` limits the run.
        policy: the trained policy.
        directory: the round's folder.
        real: the data before this run, ``[T]``, whose entries the log has too.

    Returns:
        Transitions in physical units, ``[T']``.
    """
    if not (directory / "log").exists():
        preprocessing, number = preprocessing_of(cfg), int(real["log"].max()) + 1
        reality = task_of(cfg).make_reality(preprocessing=preprocessing)
        reality.set_seed(REALITY_SEED + number)
        log = run_episode(reality, policy)
        for part in (log, log["next"]):
            part["observation"] = preprocessing.physical(part["observation"], real["observation"].shape[-1]).float()
        log["log"] = torch.full((len(log),), number)
        write_ted(log.select(*real.keys(True, True)), directory / "log")
    return read_ted(directory / "log")


def what_is_lacking(cfg: DictConfig, real: TensorDictBase, log: TensorDictBase) -> str:
    """Says when and where a log differs from what the round's simulator predicts, without a search for effects.

    Args:
        cfg: the round's configuration.
        real: the data before the log, ``[T]``.
        log: transitions of the last run, ``[T']``.
    """
    data, held_out = cast(TensorDictBase, torch.cat([real, log])), [int(log["log"][0])]
    try:
        report = close_the_loop(task_of(cfg).make_simulator(), data, (), source="the last run", held_out=held_out)
    except FAILURES as error:
        return f"its log cannot be compared with the simulator ({error})"
    if report.verdict is None or report.verdict.kind == NOTHING_MISSING:
        return f"its log shows no difference from the simulator. {report.sentence()}"
    return f"the simulator lacks something, {report.verdict.where or '; '.join(report.verdict.reasons)}"


def table_of_rounds(rounds: Sequence[Round]) -> str:
    """Formats a line for each round, and under it what was found or is lacking."""
    lines = [f"\n{'reality used':>12}  {'predicted return [95 %]':>34}  {'measured':>10}  {'lasted':>8}"]
    for one in rounds:
        interval = f"{one.predicted:,.0f} [{one.low:,.0f}, {one.high:,.0f}]"
        verdict = "" if one.is_inside else "  outside"
        lines.append(f"{one.seconds:>10.1f} s  {interval:>34}  {one.measured:>10,.0f}  {one.lasted:>6.1f} s{verdict}")
        lines.append(f"{'':>14}found: {'; '.join(one.found) or 'nothing'}")
        if one.lacks:
            lines.append(f"{'':>14}outside: {one.lacks}")
    return "\n".join(lines)


def draw_rounds(path: Path, rounds: Sequence[Round], title: str) -> None:
    """Draws the predicted interval and the measured return of each round, with what was found under it.

    Args:
        path: PNG file to write.
        rounds: in their order.
        title: of the figure.
    """
    figure = Figure((2.2 + 2.2 * len(rounds), 4.8), layout="constrained")
    axis, places = figure.subplots(), range(len(rounds))
    means = [one.predicted for one in rounds]
    errors = [[one.predicted - one.low for one in rounds], [one.high - one.predicted for one in rounds]]
    axis.errorbar(places, means, errors, fmt="_", color="#3d5a98", capsize=6, lw=2, label="predicted, 95 % interval")
    axis.plot(places, [one.measured for one in rounds], "o", color="#0b6e4f", label="measured in reality")
    labels = ["\n".join([f"{one.seconds:.1f} s", *one.found]) for one in rounds]
    axis.set_xticks(places, labels, fontsize=7)
    axis.set(xlabel="reality used, and what was found in it", ylabel="return of a run", title=title)
    axis.set_xlim(-0.5, len(rounds) - 0.5)
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=8, loc="outside upper right", ncols=2)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)
