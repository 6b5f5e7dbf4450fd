"""The short table at the end of a run, as text."""

import os
from collections.abc import Mapping
from pathlib import Path

from torchrl_h2o.training.returns import Evaluation


def table_of_run(
    in_reality: Mapping[str, Evaluation], directory: Path, film: Path | None, seconds_per_step: float
) -> str:
    """Mean return and length of the episodes in reality, one line per policy, and the names of the files.

    Args:
        in_reality: evaluations by the name of the policy.
        directory: the run's folder.
        film: the film's file, if there is one.
        seconds_per_step: control step, in s.
    """
    folder = os.path.relpath(directory)
    lines = [
        *_lines(in_reality, seconds_per_step),
        f"\nresults    {folder}/summary.json, metrics.csv",
        f"look at    {folder}/learning_curve.png" + (f", {film.name}" if film else ""),
        f"replay     python recipes/evaluate.py checkpoint={folder}",
    ]
    return "\n".join(lines)


def table_of_population(in_reality: Mapping[str, Evaluation | None], directory: Path, seconds_per_step: float) -> str:
    """The same for a population, one line per member; None stands for a member that failed."""
    folder = os.path.relpath(directory)
    lines = [
        *_lines(in_reality, seconds_per_step),
        f"\nresults    {folder}/*/summary.json, metrics.csv, learning_curve.png",
        f"replay     python recipes/evaluate.py checkpoint={folder}/{next(iter(in_reality))}",
    ]
    return "\n".join(lines)


def _lines(in_reality: Mapping[str, Evaluation | None], seconds_per_step: float) -> list[str]:
    width = max(24, *(len(name) + 2 for name in in_reality))
    lines = [f"\n{'in reality':<{width}}{'return':>10}{'':>9}{'lasts':>10}{'episodes':>10}"]
    for name, result in in_reality.items():
        if result is None:
            lines.append(f"{name:<{width}}{'failed':>10}")
            continue
        spread, seconds = f"± {result.std:.0f}", result.mean_length * seconds_per_step
        lines.append(f"{name:<{width}}{result.mean:>10.0f}{spread:>9}{seconds:>8.1f} s{len(result.returns):>10}")
    return lines
