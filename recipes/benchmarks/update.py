"""Measures updates per second: of the library, of a textbook implementation, and of the matrix products alone.

python recipes/benchmarks/update.py                        # two minutes; HalfCheetah's sizes, the authors' batches
python recipes/benchmarks/update.py compiled=false seconds=1
python recipes/benchmarks/update.py authors=H2Oplus    # also the authors' code, from a clone of t6-thu/H2Oplus
python recipes/benchmarks/update.py device=cuda

Contenders take turns, so that other load on the machine affects all of them alike. On one thread of a CPU, updates are
counted per second of CPU time. Writes update.json to the run's folder. Between machines compare ratios.
"""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import torch
from authors import authors_update
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from options import UpdateOptions
from tensordict import TensorDict
from textbook import TextbookH2OPlus
from torch.utils.flop_counter import FlopCounterMode
from torchrl.data import Bounded
from turns import calls_per_second

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import H2OPlusLoss, HybridLoss
from torchrl_h2o.objectives.network_calls import NetworkCalls
from torchrl_h2o.training.compiling import compiled
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.methods import h2o_plus, rlpd, sac
from torchrl_h2o.training.precision import at_precision, has_bf16
from torchrl_h2o.whole_file import write_text

PRODUCT = 2048  # rows and columns of the matrices whose product is timed


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


def textbook(cfg: DictConfig, run: DictConfig, replay: HybridReplayBuffer) -> Callable[[], object]:
    """Build a textbook's update: plain tensors, drawn by index."""
    method = TextbookH2OPlus(cfg.observation_dim, cfg.action_dim, run.num_cells[0])
    real, sim = (
        {
            "observation": stored["observation"],
            "action": stored["action"],
            "reward": stored["next", "reward"].squeeze(-1),
            "terminated": stored["next", "terminated"].squeeze(-1).float(),
            "next_observation": stored["next", "observation"],
        }
        for stored in (replay.real.storage[:], replay.sim.storage[:])
    )
    (n_real, n_sim), (pairs_real, pairs_sim) = run.batch_size, run.discriminator_batch_size

    def draw(stream: dict[str, torch.Tensor], size: int) -> dict[str, torch.Tensor]:
        index = torch.randint(cfg.transitions, (size,))
        return {key: value[index] for key, value in stream.items()}

    return lambda: method.update(draw(real, n_real), draw(sim, n_sim), draw(real, pairs_real), draw(sim, pairs_sim))


def action_spec(cfg: DictConfig) -> Bounded:
    return Bounded(-1.0, 1.0, (cfg.action_dim,))


def contenders(cfg: DictConfig, run: DictConfig) -> dict[str, Callable[[], object]]:
    """Build the contenders, each a function that makes one update."""
    replay = HybridReplayBuffer(some_transitions(cfg), cfg.transitions, run.batch_size, device=cfg.device)
    replay.extend(some_transitions(cfg))
    what = (run, cfg.observation_dim, action_spec(cfg), replay)
    chosen = {"textbook": textbook(cfg, run, replay)}
    if cfg.authors:
        chosen["authors' code"] = authors_update(cfg, run, replay)
    if cfg.compiled:
        learner = h2o_plus.make_learner(*what)
        learner.terms_of = compiled(learner.terms_of, learner.parameters)
        chosen["ours"] = learner.update
        learner = h2o_plus.make_learner(*what)
        learner.terms_of = compiled(learner.terms_of)
        chosen["ours, gradients in a second graph"] = learner.update
        learner = knowing_real_rows(h2o_plus.make_learner(*what), run)
        learner.terms_of = compiled(learner.terms_of, learner.parameters)
        chosen["ours, num_real"] = learner.update
        if cfg.device == "cpu" and has_bf16():
            learner = knowing_real_rows(h2o_plus.make_learner(*what), run)
            learner.terms_of = compiled(at_precision(learner.terms_of, "bf16"), learner.parameters)
            chosen["ours, num_real, precision=bf16"] = learner.update
        learner = not_accelerated(h2o_plus.make_learner(*what))
        learner.terms_of = compiled(learner.terms_of, learner.parameters)
        chosen["ours, not accelerated"] = learner.update
    chosen["ours, not compiled"] = h2o_plus.make_learner(*what).update
    chosen["ours, neither"] = not_accelerated(h2o_plus.make_learner(*what)).update
    torchrl_sac = sac.make_learner(*what)
    torchrl_sac.batch_sizes = [run.batch_size]
    chosen["SAC, TorchRL's loss"] = torchrl_sac.update
    chosen["SAC of our parts"] = rlpd.make_learner(*what).update  # on both streams, too
    return chosen


def knowing_real_rows(learner: Learner, run: DictConfig) -> Learner:
    """Let the compiled loss compute each term on the rows of one stream where it needs no others."""
    cast(H2OPlusLoss, learner.terms_of).num_real = run.batch_size[0]
    return learner


def not_accelerated(learner: Learner) -> Learner:
    """Let the losses call their networks as modules, TorchRL's way."""
    for loss in learner.losses.values():
        for part in loss.modules():
            if isinstance(part, HybridLoss):
                part.calls = NetworkCalls()
    return learner


def matrix_product(device: str) -> Callable[[], object]:
    a, b = torch.randn(2, PRODUCT, PRODUCT, device=device)
    return lambda: a @ b


def products_of(update: Callable[[], object]) -> int:
    """Floating-point operations of one update's matrix products."""
    with FlopCounterMode(display=False) as counter:
        update()
    return counter.get_total_flops()


def print_table(result: dict) -> None:
    rates = result["updates_per_second"]
    references = {"textbook": "textbook", "authors": "authors' code"}
    references = {title: rates[name] for title, name in references.items() if name in rates}
    titles = "".join(f"{f'× {title}':>12}" for title in references)
    print(f"\n{'an update of H2O+':<34}{'a second':>10}{titles}{'of the limit':>14}")
    for name, rate in rates.items():
        if name.startswith("SAC"):
            continue
        ratios = "".join(f"{rate / reference:>12.2f}" for reference in references.values())
        print(f"{name:<34}{rate:>10.1f}{ratios}{rate / result['limit']:>14.0%}")
    gflop = result["flop"] / 1e9
    print(f"{f'matrix products alone ({gflop:.2f} GFLOP)':<34}{result['limit']:>10.1f}")
    sac_rates = {name: rate for name, rate in rates.items() if name.startswith("SAC")}
    print(f"\n{'an update of SAC':<34}{'a second':>10}")
    for name, rate in sac_rates.items():
        print(f"{name:<34}{rate:>10.1f}")


def recipe_on(cfg: DictConfig) -> DictConfig:
    """Read the recipe's constants, and set torch's threads and device."""
    torch.set_num_threads(cfg.threads)
    if cfg.device != "cpu":  # a default device slows every call down, also the CPU
        torch.set_default_device(cfg.device)
    return OmegaConf.load(Path(__file__).parents[1] / "config" / "experiment.yaml")


@hydra_main("../config", "update_benchmark", UpdateOptions)
def main(cfg: DictConfig) -> None:
    run = recipe_on(cfg)
    run.num_cells, run.layer_norm = cfg.num_cells, cfg.layer_norm
    functions = contenders(cfg, run)
    flop = products_of(functions["textbook"])
    functions |= {"product": matrix_product(cfg.device)}
    clock = time.process_time if cfg.device == "cpu" and cfg.threads == 1 else time.perf_counter
    measured = calls_per_second(functions, cfg.seconds, cfg.turns, cfg.device, clock=clock)
    gflops = 2.0 * PRODUCT**3 * measured.pop("product") / 1e9
    result = {"updates_per_second": measured, "flop": flop, "gflop_per_second": gflops, "limit": gflops * 1e9 / flop}
    directory = Path(HydraConfig.get().runtime.output_dir)
    result |= {"torch": torch.__version__, "threads": cfg.threads, "device": cfg.device, "clock": clock.__name__}
    write_text(directory / "update.json", json.dumps(result, indent=2) + "\n")
    print_table(result)
    print(f"\nresults    {os.path.relpath(directory)}/update.json")


if __name__ == "__main__":
    main()
