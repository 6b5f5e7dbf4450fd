"""Measures simulated steps per second: one world, many worlds at once, and ``mujoco.rollout`` alone.

python recipes/benchmarks/simulator.py                     # a minute or two
python recipes/benchmarks/simulator.py task=wheel_legged worlds=[64]

Actions are fixed; no policy is evaluated. ``mujoco.rollout`` starts from states on the env's trajectory, with the same
actions, because the time of a step depends on its contacts. Writes simulator.json to the run's folder. Between machines
compare ratios, not steps per second.
"""

import json
import os
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import mujoco
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from mujoco.rollout import Rollout
from omegaconf import DictConfig
from options import SimulatorOptions
from tensordict import TensorDict
from torchrl.envs import EnvBase, GymEnv
from torchrl.envs.utils import step_mdp
from turns import calls_per_second

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.envs import BatchedMujocoEnv, WheelLeggedEnv
from torchrl_h2o.whole_file import write_text

AHEAD = 20  # control steps of one call of mujoco.rollout
EPISODE = 1000  # control steps of the recorded trajectory


def make(cfg: DictConfig) -> EnvBase:
    return WheelLeggedEnv() if cfg.task == "wheel_legged" else GymEnv(cfg.task)


def begin(env: EnvBase) -> tuple[TensorDict, torch.Tensor]:
    """Initial state and actions of an env; equal for envs of the same task and size."""
    torch.manual_seed(0)
    env.set_seed(0)
    td = env.reset()
    return td, env.rand_action(td)["action"]


def stepping(env: EnvBase) -> Callable[[], object]:
    """Step an env repeatedly, resetting worlds that end."""
    td, action = begin(env)

    def step() -> None:
        nonlocal td
        td = env.maybe_reset(step_mdp(env.step(td.set("action", action))))

    return step


def gymnasium_stepping(env: EnvBase) -> Callable[[], object]:
    """Step a Gymnasium env without TorchRL."""
    task = env._env
    task.reset(seed=0)
    action = 0.1 * task.action_space.sample()

    def step() -> None:
        _, _, terminated, truncated, _ = task.step(action)
        if terminated or truncated:
            task.reset()

    return step


def bare_rollout(env: BatchedMujocoEnv, threads: int) -> Callable[[], object]:
    """Call ``mujoco.rollout`` along an env's trajectory, ``AHEAD`` steps at a time."""
    _, action = begin(env)
    step, starts = stepping(env), []
    for number in range(EPISODE):
        if number % AHEAD == 0:
            starts.append(env.states.copy())
        step()
    model = env.models[0]
    control = np.repeat(action[:, None].numpy().astype(float), AHEAD * env.physics_steps, axis=1)
    data, pool = [mujoco.MjData(model) for _ in range(threads)], Rollout(nthread=threads)
    pieces = cycle(starts)
    return lambda: pool.rollout(model, data, next(pieces), control)


@hydra_main("../config", "simulator_benchmark", SimulatorOptions)
def main(cfg: DictConfig) -> None:
    threads = cfg.threads or os.cpu_count()
    functions = {"TorchRL's env": stepping(make(cfg)), "Gymnasium alone": gymnasium_stepping(make(cfg))}
    steps = dict.fromkeys(functions, 1)
    for worlds in cfg.worlds:
        env = BatchedMujocoEnv(make(cfg), worlds, num_threads=threads)
        functions[f"BatchedMujocoEnv, {worlds}"], steps[f"BatchedMujocoEnv, {worlds}"] = stepping(env), worlds
        other = BatchedMujocoEnv(make(cfg), worlds, num_threads=threads)
        name = f"mujoco.rollout, {worlds}"
        functions[name], steps[name] = bare_rollout(other, threads), worlds * AHEAD
    rates = calls_per_second(functions, cfg.seconds, cfg.turns)
    per_second = {name: rate * steps[name] for name, rate in rates.items()}

    print(f"\n{cfg.task:<34}{'steps a second':>16}{'of mujoco.rollout':>20}")
    for name, rate in per_second.items():
        bare = per_second.get(name.replace("BatchedMujocoEnv", "mujoco.rollout"), rate)
        share = f"{rate / bare:.0%}" if name.startswith("BatchedMujocoEnv") else ""
        print(f"{name:<34}{rate:>16,.0f}{share:>20}")
    directory = Path(HydraConfig.get().runtime.output_dir)
    result = {"task": cfg.task, "threads": threads, "steps_per_second": per_second, "mujoco": mujoco.__version__}
    write_text(directory / "simulator.json", json.dumps(result, indent=2) + "\n")
    print(f"\nresults    {os.path.relpath(directory)}/simulator.json")


if __name__ == "__main__":
    main()
