"""Stores the records of finished runs, and writes the tables of the pages in this folder from all stored records.

python recipes/results/make.py                                     # writes every table
python recipes/results/make.py check                               # fails if a page is not what the records make
python recipes/results/make.py store outputs/machines/double_pendulum outputs/main/* outputs/benchmark/ratio

A finished run is a folder with a report.json (its name is one of machines.yaml), with a summary.json, or with the
records of a benchmark. A table stands between `<!-- table: NAME -->` and `<!-- end -->`. All rows of a table must come
from one commit without changes, those of the drawn cases family by family; otherwise no page is written, and the
commits are listed with their records.
"""

import json
import re
import shlex
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from hashlib import sha256
from pathlib import Path

import cells
import pages
import training_tables
from omegaconf import OmegaConf

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.comparison.grids import OFF_DYNAMICS_FILES, env_of_file
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.comparison.results_file import run_row
from torchrl_h2o.comparison.rounds import draw_rounds_of_methods, rounds_of
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.whole_file import write_text

HERE = Path(__file__).parent
MADE_BY = ("commit", "dirty", "versions", "cpu_s", "threads", "instruction_set")  # entries of provenance
TABLE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def records_of(folder: Path) -> list[Record]:
    """Read what a finished run has found.

    Raises:
        ValueError: for a folder without a result, a report that is not finished, or one of a machine that is not in
            machines.yaml.
    """
    if (folder / "report.json").exists():
        report = json.loads((folder / "report.json").read_text())
        if folder.resolve().name not in cells.machines():
            raise ValueError(
                f"{folder}: machines.yaml has no {folder.resolve().name}; the folder's name names the machine"
            )
        if report["unfinished"] or not report["made_by"]:
            raise ValueError(f"{folder}/report.json is not finished: end the run, or run it again")
        return [Record("machines", folder.resolve().name, report["made_by"], _values_of_report(report))]
    if (folder / "rounds.json").exists():
        return [_record_of_rounds(folder)]
    if (folder / "summary.json").exists():
        return [_record_of_training(folder)]
    if not (found := list(read_records(folder))):
        raise ValueError(f"{folder} has no report.json, summary.json or records of a benchmark")
    return found


def _values_of_report(report: dict) -> dict:
    verdict, audit = report["verdict"] or {}, report["audit"] or {"findings": []}
    severe = [finding["words"] for finding in audit["findings"] if finding["severity"] == "severe"]
    kept = ("effect", "parameters", "words")
    return {
        "effects": [{key: effect[key] for key in kept} for effect in report["effects"]],
        "verdict": verdict.get("kind"),
        "recommended": bool(verdict.get("recommended")),
        "other_sets": len(report["others"]),
        "sentence": report["sentence"],
        "severe": severe,
        "ended_in": report["ended_in"],
        "wall_s": report["wall_s"],
    }


def _record_of_training(folder: Path) -> Record:
    summary, cfg = json.loads((folder / "summary.json").read_text()), load_config(folder)
    OmegaConf.set_struct(cfg, False)
    cfg.method = cfg.get("method", "h2o_plus")  # h2o_plus.py has no other
    words = shlex.split(summary["command"])
    cfg.overrides = [word for word in words if "=" in word and not word.startswith("hydra")]
    values = run_row(cfg, summary) | {"compiled": str(cfg.compiled), "device": cfg.get("device", "cpu")}
    made_by = {key: summary[key] for key in MADE_BY}
    del values["commit"], values["versions"]
    settings = [str((values | made_by)[key]) for key in training_tables.SETTINGS]
    names = (values["method"], values["env"].replace("/", "-"), sha256(" ".join(settings).encode()).hexdigest()[:8])
    table = "off_dynamics_runs" if values["env"] in map(env_of_file, OFF_DYNAMICS_FILES) else "training"
    return Record(table, "_".join((*names, f"seed{values['seed']}")), made_by, values)


def _record_of_rounds(folder: Path) -> Record:
    values = json.loads((folder / "rounds.json").read_text())
    made_by = {key: values.pop(key) for key in MADE_BY}
    settings = sha256(json.dumps({key: values[key] for key in values if key not in ("rounds", "seed")}).encode())
    names = (values["method"], values["env"].replace("/", "-"), settings.hexdigest()[:8], f"seed{values['seed']}")
    return Record("sim_to_real", "_".join(names), made_by, values)


def require_one_commit(table: str, records: Iterable[Record]) -> None:
    """Require that all rows of a table come from the same code.

    Raises:
        ValueError: for rows of several commits, or of code that differed from its commit.
    """
    by_commit = defaultdict(list)
    for record in records:
        by_commit[f"{record.made_by['commit']}{' with changes' if record.is_dirty else ''}"].append(record.name)
    if len(by_commit) > 1 or any(commit.endswith("changes") for commit in by_commit):
        lines = [f"  {commit}: {', '.join(names)}" for commit, names in by_commit.items()]
        raise ValueError("\n".join([f"{table}: its rows must come from one commit without changes", *lines]))


def tables_of(records: Sequence[Record]) -> dict[str, str]:
    """Write each table as Markdown, from all stored records."""
    by_table = defaultdict(list)
    for record in records:
        by_table[record.table].append(record)
    for table, its in by_table.items():
        by_row = defaultdict(list)  # a family of drawn cases is a row, and takes an hour
        for record in its:
            by_row[record.values["family"] if table == "drawn" else ""].append(record)
        for row, own in by_row.items():
            require_one_commit(f"{table} {row}".strip(), own)
    runs = {table: cells.frame(its) for table, its in by_table.items()}
    return {name: make_table(runs) for name, make_table in pages.TABLES.items()}


def fill(text: str, tables: dict[str, str], page: str) -> str:
    """Put tables between the markers of a page.

    Raises:
        ValueError: for a marker of a table that there is not.
    """

    def table(found: re.Match) -> str:
        if found[2] not in tables:
            raise ValueError(f"{page}: there is no table {found[2]}; choose from {', '.join(tables)}")
        return f"{found[1]}{tables[found[2]]}\n{found[3]}"

    return TABLE.sub(table, text)


def make(folder: Path, *, check: bool = False) -> list[str]:
    """Write the tables of all pages in a folder from the records below ``folder/runs``.

    Returns:
        The names of the pages that changed, or with ``check`` of those that would.
    """
    tables = tables_of(list(read_records(folder / "runs")))
    changed = []
    for path in sorted(folder.glob("*.md")):
        before = path.read_text()
        if (after := fill(before, tables, path.name)) != before:
            changed.append(path.name)
            if not check:
                write_text(path, after)
    return changed


def draw(folder: Path) -> None:
    """Draw the figure of the rounds between simulator and reality from the stored records."""
    if records := list(read_records(folder / "runs", "sim_to_real")):
        draw_rounds_of_methods(folder / "sim_to_real.png", rounds_of(cells.frame(records)))


def main(arguments: Sequence[str]) -> None:
    command, *folders = arguments or ("make",)
    if command not in ("make", "check", "store") or (command == "store") != bool(folders):
        sys.exit("use: make.py, make.py check, or make.py store FOLDER...")
    for folder in folders:
        for record in records_of(Path(folder)):
            print(f"stored     {record.save(HERE / 'runs').relative_to(HERE)}")
    if command != "store":
        changed = make(HERE, check=command == "check")
        if command == "make":
            draw(HERE)
        print(
            "\n".join([f"{'differs' if command == 'check' else 'wrote':<11}{name}" for name in changed]) or "no change"
        )
        sys.exit(command == "check" and bool(changed))


if __name__ == "__main__":
    with one_line_errors():
        main(sys.argv[1:])
