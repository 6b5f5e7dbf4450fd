"""Compares estimators of the dynamics ratio: mean ratio, effective sample size, and error against known ratios.

python recipes/benchmarks/ratio.py                                       # an hour on one core
python recipes/benchmarks/ratio.py 'systems=[gaussian mean]' steps=[500] # one system
python recipes/benchmarks/ratio.py estimators=[pairs] rows=[1000]

The ratio is evaluated on the simulated rows that the discriminators were trained on, as in the losses, and the true one
on new rows. With equal dynamics the mean ratio is 1, and the mean clamped ratio at most 1. MuJoCo tasks need
MINARI_DATASETS_PATH or a download. Writes a record of each training to outputs/benchmark/ratio,
skips those that the same commit has recorded there, and prints the means.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import pandas as pd
import torch
from omegaconf import DictConfig
from options import read_options
from ratio_systems import SYSTEMS, System
from tensordict import TensorDictBase
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.data import HybridReplayBuffer, PairedTransitions
from torchrl_h2o.objectives import DynamicsRatioLoss, fit_change_scale, make_dynamics_ratio_estimator, total_loss
from torchrl_h2o.provenance import cpu_seconds

NEXT = ("next", "observation")
KEYS = ("observation", "action", NEXT)
TABLE = "ratio"
Sample = Callable[[tuple[int, int]], TensorDictBase]


def make_loss(name: str, system: System, cfg: DictConfig) -> DynamicsRatioLoss:
    """Builds an estimator by its name, with the loss that trains it."""
    sizes = system.real["observation"].shape[-1], system.real["action"].shape[-1], system.num_cells
    scale = fit_change_scale(system.real)
    options = {
        "paper": {},
        "noise_on_next": {"logit_bound": (None, 2.0)},
        "change": {"logit_bound": (None, 2.0), "change_scale": scale},
        "pairs": {"logit_bound": cfg.ratio_logit_bound, "change_scale": scale, "with_sa_network": False},
    }[name]
    estimator = make_dynamics_ratio_estimator(*sizes, **options)
    if name == "pairs":
        return DynamicsRatioLoss(
            estimator,
            input_noise={NEXT: cfg.change_noise},
            weight_penalty=cfg.ratio_weight_penalty,
            delay_estimator=cfg.delayed,
        )
    noise = cfg.input_noise if name == "paper" else {NEXT: cfg.input_noise}
    return DynamicsRatioLoss(estimator, input_noise=noise, delay_estimator=cfg.delayed and name == "change")


def make_sampler(name: str, system: System, rows: int) -> Sample:
    """Builds the function that draws batches for the discriminators."""
    if name == "pairs":
        return PairedTransitions(system.real, system.simulated_next).sample
    replay = HybridReplayBuffer(system.real, rows, keys=KEYS)
    replay.extend(system.sim[:rows])
    return replay.sample


def shuffled(name: str, system: System, rows: int) -> System:
    """Deals real and simulated rows to the two streams at random; of pairs, the two next observations."""
    if name == "pairs":
        swap, real = torch.rand(len(system.real), 1) < 0.5, system.real.select(*KEYS).clone()
        simulated_next = torch.where(swap, system.real[NEXT], system.simulated_next)
        real[NEXT] = torch.where(swap, system.simulated_next, system.real[NEXT])
        return replace(system, real=real, simulated_next=simulated_next)
    some = system.real[torch.randperm(len(system.real))[:rows]]
    both = torch.cat([some.select(*KEYS), system.sim[: len(some)].select(*KEYS)])
    both = both[torch.randperm(len(both))]
    return replace(system, real=both[: len(some)], sim=both[len(some) :])


def train(loss: DynamicsRatioLoss, sample: Sample, cfg: DictConfig, steps: int) -> None:
    optimiser = torch.optim.Adam(loss.parameters(), lr=cfg.lr, fused=True)
    targets = SoftUpdate(loss, tau=cfg.tau) if loss.delay_estimator else None
    for _ in range(steps):
        losses = loss(sample(tuple(cfg.batch_size)))
        optimiser.zero_grad()
        total_loss(losses).backward()
        optimiser.step()
        if targets is not None:
            targets.step()


def measure(loss: DynamicsRatioLoss, system: System, new: System, rows: int) -> dict[str, float]:
    """Measures the ratio of the simulated rows, and its error on new rows."""
    log_ratio, weight = loss.log_and_clamped_ratio(system.sim[:rows])
    ratio = log_ratio.exp()
    log_of_new = loss.log_and_clamped_ratio(new.sim)[0]
    found = {
        "unclamped": ratio.mean(),
        "clamped": weight.mean(),
        "ess": weight.sum() ** 2 / weight.square().sum() / len(weight),
        "ess_unclamped": ratio.sum() ** 2 / ratio.square().sum() / len(ratio),
        "unclamped_new": log_of_new.exp().mean(),
    }
    if system.truth is not None:
        truth = system.truth(new.sim)
        if truth.std() > 0:
            found["correlation"] = torch.corrcoef(torch.stack([log_of_new, truth]))[0, 1]
            found["slope"] = torch.cov(torch.stack([log_of_new, truth]))[0, 1] / truth.var()
    return {key: float(value) for key, value in found.items()}


def train_and_measure(cfg: DictConfig, case: dict, system: System, new: System) -> dict:
    """Trains one estimator and returns a line of the table."""
    torch.manual_seed(case["seed"])
    rows, name = case["rows"], case["estimator"].removesuffix(", shuffled")
    trained_on = shuffled(name, system, rows) if name != case["estimator"] else system
    loss = make_loss(name, trained_on, cfg)
    train(loss, make_sampler(name, trained_on, rows), cfg, case["steps"])
    held = {key: float(value) for key, value in _accuracies(loss, name, new).items()}
    return {**case, "delayed": loss.delay_estimator, **held, **measure(loss, trained_on, new, rows)}


@torch.no_grad()
def _accuracies(loss: DynamicsRatioLoss, name: str, new: System) -> dict[str, torch.Tensor]:
    batch = make_sampler(name, new, len(new.sim))((4000, 4000))
    figures = loss.eval()(batch)
    return {key: value for key, value in figures.items() if key.startswith("accuracy")}


def means(records: list[Record]) -> str:
    """Format the means over seeds, one line for each system and estimator."""
    told = pd.DataFrame([record.values for record in records])
    by = ["system", "rows", "steps", "estimator"]
    return told.drop(columns=["seed", "delayed"]).groupby(by).mean().round(2).to_string()


def main() -> None:
    cfg = read_options(
        estimators=["paper", "noise_on_next", "change", "pairs"],
        systems=list(SYSTEMS),
        seeds=[0, 1, 2],
        rows=[2000, 20_000],  # simulated rows: of the first epochs, and later
        steps=[1500],  # updates of the discriminators
        batch_size=[256, 256],  # real, simulated
        shuffled=["paper", "pairs"],  # estimators that are also trained on shuffled labels, as a control
        lr=1e-3,
        input_noise=0.1,  # of all estimators except pairs
        change_noise=0.05,  # of pairs, and its penalty and bound: the defaults of a run
        ratio_weight_penalty=2e-3,
        ratio_logit_bound=4.0,
        delayed=True,  # whether the ratio of change and pairs is that of averaged discriminators
        tau=0.005,  # weight of the current discriminators in an update of the average
        threads=1,  # of torch
        folder="outputs/benchmark/ratio",
    )
    torch.set_num_threads(cfg.threads)
    folder, names = Path(cfg.folder), [*cfg.estimators, *(f"{name}, shuffled" for name in cfg.shuffled)]
    done = {record.name: record for record in read_records(folder, TABLE) if record.is_current}
    records = []
    for system_name, seed in tqdm(list(product(cfg.systems, cfg.seeds)), unit=" systems"):
        prepared: list[System] = []
        for estimator, rows, steps in product(names, cfg.rows, cfg.steps):
            case = {"system": system_name, "seed": seed, "estimator": estimator, "rows": rows, "steps": steps}
            name = "_".join(str(part) for part in case.values()).replace(", ", "_").replace(" ", "_")
            if name not in done:
                prepared = prepared or [SYSTEMS[system_name].make(max(cfg.rows), one) for one in (seed, seed + 1000)]
                start = cpu_seconds()
                values = train_and_measure(cfg, case, *prepared)
                done[name] = Record.of_this_process(TABLE, name, values, start)
                done[name].save(folder)
            records.append(done[name])
    print(f"\n{means(records)}\n\nresults    {folder}/{TABLE}")


if __name__ == "__main__":
    with one_line_errors():
        main()
