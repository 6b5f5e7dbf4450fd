"""The short table at the end of a run."""

import os
from pathlib import Path

from evaluation import Evaluation
from omegaconf import DictConfig


def print_table(cfg: DictConfig, in_reality: dict[str, Evaluation], directory: Path, film: Path | None) -> None:
    """Mean return and length of the episodes in reality, a line a policy, and where to look."""
    print(f"\n{'in reality':<24}{'return':>10}{'':>9}{'lasts':>10}{'episodes':>10}")
    for name, result in in_reality.items():
        seconds = result.mean_length * cfg.env.seconds_per_step
        print(f"{name:<24}{result.mean:>10.0f}{f'± {result.std:.0f}':>9}{seconds:>8.1f} s{len(result.returns):>10}")
    folder = os.path.relpath(directory)
    print(f"\nresults    {folder}/summary.json, metrics.csv")
    print(f"look at    {folder}/learning_curve.png" + (f", {film.name}" if film else ""))
    print(f"replay     python recipes/evaluate.py checkpoint={folder}")
