"""Transitions per second of more worlds and of more Ray workers, and the size from which more do not pay."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_h2o.data.hybrid_replay import TRANSITION_KEYS
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.collection import collecting
from torchrl_h2o.training.environments import make_simulator

TASK = ("hydra.searchpath=[pkg://torchrl_h2o.config]", "env=halfcheetah", "gap=null")
STEPS = 200  # of each world in an epoch
PAYS = 1.1  # least growth of the rate from one size to the next


@dataclass(frozen=True)
class Rate:
    """Throughput of one size.

    Args:
        grows: the factor: worlds, workers or population (runs in one process).
        size: value of the factor.
        per_second: transitions, or updates of all members together.
    """

    grows: str
    size: int
    per_second: float


def collection_rates(cfg: DictConfig) -> list[Rate]:
    """Transitions per second in HalfCheetah, simulation and policy, for each number of worlds and of Ray workers."""
    jobs = [("worlds", size, [f"num_worlds={size}", f"steps_per_epoch={STEPS * size}"]) for size in cfg.worlds]
    if find_spec("ray") is None:
        tqdm.write("skipped: Ray's workers need pip install 'torchrl_h2o[ray]'")
    else:
        jobs += [("workers", size, _with_ray(size)) for size in cfg.workers]
    bar = tqdm(jobs, desc="collecting")
    rates = []
    for grows, size, overrides in bar:
        bar.set_postfix_str(f"{grows} {size}")
        rates.append(Rate(grows, size, _collected_per_second(overrides, cfg.seconds, cfg.turns)))
    return rates


def _with_ray(workers: int) -> list[str]:
    # without a share of the processors, because Ray refuses more workers than processors
    shares = ["collector.resources.num_cpus=0", "collector.init.address=local"]
    return ["collector=ray", f"collector.workers={workers}", f"steps_per_epoch={STEPS * workers}", *shares]


def _collected_per_second(overrides: Sequence[str], seconds: float, turns: int) -> float:
    """Transitions per second of a run's collector, the best of several turns.

    New weights are sent before each batch, as in training.
    """
    run = hydra.compose("any_method", [*TASK, *overrides])
    simulator = make_simulator(run, run.num_worlds)
    spec = simulator.observation_spec["observation"]
    actor = make_actor(spec.shape[-1], simulator.action_spec_unbatched, run.num_cells)
    best = 0.0
    with collecting(run, simulator, actor, TRANSITION_KEYS) as collector:
        rollouts = iter(collector)
        next(rollouts)  # starts the workers
        for _ in range(turns):
            start, transitions = time.perf_counter(), 0
            while time.perf_counter() - start < seconds:
                collector.update_policy_weights_()
                transitions += next(rollouts).numel()
            best = max(best, transitions / (time.perf_counter() - start))
    return best


def pays_until(rates: Iterable[Rate]) -> dict[str, int]:
    """For each factor, the last size before the first one that does not raise the rate by a tenth.

    A factor whose largest size still pays is left out.
    """
    last: dict[str, Rate] = {}
    ended = set()
    for rate in sorted(rates, key=lambda rate: rate.size):
        before = last.get(rate.grows)
        if before is not None and rate.per_second < PAYS * before.per_second:
            ended.add(rate.grows)
        if rate.grows not in ended:
            last[rate.grows] = rate
    return {grows: last[grows].size for grows in ended}
