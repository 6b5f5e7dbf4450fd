"""The short table at the end of a run."""

import os
from pathlib import Path

from omegaconf import DictConfig

from torchrl_h2o.training.returns import Evaluation


def print_table(cfg: DictConfig, in_reality: dict[str, Evaluation], directory: Path, film: Path | None) -> None:
    """Mean return and length of the episodes in reality, a line a policy, and where to look."""
    _print_lines(cfg, in_reality)
    folder = os.path.relpath(directory)
    print(f"\nresults    {folder}/summary.json, metrics.csv")
    print(f"look at    {folder}/learning_curve.png" + (f", {film.name}" if film else ""))
    print(f"replay     python recipes/evaluate.py checkpoint={folder}")


def print_population(cfg: DictConfig, in_reality: dict[str, Evaluation | None], directory: Path) -> None:
    """The same, a line a member; one that failed has no episodes."""
    _print_lines(cfg, in_reality)
    folder = os.path.relpath(directory)
    print(f"\nresults    {folder}/*/summary.json, metrics.csv, learning_curve.png")
    print(f"replay     python recipes/evaluate.py checkpoint={folder}/{next(iter(in_reality))}")


def _print_lines(cfg: DictConfig, in_reality: dict[str, Evaluation | None]) -> None:
    width = max(24, *(len(name) + 2 for name in in_reality))
    print(f"\n{'in reality':<{width}}{'return':>10}{'':>9}{'lasts':>10}{'episodes':>10}")
    for name, result in in_reality.items():
        if result is None:
            print(f"{name:<{width}}{'failed':>10}")
            continue
        spread, seconds = f"± {result.std:.0f}", result.mean_length * cfg.env.seconds_per_step
        print(f"{name:<{width}}{result.mean:>10.0f}{spread:>9}{seconds:>8.1f} s{len(result.returns):>10}")
