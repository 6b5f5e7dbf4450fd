"""Measures updates per second of H2O+ and SAC, beside the authors' code.

python recipes/benchmarks/update.py                        # two minutes; HalfCheetah's sizes, the authors' batches
python recipes/benchmarks/update.py compiled=false seconds=1
python recipes/benchmarks/update.py authors=H2Oplus    # also the authors' code, from a clone of t6-thu/H2Oplus
python recipes/benchmarks/update.py device=cuda

Contenders take turns, so that other load on the machine affects all of them alike. On one thread of a CPU, updates are
counted per second of CPU time. Writes a record to outputs/benchmark/speed. Between machines compare ratios.
"""

import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from authors import authors_update
from omegaconf import DictConfig
from options import read_options, run_options
from tensordict import TensorDict
from torchrl.data import Bounded
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.comparison.records import Record
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.compiling import compiled
from torchrl_h2o.training.methods import h2o_plus, rlpd, sac

WARM_UP = 10  # calls
SIZES = {"observation_dim": 17, "action_dim": 6, "transitions": 100_000}  # HalfCheetah's; transitions of each stream


def calls_per_second(
    functions: Mapping[str, Callable[[], object]],
    seconds: float,
    turns: int,
    device: str = "cpu",
    least: int = WARM_UP,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Calls per second of each function, the best of several turns.

    Args:
        functions: by name.
        seconds: length of one turn.
        turns: number of turns of each function, after one to warm up.
        device: of the computation; a GPU is synchronised.
        least: minimum number of calls in a turn.
        clock: seconds of wall time, or ``time.process_time``, which on one thread does not count the time that other
            processes take.
    """
    synchronise = torch.cuda.synchronize if torch.device(device).type == "cuda" else lambda: None
    best = dict.fromkeys(functions, 0.0)
    with tqdm(desc="measuring", total=len(functions) * (1 + turns), unit=" turns") as bar:
        for turn in range(1 + turns):
            for name, function in functions.items():
                bar.set_postfix_str(name)
                synchronise()
                start, calls = clock(), 0
                while calls < least or (turn and clock() - start < seconds):
                    function()
                    calls += 1
                synchronise()
                if turn:  # the first is to warm up
                    best[name] = max(best[name], calls / (clock() - start))
                bar.update()
    return best


def some_transitions(cfg: DictConfig) -> TensorDict:
    """Random transitions of the right sizes."""
    shape = (cfg.transitions, cfg.observation_dim)
    done = torch.zeros(cfg.transitions, 1, dtype=torch.bool)
    return TensorDict(
        observation=torch.randn(shape),
        action=torch.rand(cfg.transitions, cfg.action_dim) * 2.0 - 1.0,
        next=TensorDict(
            observation=torch.randn(shape), reward=torch.randn(cfg.transitions, 1), done=done, terminated=done.clone()
        ),
        batch_size=[cfg.transitions],
    )


def filled_replay(cfg: DictConfig, run: DictConfig) -> HybridReplayBuffer:
    replay = HybridReplayBuffer(some_transitions(cfg), cfg.transitions, run.batch_size, device=cfg.device)
    replay.extend(some_transitions(cfg))
    return replay


def action_spec(cfg: DictConfig) -> Bounded:
    return Bounded(-1.0, 1.0, (cfg.action_dim,))


def contenders(cfg: DictConfig, run: DictConfig) -> dict[str, Callable[[], object]]:
    """Build the contenders, each a function that makes one update."""
    replay = filled_replay(cfg, run)
    what = (run, cfg.observation_dim, action_spec(cfg), replay)
    chosen: dict[str, Callable[[], object]] = {"H2O+, not compiled": h2o_plus.make_learner(*what).update}
    if cfg.authors:
        chosen["H2O+, the authors' code"] = authors_update(cfg, run, replay)
    if cfg.compiled:
        learner = h2o_plus.make_learner(*what)
        learner.terms_of = compiled(learner.terms_of, learner.parameters)
        chosen["H2O+, compiled"] = learner.update
    torchrl_sac = sac.make_learner(*what)
    torchrl_sac.batch_sizes = [run.batch_size]
    chosen["SAC, TorchRL's loss, not compiled"] = torchrl_sac.update
    chosen["SAC of our parts, not compiled"] = rlpd.make_learner(*what).update  # on both streams, too
    return chosen


def recipe_on(cfg: DictConfig) -> DictConfig:
    """Read the defaults of a run, and set torch's threads and device."""
    torch.set_num_threads(cfg.threads)
    if cfg.device != "cpu":  # a default device slows every call down, also the CPU
        torch.set_default_device(cfg.device)
    return run_options("env=halfcheetah")


def device_name(device: str) -> str:
    """Name of the GPU, or of the kind of CPU with torch's threads."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.machine()} CPU, {torch.get_num_threads()} thread{'s' * (torch.get_num_threads() > 1)}"


def main() -> None:
    cfg = read_options(
        **SIZES,
        seconds=3.0,  # length of one turn
        turns=4,  # of each contender; the best counts
        compiled=True,  # also measure compiled losses; needs a C++ compiler and half a minute
        authors=None,  # a clone of t6-thu/H2Oplus
        num_cells=[256, 256],
        layer_norm=False,  # in Q; False as in the authors' code
        threads=1,  # of torch; with one thread, CPU time is measured
        device="cpu",
        folder="outputs/benchmark/speed",
    )
    run = recipe_on(cfg)
    run.num_cells, run.layer_norm = cfg.num_cells, cfg.layer_norm
    functions = contenders(cfg, run)
    clock = time.process_time if cfg.device == "cpu" and cfg.threads == 1 else time.perf_counter
    rates = calls_per_second(functions, cfg.seconds, cfg.turns, cfg.device, clock=clock)
    reference = rates.get("H2O+, the authors' code", rates["H2O+, not compiled"])
    values = {"device": device_name(cfg.device), "clock": clock.__name__, "updates_per_second": rates}
    path = Record.of_this_process("speed", f"update_{cfg.device}_{cfg.threads}", values).save(Path(cfg.folder))
    for name, rate in rates.items():
        print(f"{name:<40}{rate:>10.1f} updates/s{rate / reference:>10.2f} ×")
    print(f"\nresults    {path}")


if __name__ == "__main__":
    with one_line_errors():
        main()
