"""Measures a population's updates per second, summed over its members.

python recipes/benchmarks/population.py                                # on a CPU
python recipes/benchmarks/population.py device=cuda compiled=[1,8,32,128]   # on a GPU, also with CUDA graphs

In the same session it measures a single run with the losses of `recipes/h2o_plus.py`. All figures include sampling and
exclude the simulator. Writes a record to outputs/benchmark/speed.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from options import read_options
from update import SIZES, action_spec, calls_per_second, device_name, filled_replay, recipe_on, some_transitions

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.comparison.records import Record
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.compiling import compiled
from torchrl_h2o.training.cuda_graph import fit_to_device
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.methods import h2o_plus
from torchrl_h2o.training.populations import PopulationReplay
from torchrl_h2o.training.populations.learner import PopulationLearner


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

    def stacked() -> PopulationLearner:
        return make_population(cfg, run, num_members)

    def stacked_and_compiled() -> PopulationLearner:
        learner = stacked()
        learner.losses_of = compiled(learner.losses_of)
        return learner

    def single() -> Learner:
        return make_single(cfg, run, filled_replay(cfg, run))

    ways: dict[str, Callable[[], Learner | PopulationLearner]] = {"a single run": single} if num_members == 1 else {}
    ways["a population"] = stacked
    if num_members in cfg.compiled:
        ways["a population, compiled"] = stacked_and_compiled
    chosen = {name: make().update for name, make in ways.items()}
    if torch.device(cfg.device).type == "cuda":
        chosen |= {f"{name}, CUDA graphs": with_cuda_graphs(make()).update for name, make in ways.items()}
    return chosen


def with_cuda_graphs(learner: Learner | PopulationLearner) -> Learner | PopulationLearner:
    learner.use_cuda_graphs()
    fit_to_device(learner.optimiser, learner.replay.device)
    return learner


def main() -> None:
    cfg = read_options(
        **SIZES | {"transitions": 10_000},
        members=[1, 8, 32],
        compiled=[1],  # sizes to measure compiled as well, one or two minutes each
        seconds=2.0,  # length of one turn
        turns=2,  # of each contender; the best counts
        calls=1,  # minimum in a turn: one call of a large population takes seconds
        threads=2,  # of torch
        device="cpu",
        folder="outputs/benchmark/speed",
    )
    run, rates = recipe_on(cfg), {}
    for members in cfg.members:
        found = calls_per_second(contenders(cfg, run, members), cfg.seconds, cfg.turns, cfg.device, least=cfg.calls)
        rates |= {f"{members} member{'s' * (members > 1)}, {way}": members * rate for way, rate in found.items()}
    values = {"device": device_name(cfg.device), "updates_per_second": rates}
    path = Record.of_this_process("speed", f"population_{cfg.device}", values).save(Path(cfg.folder))
    for name, rate in rates.items():
        print(f"{name:<44}{rate:>10.1f} updates/s of all members together")
    print(f"\nresults    {path}")


if __name__ == "__main__":
    with one_line_errors():
        main()
