"""Draws learning_curve.png of a run: returns in reality over the updates, and the discriminators' accuracy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from torchrl_h2o.training.returns import Evaluation
from torchrl_h2o.training.task import Task
from torchrl_h2o.whole_file import whole_file

COLOURS = {
    "H2O+": "#0b6e4f",
    "H2O": "#5aa9a3",
    "SAC in the simulator": "#c8553d",
    "DARC": "#e0a458",
    "IQL": "#3d5a98",
    "CQL": "#8a6fae",
    "RLPD": "#7a7a7a",
    "weighted TD3": "#a3a3a3",
}


BELOW = {"frameon": False, "loc": "upper center", "bbox_to_anchor": (0.5, -0.13), "ncols": 2, "fontsize": 8}


class Trained(Protocol):
    """A finished training: metrics, number of updates and speed."""

    @property
    def rows(self) -> list[dict]: ...

    @property
    def updates(self) -> int: ...

    @property
    def updates_per_second(self) -> float: ...


def draw_learning_curve(path: Path, trainings: Mapping[str, Trained], behaviour: Evaluation, task: Task) -> None:
    """Draws learning_curve.png from the trainings' metrics; a dashed line shows the mean return in the data.

    Args:
        path: PNG file to write.
        trainings: by method; the right panel shows the discriminators of the first.
        behaviour: returns of the episodes in the data.
        task: the task, for the title and the length of episodes.
    """
    figure = Figure((11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for name, training in trainings.items():
        updates, mean, std = (
            [row[key] for row in training.rows] for key in ("updates", "return_real", "return_real_std")
        )
        colour = COLOURS.get(name)
        left.plot(updates, mean, "o-", ms=3, color=colour, label=name)
        left.fill_between(
            updates,
            *([m + s * d for m, d in zip(mean, std, strict=True)] for s in (-1, 1)),
            color=colour,
            alpha=0.2,
            lw=0,
        )
    top = max([*(max(row["return_real"] for row in t.rows) for t in trainings.values()), behaviour.mean])
    if 0 < top < -left.get_ylim()[0]:  # very negative returns would compress all other curves
        left.set_ylim(-0.25 * top, 1.1 * top)
        left.text(0.01, 0.01, "lower returns are cut off", transform=left.transAxes, fontsize=8, color="0.4")
    left.axhline(behaviour.mean, color="0.4", ls="--", lw=1, label=_label_of(behaviour, task))
    gap = f", simulator with {task.gap}" if task.gap else ""
    left.set(xlabel="updates", ylabel="return in reality", title=f"{task.name}{gap}")
    left.legend(**BELOW)

    _draw_discriminators(right, next(iter(trainings.values())).rows)
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=150)


def _label_of(behaviour: Evaluation, task: Task) -> str:
    """Label of the data's line. It states the episode length in the data if that exceeds the policies' time limit."""
    longest = task.max_episode_steps
    if longest is None or behaviour.mean_length <= longest:
        return "the data's behaviour"
    return f"the data's behaviour (episodes of {behaviour.mean_length * task.seconds_per_step:.0f} s)"


def _draw_discriminators(axis: Axes, rows: list[dict]) -> None:
    """Draws accuracy of the discriminators and mean ratio; hides the panel for a method without discriminators."""
    updates = [row["updates"] for row in rows]
    lines = [
        ("accuracy_sa", "o-", None, "accuracy on (s, a)"),
        ("accuracy", "o-", None, "accuracy on (s, a, s')"),
        ("ratio_of_sim", "s--", "0.4", "mean ratio of simulated rows"),
    ]
    lines = [line for line in lines if line[0] in rows[0]]
    if not lines:
        axis.set_visible(False)
        return
    for key, style, colour, label in lines:
        axis.plot(updates, [row[key] for row in rows], style, ms=3, color=colour, label=label)
    axis.set(xlabel="updates", ylim=(0, 1.02), title="real or simulated? (accuracy 0.5: chance)")
    axis.legend(**BELOW)
