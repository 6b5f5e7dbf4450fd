"""Measures which of 30 damages of a good log the readers refuse or the audit names, and how often it blames good logs.

python recipes/benchmarks/corruptions.py logs=path/to/logs                    # a few minutes
python recipes/benchmarks/corruptions.py systems=[HalfCheetah] numbers=[7]    # one damage of a recorded log

A damage is written into a CSV file, which is read and audited like any other log. It is right if the reader refuses
the file, or if the audit has a severe finding or a warning of the check that is responsible. A good log, with or
without a dynamics gap and 1 % sensor noise, must have no severe finding. ``logs`` is the folder of the real logs;
without it, only the recorded system is damaged. Writes corruptions.csv to the run's folder.
"""

import csv
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from corruption_cases import CORRUPTIONS, Corruption
from corruption_controls import drawn_controls, real_controls
from corruption_logs import DamagedLog, GoodLog, good_log
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from options import CorruptionsOptions
from tensordict import TensorDict
from torchrl import torchrl_logger
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.data import Audit, DataError, audit
from torchrl_h2o.residuals import Simulation
from torchrl_h2o.whole_file import whole_file

COLUMNS = ("system", "number", "corruption", "seed", "right", "outcome", "check", "severity", "words", "warnings")
TIMES = ("wall_s", "cpu_s")


def judge(good: GoodLog, number: int, corruption: Corruption, seed: int, folder: Path) -> dict:
    """Damages a log, reads and audits it.

    Returns:
        A row of the results; ``outcome`` is ``"named"``, ``"refused"`` or ``"missed"``.
    """
    rng = np.random.default_rng([seed, number])
    row = {"system": good.name, "number": number, "corruption": corruption.name, "seed": seed}
    damaged: DamagedLog = corruption.damage(good, rng)
    try:
        transitions = damaged.read(folder)
        simulation = good.simulation(damaged, transitions)
    except (DataError, ValueError) as error:
        words = str(error).replace(str(folder) + os.sep, "")
        return row | {"right": True, "outcome": "refused", "words": words, "wall_s": 0.0, "cpu_s": 0.0}
    found, seconds = timed_audit(transitions, simulation)
    return row | seconds | verdict(found, corruption.checks)


def timed_audit(transitions: TensorDict, simulation: Simulation) -> tuple[Audit, dict]:
    """The audit, with its seconds by the clock and on all processors."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = audit(transitions, simulation)
    return found, {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def verdict(found: Audit, checks: tuple[str, ...]) -> dict:
    """Whether the audit names a damage: the first severe finding or warning of a responsible check."""
    serious = [*found.severe, *found.warnings]
    named = [finding for finding in serious if finding.check in checks]
    shown = (named or serious or list(found.findings))[:1]
    details = {"check": shown[0].check, "severity": shown[0].severity, "words": shown[0].words} if shown else {}
    return {"right": bool(named), "outcome": "named" if named else "missed", **details}


def damaged_rows(cfg: DictConfig, folder: Path) -> Iterator[dict]:
    for system in cfg.systems:
        good = good_log(system, None if cfg.logs is None else Path(cfg.logs))
        if good is None:
            continue
        for number, corruption in tqdm(list(enumerate(CORRUPTIONS)), system, unit=" logs"):
            if cfg.numbers is None or number in cfg.numbers:
                for seed in cfg.seeds:
                    yield judge(good, number, corruption, seed, folder)


def control_rows(cfg: DictConfig) -> Iterator[dict]:
    """One row per good log; right if it has no severe finding."""
    controls = list(drawn_controls(cfg.draws))
    if cfg.logs is not None:
        controls += list(real_controls(Path(cfg.logs)))
    for number, control in enumerate(tqdm(controls, "good logs", unit=" logs")):
        transitions, simulation = control.load()
        found, seconds = timed_audit(transitions, simulation)
        worst = found.findings[0] if found.findings else None
        details = {} if worst is None else {"check": worst.check, "severity": worst.severity, "words": worst.words}
        yield {
            "system": control.system,
            "number": number,
            "corruption": f"none: {control.words}",
            "right": not found.severe,
            "outcome": "severe" if found.severe else "passed",
            "warnings": len(found.warnings),
            **seconds,
            **details,
        }


def save(rows: list[dict], path: Path) -> None:
    with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*COLUMNS, *TIMES])
        writer.writeheader()
        writer.writerows(row | {key: f"{row[key]:.2f}" for key in TIMES} for row in rows)


def print_table(rows: list[dict]) -> None:
    """Prints the number of right cases per system, the others, and the seconds of the audits."""
    groups = {(row["system"], row["corruption"].startswith("none")) for row in rows}
    print(f"\n{'logs':<44}{'right':>12}{'named':>8}{'refused':>9}{'most CPU s':>12}")
    for system, good in sorted(groups, key=lambda group: (group[1], group[0])):
        own = [r for r in rows if r["system"] == system and r["corruption"].startswith("none") == good]
        right, name = sum(row["right"] for row in own), f"{system}, {'good' if good else 'damaged'}"
        named, refused = (sum(row["outcome"] == outcome for row in own) for outcome in ("named", "refused"))
        slowest = max(row["cpu_s"] for row in own)
        print(f"{name:<44}{f'{right} of {len(own)}':>12}{named:>8}{refused:>9}{slowest:>12.1f}")
    for row in rows:
        if not row["right"]:
            seed = f", seed {row['seed']}" if "seed" in row else ""
            print(f"  wrong: {row['system']}, {row['corruption']}{seed}: {row.get('severity', 'nothing found')}, "
                  f"{row.get('words', '')}")  # fmt: skip


@hydra_main("../config", "corruptions_benchmark", CorruptionsOptions)
def main(cfg: DictConfig) -> None:
    directory = Path(HydraConfig.get().runtime.output_dir)
    directory.mkdir(parents=True, exist_ok=True)
    torchrl_logger.setLevel("WARNING")  # the reader reports each of its files
    rows = []
    for row in damaged_rows(cfg, directory):
        rows.append(row)
    for row in control_rows(cfg) if cfg.draws else ():
        rows.append(row)
    path = directory / "corruptions.csv"
    save(rows, path)
    print_table(rows)
    print(f"\nresults    {os.path.relpath(path)}")


if __name__ == "__main__":
    main()
