"""Where simulated transitions come from: a simulator in this process, or workers on this machine or on many.

The collectors are TorchRL's. Weights go out to the workers, transitions come in. Each worker has a simulator and random
streams of its own, seeded from the run's seed.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from operator import methodcaller

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase

from torchrl_h2o.training import environments
from torchrl_h2o.training.environments import simulator_maker
from torchrl_h2o.training.run_folder import num_epochs

DIRECT = OmegaConf.create({"backend": "direct"})


class SeededCollector(Collector):
    """What a Ray worker runs: its seed is also that of the policy's noise, as it is in TorchRL's other workers."""

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        torch.manual_seed(seed)
        return super().set_seed(seed, static_seed)


def check_collector(cfg: DictConfig) -> None:
    """Says before a run what its collector lacks.

    Raises:
        ModuleNotFoundError: for Ray's workers without Ray.
        ValueError: for workers and worlds that cannot share an epoch's steps alike.
    """
    chosen = _chosen(cfg)
    if chosen.backend == "ray" and find_spec("ray") is None:
        raise ModuleNotFoundError("collector=ray needs Ray: pip install 'torchrl_h2o[ray]', here and where workers run")
    workers = chosen.get("workers", 1)
    if workers < 1 or cfg.num_worlds < 1 or cfg.steps_per_epoch % (workers * cfg.num_worlds):
        raise ValueError(
            f"collector.workers={workers} num_worlds={cfg.num_worlds}: all worlds of all workers share the steps of an "
            f"epoch alike; choose so many that steps_per_epoch={cfg.steps_per_epoch} is a multiple of them"
        )


@contextmanager
def collecting(
    cfg: DictConfig, simulator: EnvBase, actor: torch.nn.Module, keys: Sequence[NestedKey]
) -> Iterator[BaseCollector]:
    """A collector of an epoch's simulated transitions at a time, whose workers end with the block.

    Its policy is as old as the last ``update_policy_weights_()``. Every batch begins with fresh episodes, so that an
    epoch depends on its seed and its policy alone.

    Args:
        cfg: the run's configuration.
        simulator: what steps in this process; workers make their own.
        actor: the policy.
        keys: the entries of a transition that Ray's workers send.
    """
    chosen = _chosen(cfg)
    options = {"frames_per_batch": cfg.steps_per_epoch, "reset_at_each_iter": True}
    with ExitStack() as stack:
        if chosen.backend == "direct":
            collector = Collector(simulator, actor, **options)
        elif chosen.backend == "process":
            threads = torch.get_num_threads()  # which TorchRL would share out among the workers
            stack.callback(torch.set_num_threads, threads)
            options |= {"num_collectors": chosen.workers, "sync": True, "backend_options": {"num_threads": threads}}
            collector = Collector(simulator_maker(cfg), actor, backend="process", **options)
        elif chosen.backend == "ray":
            stack.enter_context(_ray(chosen))
            options |= {"num_collectors": chosen.workers, "sync": True, "backend_options": _ray_options(cfg, keys)}
            collector = Collector(simulator_maker(cfg), actor, backend="ray", **options)
        else:
            raise ValueError(f"collector.backend={chosen.backend}: choose direct, process or ray")
        stack.callback(collector.shutdown)
        yield collector


def _chosen(cfg: DictConfig) -> DictConfig:
    return cfg.get("collector") or DIRECT  # a run of an earlier version says nothing of it


def _ray_options(cfg: DictConfig, keys: Sequence[NestedKey]) -> dict:
    """What TorchRL's RayCollector takes beside what all take."""
    chosen = cfg.collector
    return {
        "total_frames": num_epochs(cfg) * cfg.steps_per_epoch,  # without it, there are none
        "collector_class": SeededCollector,
        "collector_kwargs": [{"postproc": methodcaller("select", *keys)} for _ in range(chosen.workers)],
        "remote_configs": OmegaConf.to_container(chosen.resources),
    }


@contextmanager
def _ray(chosen: DictConfig) -> Iterator[None]:
    """Ray's runtime: the one that this process is in already, the cluster of this machine, or a new one.

    Raises:
        RuntimeError: for more workers than the cluster has room for: they would be waited for, without a word.
    """
    import ray  # an extra

    # Other machines have the library but not the recipes: these travel with what is made of them.
    for module in (environments, sys.modules[__name__]):
        ray.cloudpickle.register_pickle_by_value(module)
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
