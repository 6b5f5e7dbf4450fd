"""Measures how often a designed log decides between explanations, beside other logs of the same length and limits.

python recipes/benchmarks/next_experiment.py                     # 40 cases, hours
python recipes/benchmarks/next_experiment.py numbers=[0,1,2] processes=2

In each case a slow first log leaves rivals. A second log of 5 s follows: designed by `next_experiment`, D-optimal for
the values of the first explanation, or random steps, a chirp or a multisine at the largest size within the limits. Then
the loop is closed on both logs. Writes a record of each case to outputs/benchmark/next_experiment; cases that the same
commit has recorded there are skipped.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import joblib
import numpy as np
import torch
from options import read_options
from rival_cases import RivalCase
from scoring import is_exact_set, part_of
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.effects import Effect
from torchrl_h2o.experiment import Envelope, joined
from torchrl_h2o.experiment.design import Setting, best_commands
from torchrl_h2o.experiment.excitation import candidate
from torchrl_h2o.experiment.expected import told_apart
from torchrl_h2o.experiment.next_experiment import setting_of
from torchrl_h2o.experiment.separation import Motion
from torchrl_h2o.provenance import cpu_seconds
from torchrl_h2o.residuals import Report, Simulation, close_the_loop
from torchrl_h2o.residuals.report.sampling import explanations_of
from torchrl_h2o.residuals.report.words import effect_words

TABLE = "next_experiment"
CASES, DRAWS = 40, 10  # cases, and draws of each, of which the first whose log leaves rivals is taken
ENVELOPE = Envelope(seconds=5.0, within=0.6, speed=4.0, band=3.0)
DESIGNED, RANDOM = ("designed", "D-optimal"), {"random": "steps", "chirp": "chirp", "multisine": "multisine"}


def open_sets(report: Report) -> list[tuple[Effect, ...]]:
    """The explanations that a report leaves open."""
    return [tuple(effect for effect, _ in fitted) for fitted in explanations_of(report)]


def is_right(effects: Iterable[Effect], truth: Effect, simulation: Simulation) -> bool:
    """Whether a set is the true effect and no other, on some of its elements."""
    effects = list(effects)
    return bool(effects) and all(part_of(effect, truth, simulation) for effect in effects)


def is_decided(report: Report, case: RivalCase, simulation: Simulation) -> bool:
    """Whether a report has the true effect on all its elements, and leaves no other explanation open."""
    rivals = [one for one in open_sets(report) if not is_right(one, case.truth, simulation)]
    return is_exact_set(report, (case.truth,), simulation) and not rivals


def drawn_case(number: int, seed: int) -> tuple[RivalCase, Report] | None:
    """The first draw whose slow log does not decide, and the report of it; None if each log decides."""
    for draw in range(DRAWS):
        case = RivalCase.draw(number, np.random.default_rng((seed, 31, number, draw)))
        simulation = case.simulation()
        report = close_the_loop(simulation, case.log(case.motion(case.first_commands()), 0), progress=False)
        if report.found and not is_decided(report, case, simulation):
            return case, report
    return None


def commands_of(strategy: str, setting: Setting, minutes: float, rng: np.random.Generator) -> np.ndarray:
    """Knots of the commands of a strategy, within the same limits."""
    if strategy == "designed":
        return best_commands(setting, rng, 60.0 * minutes)
    if strategy == "D-optimal":
        return best_commands(setting, rng, 60.0 * minutes, value=setting.narrowing)
    while True:
        shape = candidate(RANDOM[strategy], setting.seconds, len(setting.command), setting.band, rng)
        knots = setting.largest(shape)
        if knots is not None and not setting.touches(knots):
            return knots


def exceeded(motion: Motion, setting: Setting) -> float:
    """By how much a motion breaks the limits of positions and velocities, as a share of them; 0 if it keeps them."""
    position, velocity = np.split(motion.states, [len(setting.limits.position)], axis=1)
    middle, half = setting.limits.position.mean(1), np.ptp(setting.limits.position, axis=1) / 2.0
    far = np.abs(position - middle).max(0) / half
    return float(max(far.max(), np.abs(velocity).max() / setting.limits.speed, 1.0) - 1.0)


def run_case(number: int, seed: int, minutes: float, folder: Path) -> Record | None:
    """Run all strategies in a case, and save its record; None if no draw leaves rivals."""
    torch.set_num_threads(1)
    start, drawn = cpu_seconds(), drawn_case(number, seed)
    if drawn is None:
        return None
    case, report = drawn
    simulation, first = case.simulation(), case.log(case.motion(case.first_commands()), 0)
    setting = setting_of(simulation, first, report, ENVELOPE, np.random.default_rng(seed))
    values = {
        "number": number,
        "pair": case.pair,
        "name": case.name,
        "truth": case.truth.describe(),
        "noise": case.noise,
        "first": [_words(effects, simulation) for effects in open_sets(report)],
        "strategies": {},
    }
    for strategy in (*DESIGNED, *RANDOM):
        begin, rng = cpu_seconds(), np.random.default_rng((seed, number))
        knots = commands_of(strategy, setting, minutes, rng)
        motion = case.motion(setting.commands(knots))
        after = close_the_loop(simulation, joined(case.log(motion, 1), first), progress=False)
        told = {
            "decided": is_decided(after, case, simulation),
            "explanations": [_words(effects, simulation) for effects in open_sets(after)],
            "exceeded": exceeded(motion, setting),
            "nats": float(np.mean(list(setting.nats(knots).values()) or [0.0])),
        }
        if strategy == "designed":
            apart = told_apart(setting, first, knots, rng)
            told["pairs"] = list(_expected(setting, apart, after, case, simulation))
        values["strategies"][strategy] = told | {"cpu_s": cpu_seconds() - begin}
    record = Record.of_this_process(TABLE, f"{number:02}" + (f"_seed{seed}" if seed else ""), values, start)
    record.save(folder)
    return record


def _expected(
    setting: Setting, apart: np.ndarray, after: Report, case: RivalCase, simulation: Simulation
) -> Iterable[tuple[float, bool]]:
    """The probability that each rival of the true explanation is told from it, and whether it was."""
    sets = [one.found.effects for one in setting.explanations]
    right = [index for index, effects in enumerate(sets) if is_right(effects, case.truth, simulation)]
    left = [{type(effect) for effect in effects} for effects in open_sets(after)]
    for index, effects in enumerate(sets):
        if right and index not in right:
            yield float(apart[right[0], index]), {type(effect) for effect in effects} not in left


def _words(effects: Iterable[Effect], simulation: Simulation) -> str:
    return ", ".join(effect_words(effect, simulation.names) for effect in effects)


def table(records: Iterable[Record]) -> str:
    """How many cases each strategy decides, and those that the designed log does not."""
    rows = [record.values for record in records]
    lines = [f"{'second log':<12}{'decided':>10}"]
    for strategy in (*DESIGNED, *RANDOM):
        decided = [row["strategies"][strategy]["decided"] for row in rows]
        lines.append(f"{strategy:<12}{sum(decided):>4} of {len(decided)}")
    missed = [row for row in rows if not row["strategies"]["designed"]["decided"]]
    lines += [
        f"  {row['number']} {row['name']}: {row['truth']} -> {row['strategies']['designed']['explanations']}"
        for row in missed
    ]
    return "\n".join(lines)


def main() -> None:
    cfg = read_options(
        numbers=list(range(CASES)),
        seed=0,
        minutes=1.0,  # of the CPU, to design a log
        processes=2,
        folder="outputs/benchmark/next_experiment",
    )
    folder = Path(cfg.folder)
    done = {record.values["number"]: record for record in read_records(folder, TABLE) if record.is_current}
    calls = [
        joblib.delayed(run_case)(number, cfg.seed, cfg.minutes, folder) for number in cfg.numbers if number not in done
    ]
    records = list(done.values())
    with tqdm(total=len(cfg.numbers), initial=len(records), unit=" cases") as bar:
        for record in joblib.Parallel(cfg.processes, return_as="generator_unordered")(calls):
            records += [] if record is None else [record]
            bar.update()
    print(f"\n{table(records)}\n\nresults    {folder}/{TABLE}")


if __name__ == "__main__":
    main()
