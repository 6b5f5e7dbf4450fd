"""Reads and writes the results of a group of runs as CSV, such as recipes/results/returns.csv.

Each row is one run, identified by the columns :data:`IDENTITY`. A second file, ``returns_curves.csv``, has one row per
evaluation, for learning curves.
"""

import csv
import json
import re
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path

from filelock import FileLock
from omegaconf import DictConfig

from torchrl_h2o.data.readers.sources import Source
from torchrl_h2o.effects import PAPER_GAPS
from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.training.run_folder import uninterrupted
from torchrl_h2o.whole_file import whole_file

IDENTITY = (
    "method",
    "env",
    "data",
    "data_seconds",  # s of real data; empty for all
    "mend",  # value of the option; empty without
    "gap",
    "strength",
    "seed",
    "updates",
    "backbone",
    "mixing",
    "ratio",
    "others",
)
RESULT = (
    "return_mean",
    "return_std",
    "episodes",
    "seconds",  # mean length of an episode
    "mean_v",
    "max_abs_x",
    "effects_added",  # to the simulator by the option mend; empty without it, and in files of earlier versions
    "return_data",
    "updates_per_second",
    "versions",
    "command",
)
#: columns of the results for quantities that the task observes, and their names in summary.json
OBSERVED = {"mean_v": ("v", "mean"), "max_abs_x": ("x", "max_abs")}
#: overrides not listed in the column ``others``: they have columns of their own, or affect results by rounding only
TOLD = {
    *IDENTITY,
    *("gap_strength", "final_episodes", "results", "folder", "resume", "render", "threads", "compiled", "overlap"),
}
#: overrides of paper.py that choose runs
GRID = {"table", "figure", "methods", "gaps", "strengths", "datasets", "tasks", "sizes", "log", "seeds", "retries"}
EVALUATED = {"mean": "return_real", "std": "return_real_std"}
CURVE = ("at", "return_mean", "return_std", "seconds")


def identity(cfg: DictConfig) -> dict[str, str]:
    """Return the columns that identify a run within its group, as text."""
    h2o_plus = cfg.method == "h2o_plus"
    task = cfg.env.make.get("task")
    return {
        "method": cfg.method,
        "env": cfg.env.name if task is None else f"{cfg.env.name}/{task}",
        "data": _short(cfg.data),
        "data_seconds": "" if cfg.get("data_seconds") is None else f"{cfg.data_seconds:g}",
        "mend": str(cfg.get("mend") or "").lower(),
        "gap": cfg.gap or "",
        "strength": "" if cfg.gap is None else str(float(_strength(cfg))),
        "seed": str(cfg.seed),
        "updates": str(cfg.updates),
        "backbone": cfg.backbone if h2o_plus else "",
        "mixing": str(float(cfg.mixing)) if h2o_plus else "",
        "ratio": str(bool(cfg.ratio)) if h2o_plus else "",
        "others": " ".join(sorted(_portable(o) for o in cfg.overrides or () if key_of(o) not in TOLD | GRID)),
    }


def key_of(override: str) -> str:
    """Return the configuration key of an override."""
    return override.lstrip("+~").partition("=")[0]


def repeating_command(cfg: DictConfig) -> str:
    """Return the command that repeats a run, without the options for results and folders; paths are shortened."""
    chosen = [_portable(o) for o in cfg.overrides or () if key_of(o) not in GRID | {"results", "folder", "resume"}]
    return shlex.join(["python", "recipes/train.py", *chosen])


def _portable(override: str) -> str:
    """Return an override with the last two parts of each absolute path, because a folder exists on one machine only."""
    return re.sub(r"(?<=[=\[,'\"])/[^,\]'\"]*", lambda path: _short(path[0]), override)


def _strength(cfg: DictConfig) -> float:
    return PAPER_GAPS[cfg.gap].strength if cfg.gap_strength is None else cfg.gap_strength


def _short(data: Source) -> str:
    """Return the data set's name; for an absolute path, its last two parts, which have the form of a Minari name."""
    if not isinstance(data, str | Path):
        return " + ".join(_short(one) for one in data)
    path = Path(data)
    return "/".join(path.parts[-2:]) if path.is_absolute() else str(data)


def append_run(path: Path, cfg: DictConfig, directory: Path) -> None:
    """Append a finished run from the files in its folder, unless the CSV already has it.

    Args:
        path: CSV of the group, created if missing. Several processes may append at once.
        cfg: the run's configuration.
        directory: the run's folder, with summary.json and metrics.csv.
    """
    summary = json.loads((directory / "summary.json").read_text())
    who = identity(cfg)
    real = summary["return_real"]
    result = who | {
        "return_mean": _rounded(real["mean"]),
        "return_std": _rounded(real["std"]),
        "episodes": real["episodes"],
        "seconds": _rounded(real["mean_length"] * cfg.env.seconds_per_step),
        **{column: _observed(real, *where) for column, where in OBSERVED.items()},
        "effects_added": _effects_added(cfg),
        "return_data": _rounded(summary["return_data"]["mean"]),
        "updates_per_second": _rounded(summary["updates_per_second"]),
        "versions": " ".join(f"{name}={number}" for name, number in summary["versions"].items()),
        "command": repeating_command(cfg),
    }
    with open(directory / "metrics.csv", newline="") as file:
        curve = [who | _point(row, cfg.env.seconds_per_step) for row in csv.DictReader(file)]
    _append(path, result, curve)


def _effects_added(cfg: DictConfig) -> int | str:
    """Return how many effects ``mend`` has added to the simulator, or an empty text without ``mend``."""
    if not cfg.get("mend"):
        return ""
    return 0 if cfg.get("mended") is None else len(cfg.mended["effects"])


def _observed(real: Mapping, quantity: str, statistic: str) -> float | str:
    """Return a statistic of an observed quantity, or an empty text if the task does not observe it."""
    found = real.get("observed", {}).get(quantity)
    return "" if found is None else _rounded(found[statistic])


def _point(row: Mapping[str, str], seconds_per_step: float) -> dict[str, float | str]:
    """Return the columns :data:`CURVE` of one evaluation from a row of metrics.csv."""
    returns = {f"return_{key}": _rounded(row[name]) for key, name in EVALUATED.items()}
    return {"at": row["updates"], **returns, "seconds": _rounded(float(row["length_real"]) * seconds_per_step)}


def _append(path: Path, result: Mapping, curve: Iterable[Mapping]) -> None:
    """Append a run's curve, then its result, so that a run counts as unfinished if the process ends in between."""
    with uninterrupted():
        append_rows(curves_of(path), (*IDENTITY, *CURVE), curve, result)
        append_rows(path, (*IDENTITY, *RESULT), [result], result)


def append_rows(path: Path, columns: Iterable[str], rows: Iterable[Mapping], who: Mapping[str, str]) -> None:
    """Append a run's rows to a CSV file, unless the file already has rows of that run.

    Args:
        path: CSV file, created if missing.
        columns: its columns.
        rows: the rows to append.
        who: the run's identity.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):  # other runs of the group may finish at the same time
        earlier = read_rows(path)
        if any(_key(row) == _key(who) for row in earlier):
            return
        columns = list(columns)
        if earlier and (unknown := sorted(earlier[0].keys() - set(columns))):
            raise ValueError(f"{path} has the columns {', '.join(unknown)}, so it is no file of such results")
        with whole_file(path) as partial, partial.open("w", newline="") as new:
            writer = csv.DictWriter(new, columns)
            writer.writeheader()
            writer.writerows([*earlier, *rows])


def adopt_runs(path: Path, runs: Iterable[Mapping[str, str]]) -> None:
    """Copy results and curves of the given runs from the files of other groups in the same folder.

    Args:
        path: CSV file to copy to.
        runs: identities of the runs to copy.
    """
    missing = {_key(who) for who in runs} - recorded(path)
    for other in sorted(path.parent.glob("[!.]*.csv")):
        if other == path or not other.is_file() or not _is_group(other):
            continue
        rows, curves = read_rows(other), read_rows(curves_of(other))
        for row in rows:
            if _key(row) in missing:
                _append(path, row, [point for point in curves if _key(point) == _key(row)])


def _is_group(path: Path) -> bool:
    """Whether a CSV file has the columns of a results file; the folder may contain other CSV files.

    Files of earlier versions have fewer columns: :func:`_key` takes missing ones as empty.
    """
    with open(path, newline="", errors="replace") as file:
        columns = set(next(csv.reader(file), ()))
    return {"method", "seed", "others", "command"} <= columns <= {*IDENTITY, *RESULT}


def curves_of(path: Path) -> Path:
    """Path of a group's learning curves."""
    return path.with_name(f"{path.stem}_curves.csv")


def read_rows(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file; an empty list if the file is missing."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def require_groups(results: Path, groups: Iterable[str], known: Iterable[str]) -> None:
    """Require that groups of results have a file, or at least a known name.

    Raises:
        ValueError: for a group that has neither.
    """
    names = sorted({*known, *(path.stem for path in results.glob("*.csv"))})
    for unknown in [group for group in groups if group not in names]:
        raise ValueError(f"{unknown}: there is no {results / unknown}.csv{did_you_mean(unknown, names)}")


def recorded(path: Path) -> set[tuple[str, ...]]:
    """Identities of the runs in the CSV, as tuples in the order of :data:`IDENTITY`."""
    return {_key(row) for row in read_rows(path)}


def _key(who: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(who.get(column, "") for column in IDENTITY)


def _rounded(value: float | str) -> float:
    return float(f"{float(value):.6g}")
