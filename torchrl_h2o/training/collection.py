"""Collectors of simulated transitions: in this process, in worker processes, or in Ray workers on many machines.

The collectors are TorchRL's. Workers receive the policy's weights and send transitions. Each worker has its own
simulator and random streams, seeded from the run's seed.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from operator import methodcaller
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, EnvCreator

from torchrl_h2o.training.environments import simulator_maker
from torchrl_h2o.training.ongoing_episodes import saves_episodes
from torchrl_h2o.training.progress import Budget


class SeededCollector(Collector):
    """Collector of a Ray worker whose seed also seeds the policy's noise, as in TorchRL's other workers."""

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        torch.manual_seed(seed)
        return super().set_seed(seed, static_seed)


def simulated_transitions(simulator: EnvBase, actor: torch.nn.Module, steps_per_epoch: int) -> Collector:
    """Builds the collector of this process, whose episodes go on from batch to batch if the simulator can save them.

    Args:
        simulator: the environment, ``[]`` or ``[N]``.
        actor: the policy.
        steps_per_epoch: number of transitions of a batch, of all worlds together.
    """
    if saves_episodes(simulator):
        return Collector(simulator, actor, frames_per_batch=steps_per_epoch)
    return Collector(simulator, actor, frames_per_batch=steps_per_epoch, reset_at_each_iter=True, set_truncated=True)


@contextmanager
def collecting(
    cfg: DictConfig, simulator: EnvBase, actor: torch.nn.Module, keys: Sequence[NestedKey]
) -> Iterator[BaseCollector]:
    """Yields a collector that returns one epoch of simulated transitions at a time; shuts its workers down at the end.

    Call ``update_policy_weights_()`` to send the policy's current weights. Episodes go on in the next batch if this
    process simulates and the simulator can save them, see
    :class:`~torchrl_h2o.training.ongoing_episodes.OngoingEpisodes`. Otherwise every batch begins with
    new episodes, and its last transitions are marked as truncated.

    Args:
        cfg: the run's configuration.
        simulator: the environment of this process; workers build their own.
        actor: the policy.
        keys: the entries of a transition that Ray's workers send back.
    """
    chosen = cfg.collector
    options = {"frames_per_batch": cfg.steps_per_epoch, "reset_at_each_iter": True}
    with ExitStack() as stack:
        if chosen.backend == "direct":
            collector = simulated_transitions(simulator, actor, cfg.steps_per_epoch)
        elif chosen.backend == "process":
            threads = torch.get_num_threads()  # by default TorchRL would divide them among the workers
            stack.callback(torch.set_num_threads, threads)
            options |= {"num_collectors": chosen.workers, "sync": True, "backend_options": {"num_threads": threads}}
            collector = Collector(_of_worker(cfg), actor, backend="process", set_truncated=True, **options)
        else:  # ray
            stack.enter_context(_ray(chosen))
            options |= {"num_collectors": chosen.workers, "sync": True, "backend_options": _ray_options(cfg, keys)}
            collector = Collector(_of_worker(cfg), actor, backend="ray", **options)
        stack.callback(collector.shutdown)
        yield collector


def _of_worker(cfg: DictConfig) -> EnvCreator:
    return cast(EnvCreator, simulator_maker(cfg))  # TorchRL accepts any function, although it annotates its own class


def _ray_options(cfg: DictConfig, keys: Sequence[NestedKey]) -> dict:
    """Further arguments of TorchRL's RayCollector."""
    chosen = cfg.collector
    return {
        # Without a total, RayCollector collects nothing.
        "total_frames": Budget.from_config(cfg).epochs * cfg.steps_per_epoch,
        "collector_class": SeededCollector,
        "collector_kwargs": [
            {"postproc": methodcaller("select", *keys), "set_truncated": True} for _ in range(chosen.workers)
        ],
        "remote_configs": OmegaConf.to_container(chosen.resources),
    }


@contextmanager
def _ray(chosen: DictConfig) -> Iterator[None]:
    """Connects to Ray: the runtime of this process, the cluster of this machine, or a new one.

    Raises:
        RuntimeError: if the workers need more processors than the cluster has; Ray would wait without a message.
    """
    import ray  # optional dependency

    mine = not ray.is_initialized()
    if mine:
        ray.init(**chosen.init)
    try:
        needed, there = chosen.workers * chosen.resources.num_cpus, ray.cluster_resources().get("CPU", 0)
        if needed > there:
            raise RuntimeError(
                f"collector.workers={chosen.workers} of collector.resources.num_cpus={chosen.resources.num_cpus} need "
                f"{needed} processors and Ray has {there:.0f}: ask for fewer, or add machines with ray start --address"
            )
        yield
    finally:
        if mine:
            ray.shutdown()
