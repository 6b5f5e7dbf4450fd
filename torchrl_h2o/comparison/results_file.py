"""The CSV of a group of runs, beside the paper's figures in recipes/results/: a row a run, and what tells runs apart.

Beside ``returns.csv`` stands ``returns_curves.csv``, a row an evaluation, for learning curves.
"""

import csv
import fcntl
import json
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path

from omegaconf import DictConfig

from torchrl_h2o.effects import PAPER_GAPS
from torchrl_h2o.training.run_folder import uninterrupted

IDENTITY = ("method", "env", "data", "gap", "strength", "seed", "updates", "backbone", "mixing", "ratio", "others")
RESULT = (
    "return_mean",
    "return_std",
    "episodes",
    "seconds",
    "return_data",
    "updates_per_second",
    "versions",
    "command",
)
#: overrides that other columns tell of, or that change nothing but how numbers round
TOLD = {*IDENTITY, "gap_strength", "final_episodes", "results", "folder", "resume", "render", "threads", "compiled"}
#: overrides of paper.py, which choose among runs
GRID = {"table", "figure", "methods", "gaps", "strengths", "datasets", "tasks", "seeds", "retries"}
EVALUATED = {"mean": "return_real", "std": "return_real_std"}
CURVE = ("at", "return_mean", "return_std")


def identity(cfg: DictConfig) -> dict[str, str]:
    """What tells a run from all others of its group, as the CSV says it."""
    h2o_plus = cfg.method == "h2o_plus"
    task = cfg.env.make.get("task")
    return {
        "method": cfg.method,
        "env": cfg.env.name if task is None else f"{cfg.env.name}/{task}",
        "data": _short(cfg.data),
        "gap": cfg.gap or "",
        "strength": "" if cfg.gap is None else str(float(_strength(cfg))),
        "seed": str(cfg.seed),
        "updates": str(cfg.updates),
        "backbone": cfg.backbone if h2o_plus else "",
        "mixing": str(float(cfg.mixing)) if h2o_plus else "",
        "ratio": str(bool(cfg.ratio)) if h2o_plus else "",
        "others": " ".join(sorted(o for o in cfg.overrides or () if key_of(o) not in TOLD | GRID)),
    }


def key_of(override: str) -> str:
    """What an override sets."""
    return override.lstrip("+~").partition("=")[0]


def repeating_command(cfg: DictConfig) -> str:
    """What repeats a run, wherever its results go."""
    chosen = [o for o in cfg.overrides or () if key_of(o) not in GRID | {"results", "folder", "resume"}]
    return shlex.join(["python", "recipes/train.py", *chosen])


def _strength(cfg: DictConfig) -> float:
    return PAPER_GAPS[cfg.gap].strength if cfg.gap_strength is None else cfg.gap_strength


def _short(data: str) -> str:
    """A data set's name; of a path the last two parts, which are what a Minari name consists of."""
    path = Path(data)
    return "/".join(path.parts[-2:]) if path.is_absolute() else data


def append_run(path: Path, cfg: DictConfig, directory: Path) -> None:
    """Appends a run that is done, from the files in its folder; a run that is in the CSV already stays as it is.

    Args:
        path: the CSV of the group; made if it is not there. Several runs may append at once.
        cfg: the run's configuration.
        directory: its folder, with summary.json and metrics.csv.
    """
    summary = json.loads((directory / "summary.json").read_text())
    who = identity(cfg)
    real = summary["return_real"]
    result = who | {
        "return_mean": _rounded(real["mean"]),
        "return_std": _rounded(real["std"]),
        "episodes": real["episodes"],
        "seconds": _rounded(real["mean_length"] * cfg.env.seconds_per_step),
        "return_data": _rounded(summary["return_data"]["mean"]),
        "updates_per_second": _rounded(summary["updates_per_second"]),
        "versions": " ".join(f"{name}={number}" for name, number in summary["versions"].items()),
        "command": repeating_command(cfg),
    }
    with open(directory / "metrics.csv", newline="") as file:
        curve = [
            who | {"at": row["updates"], **{f"return_{key}": _rounded(row[name]) for key, name in EVALUATED.items()}}
            for row in csv.DictReader(file)
        ]
    _append(path, result, curve)


def _append(path: Path, result: Mapping, curve: Iterable[Mapping]) -> None:
    """Appends a run's curve and its result, which says that the run is done: last, should it be killed here."""
    with uninterrupted():
        append_rows(curves_of(path), (*IDENTITY, *CURVE), curve, result)
        append_rows(path, (*IDENTITY, *RESULT), [result], result)


def append_rows(path: Path, columns: Iterable[str], rows: Iterable[Mapping], who: Mapping[str, str]) -> None:
    """Appends a run's rows to a CSV, once: nothing happens if it has rows of that run."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+", newline="") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # other runs of the group may be done at the same moment
        file.seek(0)
        there = list(csv.DictReader(file))
        if any(_key(row) == _key(who) for row in there):
            return
        writer = csv.DictWriter(file, list(columns))
        if file.seek(0, 2) == 0:
            writer.writeheader()
        writer.writerows(rows)


def adopt_runs(path: Path, runs: Iterable[Mapping[str, str]]) -> None:
    """Takes what other groups of the same folder have done of some runs, with the curves."""
    missing = {_key(who) for who in runs} - recorded(path)
    for other in sorted(path.parent.glob("*.csv")):
        if other == path or not _is_group(other):
            continue
        rows, curves = read_rows(other), read_rows(curves_of(other))
        for row in rows:
            if _key(row) in missing:
                _append(path, row, [point for point in curves if _key(point) == _key(row)])


def _is_group(path: Path) -> bool:
    """Whether a CSV, which may be anybody's, is that of a group of runs."""
    with open(path, newline="", errors="replace") as file:
        return next(csv.reader(file), None) == [*IDENTITY, *RESULT]


def curves_of(path: Path) -> Path:
    """Where the learning curves of a group stand."""
    return path.with_name(f"{path.stem}_curves.csv")


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV; none if it is not there."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def recorded(path: Path) -> set[tuple[str, ...]]:
    """The identities, as tuples in the order of :data:`IDENTITY`, of the runs that stand in the CSV."""
    return {_key(row) for row in read_rows(path)}


def _key(who: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(who[column] for column in IDENTITY)


def _rounded(value: float | str) -> float:
    return float(f"{float(value):.6g}")
