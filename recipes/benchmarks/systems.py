"""The systems of the benchmark: how their envs are made, what moves them, and how they are measured."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import torch
from gymnasium.wrappers import TimeLimit
from pendulum import PendulumEnv
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, GymEnv, GymWrapper, TransformedEnv

from torchrl_h2o.effects import Effect
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record

Policy = Callable[[TensorDictBase], TensorDictBase]


class Excitation:
    """Smooth random actions: an Ornstein-Uhlenbeck process whose strength and mean change in bursts.

    Args:
        bound: of the actions, (nu).
        strongest: standard deviation of the strongest burst, in bounds of the action.
        brake: feedback from the observation (n) against each action, (nu, n), that keeps joints with little friction
            from ever faster turns; None for none.
    """

    memory = math.exp(-1 / 5)  # of the process, from one control step to the next
    burst = 50  # steps, on average
    weakest = 0.2  # standard deviation, in bounds of the action

    def __init__(self, bound: torch.Tensor, strongest: float = 1.5, brake: torch.Tensor | None = None) -> None:
        self.bound, self.strongest, self.brake = bound, strongest, brake
        self.strength, self.mean, self.noise = strongest, torch.zeros_like(bound), torch.zeros_like(bound)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict["is_init"].any():
            self.noise = torch.zeros_like(self.bound)
        if torch.rand(()) < 1 / self.burst:
            self.strength = self.weakest + (self.strongest - self.weakest) * float(torch.rand(()))
            self.mean = 2.0 * torch.rand_like(self.bound) - 1.0
        self.noise = self.memory * self.noise + math.sqrt(1 - self.memory**2) * torch.randn_like(self.bound)
        action = self.strength * (self.noise + self.mean) * self.bound
        if self.brake is not None:
            action = action - self.brake @ tensordict["observation"].float()
        return tensordict.set("action", action.clamp(-self.bound, self.bound))


@dataclass(frozen=True)
class System:
    """A system that data are recorded of.

    Args:
        make: makes its env; an episode has at most so many steps.
        policy: makes what moves it.
        sensor_limit: the largest velocity that is reported; what is there stays there under noise.
    """

    make: Callable[[int], EnvBase]
    policy: Callable[[], Policy]
    sensor_limit: float = math.inf

    def env(self, effects: Sequence[Effect] = (), episode: int = 500) -> EnvBase:
        """The env with effects in it, and with episodes of at most so many steps."""
        return TransformedEnv(self.make(episode), DynamicsGap(*effects))

    def record(
        self, effects: Sequence[Effect], transitions: int, seed: int, *, noise: float = 0.0, episode: int = 500
    ) -> TensorDict:
        """Measures the system with effects in it.

        Args:
            effects: those of reality.
            transitions: how many.
            seed: of env, policy and noise.
            noise: standard deviation of every sensor's noise, as a share of the signal's own.
            episode: steps after which the system starts anew.

        Returns:
            TED, ``(transitions,)``.
        """
        data = record(self.env(effects, episode), self.policy(), transitions, seed, progress=False)
        return with_sensor_noise(data, noise, seed, self.sensor_limit) if noise else data


def with_sensor_noise(data: TensorDict, share: float, seed: int, limit: float = math.inf) -> TensorDict:
    """The data with noise on every observation, drawn once: what ends a row is what begins the next.

    Args:
        data: TED, ``(T,)``.
        share: the noise's standard deviation as a share of each observation's own.
        seed: of the noise.
        limit: the largest value that the sensors report.

    Returns:
        A noisy copy.
    """
    generator = torch.Generator().manual_seed(seed)
    before, after = data["observation"], data["next", "observation"]
    std = share * before.std(0)
    noisy_before = _measured(before, std, limit, generator)
    noisy_after = _measured(after, std, limit, generator)
    goes_on = ~data["next", "done"][:-1].flatten()
    noisy_after[:-1][goes_on] = noisy_before[1:][goes_on]
    noisy = data.clone()
    noisy["observation"], noisy["next", "observation"] = noisy_before, noisy_after
    return noisy


def _measured(true: torch.Tensor, std: torch.Tensor, limit: float, generator: torch.Generator) -> torch.Tensor:
    noisy = true + std * torch.randn(true.shape, generator=generator)
    # a sensor that is at its end stays there: how far beyond it the signal is, it does not know
    return torch.where(true.abs() >= limit, true, noisy.clamp(-limit, limit))


def _gymnasium(
    task: str,
    actions: int,
    strongest: float = 1.5,
    brake: torch.Tensor | None = None,
    limit: float = math.inf,
    **options: bool,
) -> System:
    return System(
        lambda episode: GymEnv(task, max_episode_steps=episode, **options),
        lambda: Excitation(torch.ones(actions), strongest, brake),
        limit,
    )


def _braked_joints(actions: int, observations: int, brake: float) -> torch.Tensor:
    """Feedback from each joint's velocity to its own motor, where these velocities are the last observations."""
    gains = torch.zeros(actions, observations)
    gains[:, observations - actions :] = brake * torch.eye(actions)
    return gains


SYSTEMS: Mapping[str, System] = MappingProxyType(
    {
        "HalfCheetah": _gymnasium("HalfCheetah-v5", actions=6),
        # gently, or most velocities are out of the sensors' range; goes on after a fall, or no thigh reaches its stop
        "Walker2d": _gymnasium(
            "Walker2d-v5",
            actions=6,
            strongest=0.7,
            brake=_braked_joints(6, 17, 0.07),
            limit=10.0,
            terminate_when_unhealthy=False,
        ),
        "Hopper": _gymnasium("Hopper-v5", actions=3, limit=10.0),
        "pendulum": System(
            lambda episode: GymWrapper(TimeLimit(PendulumEnv(), episode)),
            lambda: Excitation(torch.tensor([3.0]), brake=torch.tensor([[0.0, 0.2]])),
        ),
        "wheel_legged": System(
            lambda episode: WheelLeggedEnv(max_episode_steps=episode), lambda: noisy_balance_controller()
        ),
    }
)
