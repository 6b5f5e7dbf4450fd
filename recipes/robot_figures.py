"""The paper's Figures 3 and 4: how the wheel-legged robot moves in reality, and where it was in the simulator."""

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from environments import as_observed, make_reality
from evaluate import load_policy
from evaluation import run_episode
from learning_curve import COLOURS
from methods import METHODS
from omegaconf import DictConfig
from real_data import read_real_data
from results_file import read_rows
from run import checkpoint_folder, load_config
from torchrl.checkpoint import Checkpoint, CheckpointRotation

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.envs.wheel_legged import OBSERVATIONS, TARGET_VELOCITY

SHOWN = {"standing_still": ("x", "displacement (m)"), "moving_forward": ("v", "velocity (m/s)")}
EVERY = 0.2  # s, between two rows of the CSV
SEED = 1_000_000  # that of the runs' own tables


def draw_robot(runs: Path, results: Path, to: Path) -> None:
    """Draws Figure 3 of the trajectories that the CSV holds and Figure 4 of the runs' simulated data.

    Args:
        runs: the folder of the group's runs; its policies' trajectories are added to the CSV.
        results: the folder of wheel_legged_trajectories.csv.
        to: where the pictures go.
    """
    recorded = results / "wheel_legged_trajectories.csv"
    folders = sorted(summary.parent for summary in runs.glob("*/summary.json"))
    rows = _with_new(read_rows(recorded), folders)
    if rows:
        _write(recorded, rows)
        draw_trajectories(to / "wheel_legged_trajectories.png", rows)
    spreads = {(cfg.env.make.task, cfg.method, cfg.seed): simulated_states(cfg, f) for f, cfg in _hybrid(folders)}
    if spreads:
        draw_diversity(to / "wheel_legged_diversity.png", spreads)


def _with_new(rows: list[dict], folders: list[Path]) -> list[dict]:
    there = {(row["task"], row["method"], row["seed"], row["updates"]) for row in rows}
    for folder in folders:
        cfg = load_config(folder)
        who = {"task": cfg.env.make.task, "method": cfg.method, "seed": str(cfg.seed), "updates": str(cfg.updates)}
        if tuple(who.values()) not in there:
            rows += [who | point for point in trajectory(cfg, folder)]
    return rows


def trajectory(cfg: DictConfig, folder: Path) -> list[dict[str, float]]:
    """What the run's policy does in the first episode of its table, from standing upright until it ends or falls."""
    env = make_reality(cfg, 1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        env.set_seed(SEED)
        episode = run_episode(env, load_policy(cfg, folder, METHODS[cfg.method].title))
    values = _in_units(cfg, episode["next", "observation"].flatten(0, -2), SHOWN[cfg.env.make.task][:1])[:, 0].tolist()
    step = round(EVERY / cfg.env.seconds_per_step)
    kept = sorted({*range(step - 1, len(values), step), len(values) - 1})
    return [{"t": round((i + 1) * cfg.env.seconds_per_step, 3), "value": round(values[i], 4)} for i in kept]


def _write(path: Path, rows: list[dict]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, ["task", "method", "seed", "updates", "t", "value"])
        writer.writeheader()
        writer.writerows(rows)


def draw_trajectories(path: Path, rows: list[dict]) -> None:
    """Figure 3: displacement standing still and velocity moving forward; a line a run, a cross where it fell."""
    tasks = [task for task in SHOWN if any(row["task"] == task for row in rows)]
    figure, axes = plt.subplots(1, len(tasks), figsize=(6 * len(tasks), 3.8), layout="constrained", squeeze=False)
    for axis, task in zip(axes[0], tasks, strict=True):
        of_task = [row for row in rows if row["task"] == task]
        for method in METHODS:
            runs = sorted({(row["seed"], row["updates"]) for row in of_task if row["method"] == method})
            for run in runs:
                line = [r for r in of_task if r["method"] == method and (r["seed"], r["updates"]) == run]
                _draw_run(axis, line, METHODS[method].title, labelled=run == runs[0])
        if task == "moving_forward":
            axis.axhline(TARGET_VELOCITY, color="0.4", ls="--", lw=1, label="target")
        axis.set(xlabel="time (s)", ylabel=SHOWN[task][1], title=task.replace("_", " "), xlim=(0, 30))
        axis.set_ylim(-2.5, 2.5)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    told = {}  # of all panels: a method may not have done every task yet
    for axis in axes.flat:
        handles, labels = axis.get_legend_handles_labels()
        told |= dict(zip(labels, handles, strict=True))
    first = [METHODS[name].title for name in METHODS]
    labels = sorted(told, key=lambda label: first.index(label) if label in first else len(first))
    beside = {"loc": "upper left", "bbox_to_anchor": (1, 1)}
    axes[0, -1].legend([told[label] for label in labels], labels, frameon=False, **beside)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_run(axis: plt.Axes, line: list[dict], title: str, labelled: bool) -> None:
    t, value = ([float(row[key]) for row in line] for key in ("t", "value"))
    colour = COLOURS.get(title)
    axis.plot(t, value, color=colour, lw=1.2, alpha=0.8, label=title if labelled else None)
    if t[-1] < 29.9:
        axis.plot(t[-1], np.clip(value[-1], -2.4, 2.4), "x", color=colour)


def _hybrid(folders: list[Path]) -> list[tuple[Path, DictConfig]]:
    """The runs of H2O and of H2O+, whose simulated data the paper compares."""
    return [(f, cfg) for f in folders if (cfg := load_config(f)).method in ("h2o", "h2o_plus")]


def simulated_states(cfg: DictConfig, folder: Path) -> np.ndarray:
    """Pitch (rad) and pitch rate (rad/s) of the simulated transitions that the run ended with, ``[N, 2]``."""
    real = as_observed(cfg, read_real_data(cfg))
    replay = HybridReplayBuffer(real, sim_capacity=int(cfg.sim_capacity * len(real)), batch_size=cfg.batch_size)
    title = METHODS[cfg.method].title
    Checkpoint(replay=replay).load(CheckpointRotation(checkpoint_folder(folder, title), keep_last=1).latest())
    return _in_units(cfg, replay.sim[:]["observation"], ("theta", "theta_dot")).numpy()


def _in_units(cfg: DictConfig, observation: torch.Tensor, wanted: Sequence[str]) -> torch.Tensor:
    """Some dimensions of what a learner observed ``[N, n]``, of the last of its frames and in their own units."""
    names = OBSERVATIONS[cfg.env.make.task]
    last = observation[:, -len(names) :].double()
    if cfg.observation_norm is not None:
        last = last * torch.tensor(list(cfg.observation_norm.scale)) + torch.tensor(list(cfg.observation_norm.loc))
    return last[:, [names.index(name) for name in wanted]]


def draw_diversity(path: Path, spreads: dict[tuple[str, str, int], np.ndarray]) -> None:
    """Figure 4: where in pitch and pitch rate the simulated data lie, and over how many nats they spread."""
    tasks = [task for task in SHOWN if any(key[0] == task for key in spreads)]
    methods = ("h2o", "h2o_plus")
    figure, axes = plt.subplots(
        len(tasks), 2, figsize=(9, 3.6 * len(tasks)), layout="constrained", squeeze=False, sharex=True, sharey=True
    )
    for row, task in zip(axes, tasks, strict=True):
        for axis, method in zip(row, methods, strict=True):
            runs = [states for key, states in sorted(spreads.items()) if key[:2] == (task, method)]
            if not runs:
                axis.set_visible(False)
                continue
            shown = np.concatenate(runs)
            axis.hist2d(shown[:, 0], shown[:, 1], bins=BINS, norm="log", cmap="viridis")
            entropies = ", ".join(f"{spread_entropy(states):.2f}" for states in runs)
            title = f"{METHODS[method].title}, {task.replace('_', ' ')}: entropy {entropies} nats"
            axis.set(title=title, xlabel="pitch (rad)", ylabel="pitch rate (rad/s)")
            axis.title.set_fontsize(9)
    figure.savefig(path, dpi=130)
    plt.close(figure)


BINS = (np.linspace(-0.55, 0.55, 56), np.linspace(-8.0, 8.0, 65))


def spread_entropy(states: np.ndarray) -> float:
    """Entropy (nats) of the histogram of states ``[N, 2]``: the logarithm of how many cells they fill evenly."""
    counts, *_ = np.histogram2d(states[:, 0], states[:, 1], bins=BINS)
    share = counts[counts > 0] / counts.sum()
    return float(-(share * np.log(share)).sum())
