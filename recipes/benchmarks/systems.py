"""The systems of the benchmark: their envs, excitation policies and sensors."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import torch
from gymnasium.wrappers import TimeLimit
from motored_env import CartPoleEnv, LegEnv, PendulumEnv, ReachingEnv, TwoLinksEnv
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, GymEnv, GymWrapper, TransformedEnv

from torchrl_h2o.effects import Effect
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record

Policy = Callable[[TensorDictBase], TensorDictBase]


class Excitation:
    """Smooth random actions from an Ornstein-Uhlenbeck process whose scale and mean change at random times.

    Args:
        bound: of the actions, (nu).
        strongest: standard deviation of the strongest burst, in bounds of the action.
        brake: feedback gains (nu, n) from the observation, subtracted from the action to limit the speed of joints with
            little friction; None for none.
    """

    memory = math.exp(-1 / 5)  # correlation between consecutive control steps
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
    """A system to record data from.

    Args:
        make: builds its env from the maximum number of steps of an episode.
        policy: builds the excitation policy.
        sensor_limit: largest velocity that sensors report; saturated readings stay saturated under noise.
    """

    make: Callable[[int], EnvBase]
    policy: Callable[[], Policy]
    sensor_limit: float = math.inf

    def env(self, effects: Sequence[Effect] = (), episode: int = 500) -> EnvBase:
        """Build the env with effects and episodes of at most ``episode`` steps."""
        return TransformedEnv(self.make(episode), DynamicsGap(*effects))

    def record(
        self, effects: Sequence[Effect], transitions: int, seed: int, *, noise: float = 0.0, episode: int = 500
    ) -> TensorDict:
        """Record the system with effects.

        Args:
            effects: those of reality.
            transitions: number of transitions.
            seed: for env, policy and noise.
            noise: standard deviation of every sensor's noise, as a share of the signal's own.
            episode: steps until a reset.

        Returns:
            TED, ``(transitions,)``.
        """
        data = record(self.env(effects, episode), self.policy(), transitions, seed, progress=False)
        return with_sensor_noise(data, noise, seed, self.sensor_limit) if noise else data


def with_sensor_noise(data: TensorDict, share: float, seed: int, limit: float = math.inf) -> TensorDict:
    """Add noise to every observation; the end of a row and the start of the next get the same noise.

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


def with_torque_noise(data: TensorDict, share: float, seed: int) -> TensorDict:
    """Add noise to the logged actions, as torque sensors do.

    Args:
        data: TED, ``(T,)``.
        share: the noise's standard deviation as a share of each action's own.
        seed: of the noise.

    Returns:
        A noisy copy.
    """
    generator, action = torch.Generator().manual_seed(seed), data["action"]
    noisy = data.clone()
    noisy["action"] = action + share * action.std(0) * torch.randn(action.shape, generator=generator)
    return noisy


def _measured(true: torch.Tensor, std: torch.Tensor, limit: float, generator: torch.Generator) -> torch.Tensor:
    noisy = true + std * torch.randn(true.shape, generator=generator)
    # saturated sensors stay saturated: they do not show how far the signal exceeds the limit
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


def _held_joints(stiffness: float, brake: float) -> torch.Tensor:
    """Gains from angle and velocity of each of the leg's joints to its motor, as a controller of position has them."""
    return torch.cat([stiffness * torch.eye(3), brake * torch.eye(3)], 1)


def _braked_joints(actions: int, observations: int, brake: float) -> torch.Tensor:
    """Gains from each joint's velocity to its motor; the velocities are the last observations."""
    gains = torch.zeros(actions, observations)
    gains[:, observations - actions :] = brake * torch.eye(actions)
    return gains


SYSTEMS: Mapping[str, System] = MappingProxyType(
    {
        "HalfCheetah": _gymnasium("HalfCheetah-v5", actions=6),
        # weak excitation keeps velocities in the sensors' range; episodes continue after a fall so that thighs reach
        # their joint limits
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
        # swings of less than a turn, as a laboratory rig makes
        "swinging pendulum": System(
            lambda episode: GymWrapper(TimeLimit(PendulumEnv(), episode)),
            lambda: Excitation(torch.tensor([3.0]), strongest=0.15, brake=torch.tensor([[0.0, 0.05]])),
        ),
        "leg": System(
            lambda episode: GymWrapper(TimeLimit(LegEnv(), episode)),
            lambda: Excitation(torch.full((3,), 12.0), strongest=0.25, brake=_held_joints(6.0, 0.6)),
        ),
        # the cart is held near its place, as a controller does
        "cart-pole": System(
            lambda episode: GymWrapper(TimeLimit(CartPoleEnv(), episode)),
            lambda: Excitation(torch.tensor([5.0]), strongest=0.3, brake=torch.tensor([[8.0, 0.0, 1.0, 0.0]])),
        ),
        "two links": System(
            lambda episode: GymWrapper(TimeLimit(TwoLinksEnv(), episode)),
            lambda: Excitation(torch.tensor([6.0, 2.0]), strongest=0.5),
        ),
        "reaching arm": System(
            lambda episode: GymWrapper(TimeLimit(ReachingEnv(), episode)),
            lambda: Excitation(torch.tensor([6.0, 2.0]), strongest=0.5),
        ),
        "wheel_legged": System(
            lambda episode: WheelLeggedEnv(max_episode_steps=episode), lambda: noisy_balance_controller()
        ),
    }
)
