"""Runs the cases of a benchmark in parallel; a case that raises an error becomes a row with that error."""

import csv
import json
import multiprocessing
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import torch
from cases import draw_case
from families import all_families
from speed import CountingSimulation
from tqdm import tqdm

from torchrl_h2o.residuals import Report
from torchrl_h2o.whole_file import whole_file, write_text

COLUMNS = ("family", "number", "name", "system", "truth", "found", "ok")
MEASURED = ("error_before", "error_after", "error_floor", "auc_before", "auc_after", "wall_s", "steps", "simulating_s")


@dataclass(frozen=True)
class Job:
    """One case to run.

    Args:
        family: its family.
        number: its number in the family.
        seed: of the benchmark.
        directory: where to save its report.
        logs: the folder of the real logs, None for none.
    """

    family: str
    number: int
    seed: int
    directory: Path
    logs: Path | None = None


def run_case(job: Job, trace: Callable[..., Report]) -> dict:
    """Draw, measure, trace and judge a case.

    Args:
        job: the case.
        trace: the code under test.

    Returns:
        The true effects, the effects found, and the scores.
    """
    torch.set_num_threads(1)
    case = draw_case(all_families(job.logs), job.family, job.number, job.seed)
    simulation = CountingSimulation.of(case.simulation())
    report = trace(
        simulation, case.measure(), source=case.system, held_out=case.held_out, seed=job.seed, progress=False
    )
    report.save(job.directory / "reports" / f"{job.family}_{job.number}")
    error, two_sample = report.error, report.two_sample
    return {
        "family": job.family,
        "number": job.number,
        "name": case.name,
        "system": case.system,
        "truth": case.truth_in_words,
        "found": ", ".join(effect.describe() for effect in report.effects) or report.conclusion or "nothing",
        "error_before": None if error is None else error.before,
        "error_after": None if error is None else error.after,
        "error_floor": None if error is None else error.floor,
        "auc_before": two_sample.auc_before,
        "auc_after": two_sample.auc_after,
        "wall_s": report.wall_s,
        "steps": simulation.count.steps,
        "simulating_s": simulation.count.seconds,
        **case.judge(report, case),
    }


def run_all(jobs: Sequence[Job], processes: int, trace: Callable[..., Report], *, progress: bool = True) -> list[dict]:
    """Run all cases and save the results after each.

    Args:
        jobs: the cases.
        processes: number of worker processes; 1 runs the cases in this process.
        trace: the code under test.
        progress: whether to show a progress bar.

    Returns:
        One row per case, in the order of the jobs.
    """
    rows: dict[Job, dict] = {}
    with tqdm(total=len(jobs), unit=" cases", disable=not progress) as bar:
        for job, outcome in _outcomes(jobs, processes, trace):
            rows[job] = _row(job, outcome)
            passed = sum(row["ok"] for row in rows.values())
            bar.set_postfix_str(f"{passed} of {len(rows)} passed; {job.family} {job.number}")
            bar.update()
            save_rows([rows[job] for job in jobs if job in rows], job.directory)
    return [rows[job] for job in jobs]


def _outcomes(jobs: Sequence[Job], processes: int, trace: Callable[..., Report]):
    """Yield each finished job with a function that returns its row or raises its error."""
    if processes == 1:
        for job in jobs:
            yield job, lambda job=job: run_case(job, trace)
        return
    spawn = multiprocessing.get_context("spawn")  # MuJoCo's and torch's threads do not survive a fork
    with ProcessPoolExecutor(processes, mp_context=spawn) as pool:
        futures: dict[Future, Job] = {pool.submit(run_case, job, trace): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result


def _row(job: Job, outcome: Callable[[], dict]) -> dict:
    try:
        return outcome()
    except Exception as error:  # a failed case must not end the others
        failure = "".join(traceback.format_exception(error))
        found = f"failed: {type(error).__name__}: {error}"
        return {"family": job.family, "number": job.number, "ok": False, "found": found, "traceback": failure}


def save_rows(rows: Sequence[dict], directory: Path) -> None:
    """Write results.json (all fields) and results.csv (the columns of a table)."""
    directory.mkdir(parents=True, exist_ok=True)
    text = json.dumps(rows, indent=1, default=float, ensure_ascii=False)
    write_text(directory / "results.json", text + "\n")
    with whole_file(directory / "results.csv") as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*COLUMNS, *MEASURED], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
