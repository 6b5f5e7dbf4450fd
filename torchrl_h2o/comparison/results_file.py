"""Reads and writes the results of a group of runs as CSV, such as outputs/results/returns.csv.

Each row is one run, identified by the columns :data:`IDENTITY`. A second file, ``returns_curves.csv``, has one row per
evaluation, for learning curves.
"""

import json
import shlex
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock
from omegaconf import DictConfig

from torchrl_h2o.comparison.records import shorten_paths
from torchrl_h2o.data.readers.sources import Source
from torchrl_h2o.effects import PAPER_GAPS
from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.training.interrupts import uninterrupted
from torchrl_h2o.whole_file import whole_file

RESULTS = Path("outputs/results")  # folder of the results files, unless an option names another
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
    "effects_added",  # to the simulator by the option mend; empty without it
    "return_data",
    "updates_per_second",
    "commit",  # with a + where files differed from it
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
GRID |= {"folder_of_data"}
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
        "mend": _short(mend) if isinstance(mend := cfg.get("mend") or "", str) else str(mend).lower(),
        "gap": cfg.gap or "",
        "strength": "" if cfg.gap is None else str(float(_strength(cfg))),
        "seed": str(cfg.seed),
        "updates": str(cfg.updates),
        "backbone": cfg.backbone if h2o_plus else "",
        "mixing": str(float(cfg.mixing)) if h2o_plus else "",
        "ratio": str(bool(cfg.ratio)) if h2o_plus else "",
        "others": " ".join(sorted(shorten_paths(o) for o in cfg.overrides or () if key_of(o) not in TOLD | GRID)),
    }


def key_of(override: str) -> str:
    """Return the configuration key of an override."""
    return override.lstrip("+~").partition("=")[0]


def repeating_command(cfg: DictConfig) -> str:
    """Return the command that repeats a run, without the options for results and folders; paths are shortened."""
    chosen = [shorten_paths(o) for o in cfg.overrides or () if key_of(o) not in GRID | {"results", "folder", "resume"}]
    return shlex.join(["python", "recipes/train.py", *chosen])


def _strength(cfg: DictConfig) -> float:
    return PAPER_GAPS[cfg.gap].strength if cfg.gap_strength is None else cfg.gap_strength


def _short(data: Source) -> str:
    """Return the data set's name; for an absolute path, its last two parts, which have the form of a Minari name."""
    if isinstance(data, Mapping):
        data = list(data.values())
    if not isinstance(data, str | PathLike):
        return " + ".join(_short(one) for one in data)
    path = Path(data)
    return "/".join(path.parts[-2:]) if path.is_absolute() else str(data)


def run_row(cfg: DictConfig, summary: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a finished run, from its configuration and its summary.json; of a failed one without returns."""
    row: dict[str, Any] = dict.fromkeys(RESULT, "") | identity(cfg)
    if (real := summary["return_real"]) is not None:
        observed = real.get("observed", {})
        row |= {
            "return_mean": _rounded(real["mean"]),
            "return_std": _rounded(real["std"]),
            "episodes": real["episodes"],
            "seconds": _rounded(real["mean_length"] * cfg.env.seconds_per_step),
            **{key: _rounded(observed[name][what]) for key, (name, what) in OBSERVED.items() if name in observed},
            "return_data": _rounded(summary["return_data"]["mean"]),
            "updates_per_second": _rounded(summary["updates_per_second"]),
        }
    if cfg.get("mend"):
        row["effects_added"] = 0 if cfg.get("mended") is None else len(cfg.mended["effects"])
    row["commit"] = f"{summary.get('commit') or ''}{'+' * bool(summary.get('dirty'))}"
    row["versions"] = " ".join(f"{name}={number}" for name, number in summary["versions"].items())
    return row | {"command": repeating_command(cfg)}


def append_run(path: Path, cfg: DictConfig, directory: Path) -> None:
    """Append a finished run from the files in its folder, unless the CSV already has it.

    Args:
        path: CSV of the group, created if missing. Several processes may append at once.
        cfg: the run's configuration.
        directory: the run's folder, with summary.json and metrics.csv.
    """
    row = run_row(cfg, json.loads((directory / "summary.json").read_text()))
    metrics = pd.read_csv(directory / "metrics.csv")
    curve = pd.DataFrame(
        {
            "at": metrics["updates"],
            "return_mean": metrics["return_real"].map(_rounded),
            "return_std": metrics["return_real_std"].map(_rounded),
            "seconds": (metrics["length_real"] * cfg.env.seconds_per_step).map(_rounded),
        }
    )
    _append(path, pd.DataFrame([row]), curve.assign(**identity(cfg))[[*IDENTITY, *CURVE]])


def _append(path: Path, run: pd.DataFrame, curve: pd.DataFrame) -> None:
    """Append a run's curve, then its result, so that a run counts as unfinished if the process ends in between."""
    with uninterrupted():
        append_rows(curves_of(path), curve)
        append_rows(path, run[[*IDENTITY, *RESULT]])


def append_rows(path: Path, rows: pd.DataFrame) -> None:
    """Append the rows of one run to a CSV file, unless the file already has rows of that run.

    Args:
        path: CSV file, created if missing.
        rows: the rows to append; their columns are those of the file.

    Raises:
        ValueError: if the file has other columns.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(f".{path.name}.lock")):  # other runs of the group may finish at the same time
        earlier = read_rows(path)
        if recorded(earlier) & recorded(rows):
            return
        if len(earlier) and set(earlier.columns) != set(rows.columns):
            raise ValueError(f"{path} has the columns {', '.join(earlier.columns)}, so it is no file of such results")
        with whole_file(path) as partial:
            pd.concat([earlier, rows.astype(str)]).to_csv(partial, index=False, columns=list(rows.columns))


def adopt_runs(path: Path, runs: Iterable[Mapping[str, str]]) -> None:
    """Copy results and curves of the given runs from the files of other groups in the same folder.

    Args:
        path: CSV file to copy to.
        runs: identities of the runs to copy.
    """
    missing = {tuple(who.values()) for who in runs} - recorded(read_rows(path))
    for other in sorted(path.parent.glob("[!.]*.csv")):
        if other == path or not other.is_file() or not _is_group(other):
            continue
        rows, curves = read_rows(other), read_rows(curves_of(other))
        for who in sorted(recorded(rows) & missing):
            _append(path, *(frame[[key == who for key in _keys(frame)]] for frame in (rows, curves)))


def _is_group(path: Path) -> bool:
    """Whether a CSV file has the columns of a results file; the folder may contain other CSV files."""
    first = path.open(encoding="utf-8", errors="replace").readline().strip()
    return first.split(",") == [*IDENTITY, *RESULT]


def curves_of(path: Path) -> Path:
    """Path of a group's learning curves."""
    return path.with_name(f"{path.stem}_curves.csv")


def read_rows(path: Path) -> pd.DataFrame:
    """Read a CSV file as text; no rows if the file is missing."""
    if not path.exists():
        return pd.DataFrame(columns=list(IDENTITY), dtype=str)
    return pd.read_csv(path, dtype=str, keep_default_na=False)


def require_groups(results: Path, groups: Iterable[str], known: Iterable[str]) -> None:
    """Require that groups of results have a file, or at least a known name.

    Raises:
        ValueError: for a group that has neither.
    """
    names = sorted({*known, *(path.stem for path in results.glob("*.csv"))})
    for unknown in [group for group in groups if group not in names]:
        raise ValueError(f"{unknown}: there is no {results / unknown}.csv{did_you_mean(unknown, names)}")


def recorded(rows: pd.DataFrame) -> set[tuple[str, ...]]:
    """Identities of the runs in rows, as tuples in the order of :data:`IDENTITY`."""
    return set(_keys(rows))


def _keys(rows: pd.DataFrame) -> list[tuple[str, ...]]:
    return list(rows[list(IDENTITY)].itertuples(index=False, name=None))


def _rounded(value: float | str) -> float:
    return float(f"{float(value):.6g}")
