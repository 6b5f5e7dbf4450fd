"""Measures which of 30 damages of a good log the readers refuse or the audit names, and how often it blames good logs.

python recipes/benchmarks/corruptions.py logs=path/to/logs                    # a few minutes
python recipes/benchmarks/corruptions.py systems=[HalfCheetah] numbers=[7]    # one damage of a recorded log

A damage is written into a CSV file, which is read and audited like any other log. It is right if the reader refuses
the file, or if the audit has a severe finding or a warning of the check that is responsible. A good log, with or
without a dynamics gap and 1 % sensor noise, must have no severe finding. ``logs`` is the folder of the real logs;
without it, only the recorded system is damaged. Writes a record for each log and seed to
outputs/benchmark/corruptions and skips those that the same commit has recorded there.
"""

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from corruption_cases import CORRUPTIONS, Corruption
from corruption_controls import drawn_controls, real_controls
from corruption_logs import DamagedLog, GoodLog, good_log
from omegaconf import DictConfig
from options import read_options
from tensordict import TensorDict
from torchrl import torchrl_logger
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.data import Audit, DataError, audit
from torchrl_h2o.provenance import cpu_seconds
from torchrl_h2o.residuals import Simulation

TABLE = "audit"


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


def damaged_rows(good: GoodLog, cfg: DictConfig, seed: int, folder: Path) -> Iterator[dict]:
    for number, corruption in tqdm(list(enumerate(CORRUPTIONS)), f"{good.name}, seed {seed}", unit=" logs"):
        if cfg.numbers is None or number in cfg.numbers:
            yield judge(good, number, corruption, seed, folder)


def control_rows(cfg: DictConfig, logs: Path | None) -> Iterator[dict]:
    """One row per good log; right if it has no severe finding."""
    controls = [*drawn_controls(cfg.draws), *([] if logs is None else real_controls(logs))]
    for control in tqdm(controls, "good logs", unit=" logs"):
        found, seconds = timed_audit(*control.load())
        worst = found.findings[0] if found.findings else None
        details = {} if worst is None else {"check": worst.check, "severity": worst.severity, "words": worst.words}
        name = f"{control.system}: {control.words}"
        right = not found.severe
        yield {"corruption": name, "right": right, "outcome": "passed" if right else "severe", **seconds, **details}


def summary(rows: list[dict]) -> dict:
    """Numbers of logs and of right ones, the wrong ones with what the audit said, and the longest audit."""
    wrong = [f"{row['corruption']}: {row.get('words', 'nothing found')}" for row in rows if not row["right"]]
    counts = {outcome: sum(row["outcome"] == outcome for row in rows) for outcome in ("named", "refused", "passed")}
    longest = max((row["cpu_s"] for row in rows), default=0.0)
    return {"logs": len(rows), "right": len(rows) - len(wrong), **counts, "longest_cpu_s": longest, "wrong": wrong}


def main() -> None:
    cfg = read_options(
        systems=["double_pendulum", "HalfCheetah"],
        numbers=None,  # only these damages, such as [3,7]; None for all
        seeds=[0],  # of the drawn joints and rows
        draws=20,  # good logs with a drawn dynamics gap; 0 for no good logs
        logs=None,  # folder of the real logs: double_pendulum/, simple_pendulum/, wheel_legged/, minari/
        folder="outputs/benchmark/corruptions",
    )
    folder, logs = Path(cfg.folder), None if cfg.logs is None else Path(cfg.logs)
    folder.mkdir(parents=True, exist_ok=True)
    torchrl_logger.setLevel("WARNING")  # the reader reports each of its files
    parts: dict[str, Callable[[], Iterator[dict]]] = {}
    for good in filter(None, (good_log(system, logs) for system in cfg.systems)):
        parts |= {f"{good.name}_damaged_{seed}": partial(damaged_rows, good, cfg, seed, folder) for seed in cfg.seeds}
    if cfg.draws:
        parts["good_logs"] = partial(control_rows, cfg, logs)
    done = {record.name: record for record in read_records(folder, TABLE) if record.is_current}
    for name, rows in parts.items():
        if name not in done:
            start = cpu_seconds()
            done[name] = Record.of_this_process(TABLE, name, summary(list(rows())), start)
            done[name].save(folder)
        found = done[name].values
        print(f"{name:<36}{found['right']:>4} of {found['logs']} right, {found['longest_cpu_s']:.1f} CPU s at most")
        for wrong in found["wrong"]:
            print(f"  wrong: {wrong}")
    print(f"\nresults    {folder}/{TABLE}")


if __name__ == "__main__":
    main()
