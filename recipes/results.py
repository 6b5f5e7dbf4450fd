"""The short table at the end of a run."""

from pathlib import Path

from evaluation import Evaluation
from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.data import episodes


def print_table(
    cfg: DictConfig,
    in_reality: dict[str, Evaluation],
    real: TensorDictBase,
    behaviour: list[float],
    directory: Path,
    film: Path | None,
) -> None:
    """Mean return and length of the episodes in reality, a line a method, and where to look."""
    dt = cfg.env.seconds_per_step
    lengths = [len(episode) for episode in episodes(real)]
    lines = [
        (name, e.mean, f"± {e.std:.0f}", sum(e.lengths) / len(e.lengths) * dt, len(e.returns))
        for name, e in in_reality.items()
    ]
    lines.append(
        ("the data's behaviour", sum(behaviour) / len(behaviour), "", sum(lengths) / len(lengths) * dt, len(lengths))
    )
    print(f"\n{'in reality':<24}{'return':>10}{'':>9}{'lasts':>10}{'episodes':>10}")
    for name, mean, std, seconds, count in lines:
        print(f"{name:<24}{mean:>10.0f}{std:>9}{seconds:>8.1f} s{count:>10}")
    print(f"\nresults    {directory}/summary.json, metrics.csv")
    print(f"look at    {directory}/learning_curve.png" + (f" and {film}" if film else ""))
    print(f"replay     python recipes/evaluate.py checkpoint={directory}")
