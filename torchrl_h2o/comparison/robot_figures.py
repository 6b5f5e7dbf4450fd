"""Draws the paper's Figures 3 and 4: the robot's motion in reality, and the states visited in the simulator."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_h2o.comparison.figures import save_figure
from torchrl_h2o.comparison.robot_trajectories import BINS, COMPARED, EVERY, SHOWN, spread_entropy
from torchrl_h2o.envs.wheel_legged.env import TARGET_VELOCITY
from torchrl_h2o.training.learning_curve import COLOURS
from torchrl_h2o.training.methods import METHODS

LIMITS = {"standing_still": (-1.0, 1.0), "moving_forward": (-0.5, 1.0)}
LABELS = {"standing_still": "displacement (m)", "moving_forward": "velocity (m/s)"}


def draw_robot(to: Path, results: Mapping[str, Mapping[tuple[str, str], list[np.ndarray]]]) -> None:
    """Draw wheel_legged_trajectories.png and wheel_legged_diversity.png.

    Args:
        to: folder to write to.
        results: from :func:`~torchrl_h2o.comparison.robot_trajectories.robot_results`.
    """
    if results["way"]:
        draw_trajectories(to / "wheel_legged_trajectories.png", results["way"])
    if results["states"]:
        draw_diversity(to / "wheel_legged_diversity.png", results["states"])


def draw_trajectories(path: Path, ways: Mapping[tuple[str, str], list[np.ndarray]]) -> None:
    """Draw Figure 3: displacement or velocity over time, one line per episode, with a cross where the robot fell.

    Args:
        path: PNG file to write.
        ways: trajectories ``[episodes, T]`` of each run, m or m/s, by task and method.
    """
    tasks = [task for task in SHOWN if any(key[0] == task for key in ways)]
    methods = [name for name in METHODS if any(key[1] == name for key in ways)]
    figure = Figure((2.6 * len(methods) + 0.8, 2.8 * len(tasks) + 0.3), layout="constrained")
    axes = figure.subplots(len(tasks), len(methods), sharex=True, sharey="row", squeeze=False)
    for row, task in zip(axes, tasks, strict=True):
        for axis, method in zip(row, methods, strict=True):
            runs = ways.get((task, method), [])
            for run in runs:
                for value in run:
                    _draw_episode(axis, value, LIMITS[task], COLOURS.get(METHODS[method].title))
            aim = TARGET_VELOCITY if task == "moving_forward" else 0.0
            axis.axhline(aim, color="0.4", ls="--", lw=1, zorder=1)
            axis.set(xlim=(0, 30), ylim=LIMITS[task])
            axis.set_title(f"{METHODS[method].title}, {len(runs)} run{'s' * (len(runs) != 1)}", fontsize=9)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        row[0].set_ylabel(f"{task.replace('_', ' ')}\n{LABELS[task]}")
    for axis in axes[-1]:
        axis.set_xlabel("time (s)")
    figure.suptitle("In reality: one line per episode; ×: the robot fell; dashed line: target", fontsize=9)
    save_figure(figure, path)


def _draw_episode(axis: Axes, value: np.ndarray, limits: tuple[float, float], colour: str | None) -> None:
    t = EVERY * np.arange(1, len(value) + 1)
    axis.plot(t, value, color=colour, lw=1.0, alpha=0.6)
    stands = np.flatnonzero(~np.isnan(value))
    if len(stands) < len(value) and len(stands):
        axis.plot(t[stands[-1]], np.clip(value[stands[-1]], *limits), "x", color=colour, ms=5, clip_on=False)


def draw_diversity(path: Path, states: Mapping[tuple[str, str], list[np.ndarray]]) -> None:
    """Draw Figure 4: histogram of pitch and pitch rate in the simulated data, with its entropy.

    Args:
        path: PNG file to write.
        states: histograms ``[pitch, pitch rate]`` of each run, by task and method.
    """
    tasks = [task for task in SHOWN if any(key[0] == task for key in states)]
    figure = Figure((9, 3.6 * len(tasks)), layout="constrained")
    axes = figure.subplots(len(tasks), len(COMPARED), sharex=True, sharey=True, squeeze=False)
    most = max(cast(np.ndarray, sum(runs)).max() for runs in states.values())
    for row, task in zip(axes, tasks, strict=True):
        for axis, method in zip(row, COMPARED, strict=True):
            runs = states.get((task, method), [])
            if not runs:
                axis.set_visible(False)
                continue
            seen = np.ma.masked_equal(sum(runs), 0).T
            drawn = axis.pcolormesh(*BINS, seen, norm="log", vmin=1, vmax=most, cmap="viridis")
            entropies = ", ".join(f"{spread_entropy(run):.2f}" for run in runs)
            title = f"{METHODS[method].title}, {task.replace('_', ' ')}: entropy {entropies} nats"
            axis.set_title(title, fontsize=9)
            axis.set(xlabel="pitch (rad)", ylabel="pitch rate (rad/s)")
    figure.colorbar(drawn, ax=axes, label="simulated transitions, all runs")
    save_figure(figure, path)
