"""Measures a population's updates per second, summed over members, and estimates the time of the paper's main table.

python recipes/benchmarks/population.py                                # on a CPU
python recipes/benchmarks/population.py device=cuda compiled=[1,8,32,128]   # on a GPU, also with CUDA graphs

In the same session it measures a single run with the losses of `recipes/h2o_plus.py`. All figures include sampling and
exclude the simulator. Writes population.json to the run's folder.
"""

import json
import os
import platform
from collections.abc import Callable
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from options import PopulationOptions
from turns import calls_per_second
from update import action_spec, recipe_on, some_transitions

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.compiling import compiled
from torchrl_h2o.training.cuda_graph import fit_to_device
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.methods import h2o_plus
from torchrl_h2o.training.populations import PopulationReplay
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.whole_file import write_text

SINGLE = "a single run"


def make_population(cfg: DictConfig, run: DictConfig, num_members: int) -> PopulationLearner:
    """Build runs of different seeds on the same data, each with its own buffer."""
    replay = PopulationReplay(some_transitions(cfg), cfg.transitions, run.batch_size, num_members, device=cfg.device)
    learners = []
    for seed, buffer in enumerate(replay.buffers):
        buffer.extend(some_transitions(cfg))
        learners.append(make_single(cfg, run, buffer, seed))
    return PopulationLearner(learners, replay, run.lr, run.tau)


def make_single(cfg: DictConfig, run: DictConfig, replay: HybridReplayBuffer, seed: int = 0) -> Learner:
    own = OmegaConf.merge(run, {"seed": seed})
    return h2o_plus.make_learner(own, cfg.observation_dim, action_spec(cfg), replay)


def contenders(cfg: DictConfig, run: DictConfig, num_members: int) -> dict[str, Callable[[], object]]:
    """Build the contenders, each a function that makes one update of every member."""
    on_gpu = torch.device(cfg.device).type == "cuda"
    chosen = {"stacked": make_population(cfg, run, num_members).update}
    if num_members == 1:
        replay = HybridReplayBuffer(some_transitions(cfg), cfg.transitions, run.batch_size, device=cfg.device)
        replay.extend(some_transitions(cfg))
        chosen = {SINGLE: make_single(cfg, run, replay).update} | chosen
        if on_gpu:
            chosen[f"{SINGLE}, CUDA graph"] = with_cuda_graphs(make_single(cfg, run, replay)).update
    if on_gpu:
        chosen["stacked, CUDA graph"] = with_cuda_graphs(make_population(cfg, run, num_members)).update
    if num_members in cfg.compiled:
        learner = make_population(cfg, run, num_members)
        learner.losses_of = compiled(learner.losses_of)
        chosen["compiled"] = learner.update
        if on_gpu:
            learner = make_population(cfg, run, num_members)
            learner.losses_of = compiled(learner.losses_of)
            chosen["compiled, CUDA graph"] = with_cuda_graphs(learner).update
    return chosen


def with_cuda_graphs(learner: Learner | PopulationLearner) -> Learner | PopulationLearner:
    learner.use_cuda_graphs()
    fit_to_device(learner.optimiser, learner.replay.device)
    return learner


def measure(cfg: DictConfig, run: DictConfig) -> list[dict]:
    """Measure each size and contender: updates per second of the population, and of its members together."""
    lines = []
    for num_members in cfg.members:
        functions = contenders(cfg, run, num_members)
        rates = calls_per_second(functions, cfg.seconds, cfg.turns, cfg.device, least=cfg.calls)
        lines += [
            {
                "members": num_members,
                "way": way,
                "updates_per_second": rate,
                "run_updates_per_second": num_members * rate,
            }
            for way, rate in rates.items()
        ]
    return lines


def device_name(device: str) -> str:
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.machine()} CPU, {torch.get_num_threads()} threads"


def print_table(result: dict) -> None:
    single = next((line["updates_per_second"] for line in result["lines"] if line["way"] == SINGLE), None)
    print(f"\n{'on ' + result['device']:<34}{'members':>8}{'updates/s':>12}{'run-updates/s':>15}{'× single':>10}")
    for line in result["lines"]:
        rate, together = line["updates_per_second"], line["run_updates_per_second"]
        times_single = f"{together / single:>10.2f}" if single else ""
        print(f"{line['way']:<34}{line['members']:>8}{rate:>12.1f}{together:>15.1f}{times_single}")
    tasks, seeds, updates = result["table"]["tasks"], result["table"]["seeds"], result["table"]["updates"]
    print(
        f"\nThe paper's main table, {tasks} tasks x {seeds} seeds x {updates:,} updates, would take "
        f"{result['table']['hours']:,.1f} h of updates at the best of these rates, without simulation and evaluation."
    )


@hydra_main("../config", "population_benchmark", PopulationOptions)
def main(cfg: DictConfig) -> None:
    run = recipe_on(cfg)
    lines = measure(cfg, run)
    best = max(line["run_updates_per_second"] for line in lines)
    tasks, seeds, updates = cfg.table
    table = {"tasks": tasks, "seeds": seeds, "updates": updates, "hours": tasks * seeds * updates / best / 3600}
    result = {"lines": lines, "device": device_name(cfg.device), "table": table, "torch": torch.__version__}
    directory = Path(HydraConfig.get().runtime.output_dir)
    write_text(directory / "population.json", json.dumps(result, indent=2) + "\n")
    print_table(result)
    print(f"\nresults    {os.path.relpath(directory)}/population.json")


if __name__ == "__main__":
    main()
