"""Measures how the cost of an update and the throughput grow with their sizes.

python recipes/benchmarks/scaling.py                       # about ten minutes; up to ten million transitions
python recipes/benchmarks/scaling.py buffer_sizes=[100_000,100_000_000] scratch=/data
python recipes/benchmarks/scaling.py device=cuda

One factor varies at a time. Updates are measured against buffer, batch, width and population; these configurations take
turns. Memory-mapped buffers are removed at the end; a buffer that does not fit is skipped with a message. Writes
scaling.json, scaling.png (seconds and memory of an update) and growth.png (throughput, and the size from which more do
not pay) to the run's folder.
"""

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from cost_figure import draw_growth, draw_scaling
from growth import Rate, collection_rates, pays_until
from hydra.core.hydra_config import HydraConfig
from memory import held, room_in_memory, room_on_disk, taken_by
from omegaconf import DictConfig, OmegaConf
from options import ScalingOptions
from population import make_population
from tensordict import TensorDict
from tqdm import tqdm
from turns import calls_per_second
from update import action_spec, recipe_on, some_transitions

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.methods import h2o_plus
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.whole_file import write_text


@dataclass(frozen=True)
class Cost:
    """Cost of an update.

    Args:
        grows: the factor: buffer, batch (rows of a stream), width (of a hidden layer) or population (runs).
        size: value of the factor.
        storage: of the simulated transitions.
        memory: bytes of a buffer without mapped files; for other factors the peak of the first update (gradients,
            optimiser state, activations).
        seconds_per_update: including sampling.
        seconds_per_sample: for all batches of an update.
    """

    grows: str
    size: int
    storage: str
    memory: int
    seconds_per_update: float = 0.0
    seconds_per_sample: float = 0.0

    def __str__(self) -> str:
        return f"{self.grows} {self.size:,}, {self.storage}"


def fill(real: TensorDict, size: int, device: str, folder: str | None = None) -> HybridReplayBuffer:
    """Fill a buffer with ``size`` simulated transitions, in memory or in files of a folder."""
    replay = HybridReplayBuffer(real, size, device=device, scratch_dir=folder)
    for first in range(0, size, len(real)):
        replay.extend(real[: size - first])
    return replay


def make_learner(cfg: DictConfig, run: DictConfig, replay: HybridReplayBuffer, **constants: object) -> Learner:
    """H2O+ with the recipe's constants, overridden by ``constants``."""
    return h2o_plus.make_learner(OmegaConf.merge(run, constants), cfg.observation_dim, action_spec(cfg), replay)


def larger_buffers(cfg: DictConfig, run: DictConfig, real: TensorDict, scratch: str) -> Iterator[tuple[Cost, Learner]]:
    """Learners on buffers of increasing size, each in memory and in files."""
    rows = real.select("observation", "action", "next")
    each = sum(value.nbytes for value in rows.values(True, True)) // len(rows)
    on_gpu = torch.device(cfg.device).type == "cuda"
    for size in cfg.buffer_sizes:
        rooms = {"in memory": room_in_memory()} | ({} if on_gpu else {"memory-mapped": room_on_disk(scratch)})
        for storage, room in rooms.items():
            if size * each > room:
                tqdm.write(
                    f"skipped: {size:,} transitions {storage} need {size * each:,} bytes, {room:,} are available"
                )
                continue
            before = held(cfg.device)
            folder = f"{scratch}/{size}" if storage == "memory-mapped" else None
            replay = fill(real, size, cfg.device, folder)
            yield Cost("buffer", size, storage, held(cfg.device) - before), make_learner(cfg, run, replay)


def larger_learners(cfg: DictConfig, run: DictConfig, real: TensorDict) -> Iterator[tuple[Cost, Learner]]:
    """Learners with increasing batches or networks, on one buffer."""
    replay = fill(real, cfg.transitions, cfg.device)
    make_learner(cfg, run, replay).update()  # one-time allocations of the process
    batches = {size: {"batch_size": [size] * 2, "discriminator_batch_size": [2 * size] * 2} for size in cfg.batch_sizes}
    widths = {width: {"num_cells": [width] * 2} for width in cfg.widths}
    for grows, choices in {"batch": batches, "width": widths}.items():
        for size, constants in choices.items():
            learner = make_learner(cfg, run, replay, **constants)
            yield Cost(grows, size, "in memory", taken_by(learner.update, cfg.device)), learner


def larger_populations(cfg: DictConfig, run: DictConfig) -> Iterator[tuple[Cost, PopulationLearner]]:
    """Populations of increasing size, each member with its own buffer."""
    for size in cfg.populations:
        learner = make_population(cfg, run, size)
        yield Cost("population", size, "in memory", taken_by(learner.update, cfg.device)), learner


def measure(cfg: DictConfig, run: DictConfig, scratch: str) -> list[Cost]:
    """Seconds and memory of each configuration."""
    real = some_transitions(cfg)
    contenders = [
        *larger_buffers(cfg, run, real, scratch),
        *larger_learners(cfg, run, real),
        *larger_populations(cfg, run),
    ]
    functions = {}
    for cost, learner in contenders:
        functions[f"update, {cost}"] = learner.update
        functions[f"sample, {cost}"] = learner.sample
    rates = calls_per_second(functions, cfg.seconds, cfg.turns, cfg.device)
    return [
        replace(cost, seconds_per_update=1 / rates[f"update, {cost}"], seconds_per_sample=1 / rates[f"sample, {cost}"])
        for cost, _ in contenders
    ]


def member_rates(costs: list[Cost]) -> list[Rate]:
    """Updates per second of all runs of a population together."""
    sizes = [cost for cost in costs if cost.grows == "population"]
    return [Rate("population", cost.size, cost.size / cost.seconds_per_update) for cost in sizes]


def print_growth(rates: list[Rate]) -> None:
    print(f"\n{'what grows':<20}{'per second':>14}")
    for rate in rates:
        print(f"{f'{rate.grows} {rate.size:,}':<20}{rate.per_second:>14,.0f}")
    ends = pays_until(rates)
    for grows in dict.fromkeys(rate.grows for rate in rates):
        largest = max(rate.size for rate in rates if rate.grows == grows)
        end = f"more than {ends[grows]:,} do not pay here" if grows in ends else f"{largest:,}, the most measured, pay"
        print(f"{grows}: {end}")


def print_table(costs: list[Cost]) -> None:
    print(f"\n{'what grows':<40}{'ms an update':>14}{'ms a sample':>14}{'MB':>10}")
    for cost in costs:
        times = f"{1e3 * cost.seconds_per_update:>14.2f}{1e3 * cost.seconds_per_sample:>14.3f}"
        print(f"{cost!s:<40}{times}{cost.memory / 1e6:>10.1f}")


@hydra_main("../config", "scaling_benchmark", ScalingOptions)
def main(cfg: DictConfig) -> None:
    run = recipe_on(cfg)
    with TemporaryDirectory(dir=cfg.scratch) as scratch:
        costs = measure(cfg, run, scratch)
    rates = [*collection_rates(cfg), *member_rates(costs)]
    directory = Path(HydraConfig.get().runtime.output_dir)
    result = {"costs": [asdict(cost) for cost in costs], "growth": [asdict(rate) for rate in rates]}
    result |= {"pays_until": pays_until(rates), "torch": torch.__version__}
    result |= {"threads": cfg.threads, "device": cfg.device}
    write_text(directory / "scaling.json", json.dumps(result, indent=2) + "\n")
    draw_scaling(directory / "scaling.png", result["costs"])
    draw_growth(directory / "growth.png", result["growth"], result["pays_until"])
    print_table(costs)
    print_growth(rates)
    print(f"\nresults    {os.path.relpath(directory)}/scaling.json, scaling.png, growth.png")


if __name__ == "__main__":
    main()
