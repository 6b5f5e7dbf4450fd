"""Measures how often close_the_loop finds randomly drawn effects from a simulator and data.

python recipes/benchmarks/close_the_loop.py                                    # all families, some hours
python recipes/benchmarks/close_the_loop.py cases=[paper16,nothing] draws=3
python recipes/benchmarks/close_the_loop.py cases=[several] numbers=[7] minutes=5     # one case, a limited search

Writes a record of each case and its report.html to outputs/benchmark/close_the_loop. Cases that the same commit has
recorded there are skipped, so an interrupted benchmark goes on. `recipes/results/make.py store` stores the records.
"""

from pathlib import Path

from options import read_options
from running import FAMILIES, TABLE, Job, run_all, table
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.comparison.records import read_records
from torchrl_h2o.options.nearest import did_you_mean
from torchrl_h2o.residuals import close_the_loop


def main() -> None:
    cfg = read_options(
        cases=list(FAMILIES),
        draws=None,  # cases of each family; None for all
        numbers=None,  # only these cases, such as [3,7]
        seed=0,
        minutes=None,  # most minutes of a search
        processes=2,
        folder="outputs/benchmark/close_the_loop",
    )
    for unknown in set(cfg.cases) - set(FAMILIES):
        raise SystemExit(f"cases=[{unknown}]: choose from {', '.join(FAMILIES)}{did_you_mean(unknown, FAMILIES)}")
    jobs = [
        Job(name, number, cfg.seed, cfg.minutes)
        for name in cfg.cases
        for number in cfg.numbers or range(min(FAMILIES[name].size, cfg.draws or FAMILIES[name].size))
        if number < FAMILIES[name].size
    ]
    folder = Path(cfg.folder)
    done = {record.name: record for record in read_records(folder, TABLE) if record.is_current}
    records = [done[job.name] for job in jobs if job.name in done]
    with tqdm(total=len(jobs), initial=len(records), unit=" cases") as bar:
        for record in run_all([job for job in jobs if job.name not in done], cfg.processes, close_the_loop, folder):
            records.append(record)
            bar.set_postfix_str(f"{sum(r.values['ok'] for r in records)} of {len(records)} passed; {record.name}")
            bar.update()
    print(f"\n{table(records)}\n\nresults    {folder}/{TABLE}, {folder}/reports")


if __name__ == "__main__":
    main()
