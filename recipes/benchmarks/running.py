"""Runs cases of the benchmark of close_the_loop; a case that raises an error is recorded with that error."""

import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import joblib
import torch
from cases import Family, draw_case
from dense_cases import DENSE
from drawn_cases import DECOY, JOINT_BY_JOINT, NOISY_TORQUES, NOTHING, SEVERAL, SLOW, UNDECLARED_FORCE
from machine_cases import MACHINE
from paper_cases import PAPER, PAPER_WITH_NOISE
from robot_cases import ROBOT
from servo_cases import SERVO_CONTROLS, SERVO_DRIVES, SERVOS
from version_cases import VERSIONS

from torchrl_h2o.comparison.records import Record
from torchrl_h2o.provenance import cpu_seconds
from torchrl_h2o.residuals import Report

TABLE = "drawn"
FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "paper16": PAPER,
        "paper16_noise": PAPER_WITH_NOISE,
        "several": SEVERAL,
        "undeclared": UNDECLARED_FORCE,
        "nothing": NOTHING,
        "decoy": DECOY,
        "slow": SLOW,
        "joints": JOINT_BY_JOINT,
        "torques": NOISY_TORQUES,
        "robot": ROBOT,
        "machines": MACHINE,
        "dense": DENSE,
        "versions": VERSIONS,
        "servos": SERVOS,
        "servo_controls": SERVO_CONTROLS,
        "servo_drives": SERVO_DRIVES,
    }
)


@dataclass(frozen=True)
class Job:
    """One case to run: its family, its number in it, the benchmark's seed, and the most minutes of its search."""

    family: str
    number: int
    seed: int = 0
    minutes: float | None = None

    @property
    def name(self) -> str:
        """Names the case's record and its folder."""
        return f"{self.family}_{self.number:02}" + (f"_seed{self.seed}" if self.seed else "")


def run_case(job: Job, trace: Callable[..., Report], directory: Path) -> Record:
    """Draw, measure, trace and judge a case, and write its report and its record.

    Args:
        job: the case.
        trace: the code under test; it sees the simulation and the data only.
        directory: the folder for records and reports.
    """
    torch.set_num_threads(1)
    start, case = cpu_seconds(), draw_case(FAMILIES, job.family, job.number, job.seed)
    told = {"family": job.family, "number": job.number, "seed": job.seed, "name": case.name, "truth": case.words}
    try:
        simulation = case.simulation()
        report = trace(
            simulation,
            case.measure(),
            source=case.system,
            held_out=case.held_out,
            seed=job.seed,
            minutes=job.minutes,
            progress=False,
        )
        report.save(directory / "reports" / job.name)
        told |= outcome(report) | {key: _plain(value) for key, value in case.judge(report, case).items()}
    except Exception as error:  # a failed case must not end the others
        (directory / f"{job.name}.txt").write_text("".join(traceback.format_exception(error)))
        told |= {"ok": False, "found": f"failed: {type(error).__name__}: {error}"}
    record = Record.of_this_process(TABLE, job.name, told, start)
    record.save(directory)
    return record


def outcome(report: Report) -> dict:
    """What a report found, its verdict, and how long it took."""
    error = report.error
    return {
        "found": ", ".join(effect.describe() for effect in report.effects) or report.conclusion or "nothing",
        "verdict": None if report.verdict is None else report.verdict.kind,
        "error_before": None if error is None else error.before,
        "error_after": None if error is None else error.after,
        "wall_s": report.wall_s,
    }


def _plain(value: object) -> object:
    """A NumPy number as Python's; infinity and NaN, which JSON does not have, as text."""
    number = value.item() if hasattr(value, "item") else value
    return number if not isinstance(number, float) or abs(number) < float("inf") else str(number)


def run_all(jobs: Iterable[Job], processes: int, trace: Callable[..., Report], directory: Path) -> Iterator[Record]:
    """Run cases in processes of their own and yield their records as they end."""
    directory.mkdir(parents=True, exist_ok=True)
    calls = [joblib.delayed(run_case)(job, trace, directory) for job in jobs]
    yield from joblib.Parallel(processes, return_as="generator_unordered")(calls)


def table(records: Iterable[Record]) -> str:
    """Format one line a family: cases passed and expected to pass, and the criterion; then the cases that failed."""
    rows = sorted((record.values for record in records), key=lambda row: (row["family"], row["number"]))
    lines = [f"{'cases':<18}{'reached':>10}{'asked':>10}  of each"]
    for name, family in FAMILIES.items():
        if passed := [row["ok"] for row in rows if row["family"] == name]:
            reached, asked = f"{sum(passed)} of {len(passed)}", f"{family.asked} of {family.size}"
            lines.append(f"{name:<18}{reached:>10}{asked:>10}  {family.what}")
    missed = [f"  {x['family']} {x['number']}  {x['name']}: {x['truth']} -> {x['found']}" for x in rows if not x["ok"]]
    return "\n".join([*lines, *(["", "missed", *missed] if missed else [])])
