"""Systems for the benchmark of the dynamics ratio: Gaussian ones with a known ratio, and MuJoCo tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from options import run_options
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_h2o.objectives import make_actor
from torchrl_h2o.residuals import Simulation, simulate_transitions
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.task import Task

PAIR, DIM = 6, 4  # sizes of (s, a) and s of the Gaussian systems
MOST_REAL = 60_000  # rows of the real data of a MuJoCo task
STD = 0.5  # of the noise of the Gaussian systems


@dataclass(frozen=True)
class System:
    """Real and simulated transitions, as a learner sees them.

    Args:
        real: ``[T]``.
        sim: ``[N]``, rows of the simulator's own policy.
        simulated_next: ``[T, n]``, what the simulator makes of the real (s, a).
        truth: the true log-ratio of rows; None if it is not known.
        num_cells: hidden layers of the discriminators.
    """

    real: TensorDictBase
    sim: TensorDictBase
    simulated_next: Tensor
    truth: Callable[[TensorDictBase], Tensor] | None
    num_cells: tuple[int, int]


@dataclass(frozen=True)
class Gaussian:
    """s' = f(s, a) + noise, with differences between reality and simulator in mean and standard deviation.

    Args:
        shift: the simulator's mean is larger by this many standard deviations times tanh of the first state.
        scale: standard deviation of the simulator's noise, relative to that of reality.
        apart: distance between the means of the real and the simulated states, in standard deviations of the states.
    """

    shift: float = 0.0
    scale: float = 1.0
    apart: float = 0.0

    def make(self, rows: int, seed: int) -> System:
        rng = torch.Generator().manual_seed(seed)
        of_real = self._pairs(rows, -self.apart / 2, rng)
        of_sim = self._pairs(rows, self.apart / 2, rng)
        real_next = self._mean(of_real, 0.0) + STD * torch.randn(rows, DIM, generator=rng)
        both = [
            self._mean(pairs, self.shift) + self.scale * STD * torch.randn(rows, DIM, generator=rng)
            for pairs in (of_real, of_sim)
        ]
        return System(_transitions(of_real, real_next), _transitions(of_sim, both[1]), both[0], self._truth, (64, 64))

    def _pairs(self, rows: int, mean: float, rng: torch.Generator) -> Tensor:
        pairs = torch.randn(rows, PAIR, generator=rng)
        pairs[:, 0] += mean
        pairs[:, DIM:] = torch.tanh(pairs[:, DIM:] + mean)
        return pairs

    def _mean(self, pairs: Tensor, shift: float) -> Tensor:
        state, action = pairs[:, :DIM], pairs[:, DIM:]
        mean = state + 0.3 * torch.sin(state.roll(1, -1))
        mean[:, :2] += 0.5 * action
        mean[:, 0] += shift * STD * torch.tanh(state[:, 0])
        return mean

    def _truth(self, rows: TensorDictBase) -> Tensor:
        pairs, following = torch.cat([rows["observation"], rows["action"]], -1), rows["next", "observation"]
        real = torch.distributions.Normal(self._mean(pairs, 0.0), STD)
        sim = torch.distributions.Normal(self._mean(pairs, self.shift), self.scale * STD)
        return (real.log_prob(following) - sim.log_prob(following)).sum(-1)


@dataclass(frozen=True)
class Mujoco:
    """A task of the library; the simulated rows are those of an untrained policy.

    Args:
        env: name of the environment's configuration.
        equal: whether the simulator has all effects of reality and no others.
        gap: the paper's dynamics gap of the simulator, by its name.
        data: the real data; None for those of the configuration.
        num_cells: hidden layers of the discriminators.
    """

    env: str
    equal: bool = False
    gap: str | None = None
    data: str | None = None
    num_cells: tuple[int, int] = (256, 256)

    def make(self, rows: int, seed: int) -> System:
        task, preprocessing, real, simulated_next = self._prepared()
        sim = collected(task.make_simulator(20, preprocessing), rows, seed)
        return System(real, sim, simulated_next, None, self.num_cells)

    @cache  # noqa: B019  (the systems are constants of this module)
    def _prepared(self) -> tuple[Task, Preprocessing, TensorDictBase, Tensor]:
        cfg = run_options(f"env={self.env}")
        if self.equal:
            cfg.env.simulator = cfg.env.reality
        task = Task.from_config(cfg.env, gap=self.gap)
        raw = task.read_real_data(self.data or cfg.data, cfg.columns)[:MOST_REAL]
        preprocessing = Preprocessing.fit(raw, normalise=cfg.normalise_observation)
        simulation = Simulation.from_env(task.make_simulator())
        following = simulate_transitions(simulation, raw)
        real = preprocessing.apply(raw)
        return task, preprocessing, real, preprocessing.next_observation(real, following)


def collected(env: EnvBase, rows: int, seed: int) -> TensorDictBase:
    """Collects rows under an untrained policy."""
    torch.manual_seed(seed)
    env.set_seed(seed)
    actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec_unbatched, (64, 64))
    steps, state = [], env.reset()
    with torch.no_grad():
        for _ in range(-(-rows // max(1, env.batch_size.numel()))):
            step, state = env.step_and_maybe_reset(actor(state))
            steps.append(step.select("observation", "action", ("next", "observation")))
    return torch.stack(steps).reshape(-1)[:rows]


def _transitions(pairs: Tensor, following: Tensor) -> TensorDict:
    state, action = pairs[:, :DIM], pairs[:, DIM:]
    return TensorDict(
        observation=state,
        action=action,
        next=TensorDict(observation=following, batch_size=len(pairs)),
        batch_size=len(pairs),
    )


SYSTEMS = {
    "gaussian equal": Gaussian(apart=1.0),
    "gaussian mean": Gaussian(shift=1.0, apart=1.0),
    "gaussian variance": Gaussian(scale=1.3, apart=1.0),
    "halfcheetah equal": Mujoco("halfcheetah"),
    "halfcheetah gravity": Mujoco("halfcheetah", gap="gravity"),
    "walker2d equal": Mujoco("walker2d"),
    "walker2d gravity": Mujoco("walker2d", gap="gravity"),
    "robot equal": Mujoco("wheel_legged", equal=True, num_cells=(64, 64)),
    "robot gap": Mujoco("wheel_legged", num_cells=(64, 64)),
}
