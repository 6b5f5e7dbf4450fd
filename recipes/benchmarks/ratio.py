"""Compares estimators of the dynamics ratio: mean ratio, effective sample size, and error against known ratios.

python recipes/benchmarks/ratio.py                                       # an hour on one core
python recipes/benchmarks/ratio.py 'systems=[gaussian mean]' steps=[500] # one system
python recipes/benchmarks/ratio.py estimators=[pairs] rows=[1000]

The ratio is evaluated on the simulated rows that the discriminators were trained on, as in the losses, and the true one
on new rows. With equal dynamics the mean ratio is 1, and the mean clamped ratio at most 1. MuJoCo tasks need
MINARI_DATASETS_PATH or a download. Writes ratio.csv to the run's folder, one line per training, and prints the means.
"""

import csv
import os
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from options import RatioOptions
from ratio_systems import SYSTEMS, System
from tensordict import TensorDictBase
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.data import HybridReplayBuffer, PairedTransitions
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    accelerate,
    fit_change_scale,
    make_dynamics_ratio_estimator,
    total_loss,
)
from torchrl_h2o.whole_file import whole_file

NEXT = ("next", "observation")
KEYS = ("observation", "action", NEXT)
COLUMNS = (
    "unclamped", "clamped", "ess", "ess_unclamped", "unclamped_new", "accuracy_sa", "accuracy", "correlation", "slope"
)  # fmt: skip
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
    loss = accelerate(make_loss(name, trained_on, cfg))
    train(loss, make_sampler(name, trained_on, rows), cfg, case["steps"])
    held = {key: float(value) for key, value in _accuracies(loss, name, new).items()}
    return {**case, "delayed": loss.delay_estimator, **held, **measure(loss, trained_on, new, rows)}


@torch.no_grad()
def _accuracies(loss: DynamicsRatioLoss, name: str, new: System) -> dict[str, torch.Tensor]:
    batch = make_sampler(name, new, len(new.sim))((4000, 4000))
    figures = loss.eval()(batch)
    return {key: value for key, value in figures.items() if key.startswith("accuracy")}


def print_table(lines: list[dict]) -> None:
    print(f"\n{'system':<20}{'estimator':<18}{'rows':>7}{'steps':>6}" + "".join(f"{name:>15}" for name in COLUMNS))
    groups = dict.fromkeys((line["system"], line["rows"], line["steps"], line["estimator"]) for line in lines)
    for group in sorted(groups, key=str):
        system, rows, steps, estimator = group
        own = [x for x in lines if (x["system"], x["rows"], x["steps"], x["estimator"]) == group]
        shown = "".join(_cell([line[name] for line in own if name in line]) for name in COLUMNS)
        print(f"{system:<20}{estimator:<18}{rows:>7}{steps:>6}{shown}")


def _cell(values: list[float]) -> str:
    if not values:
        return " " * 15
    values_ = torch.tensor(values)
    return f"{f'{values_.mean():.2f} ± {values_.std(correction=0):.2f}':>15}"


@hydra_main("../config", "ratio_benchmark", RatioOptions)
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    directory = Path(HydraConfig.get().runtime.output_dir)
    names = [*cfg.estimators, *(f"{name}, shuffled" for name in cfg.shuffled)]
    cases = list(product(cfg.seeds, cfg.systems))
    inner = list(product(names, cfg.rows, cfg.steps))
    lines = []
    with tqdm(total=len(cases) * len(inner), unit=" trainings") as bar:
        for seed, name in cases:
            system, new = (SYSTEMS[name].make(max(cfg.rows), one) for one in (seed, seed + 1000))
            for estimator, rows, steps in inner:
                case = {"system": name, "seed": seed, "estimator": estimator, "rows": rows, "steps": steps}
                lines.append(train_and_measure(cfg, case, system, new))
                bar.update()
                with whole_file(directory / "ratio.csv") as partial, partial.open("w", newline="") as file:
                    writer = csv.DictWriter(file, [*case, "delayed", *COLUMNS], extrasaction="ignore")
                    writer.writeheader()
                    writer.writerows(lines)
    print_table(lines)
    print(f"\nresults    {os.path.relpath(directory)}/ratio.csv")


if __name__ == "__main__":
    main()
