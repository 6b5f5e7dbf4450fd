"""Machines with one of two causes that a slow log hardly tells apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import mujoco
import numpy as np
import torch
from chains import MODEL_STEPS, Chain, torque_of_gravity
from tensordict import TensorDict

from torchrl_h2o.data.readers.velocity import estimate_velocity
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    BodyMass,
    Effect,
    GearPlay,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    ObservationBias,
    Payload,
    ServoDeadBand,
)
from torchrl_h2o.experiment import as_ted
from torchrl_h2o.experiment.limits import state_at_rest
from torchrl_h2o.experiment.separation import Motion
from torchrl_h2o.residuals import Simulation, StateMap

STEP = 0.01  # s, control step
ROWS = 2000  # of the first log, 20 s
SIZES = (2, 3, 4, 5, 7)  # joints
SLOW, SMALL = (0.1, 0.3), (0.15, 0.35)  # Hz, and rad, of the sines of the first log
NOISE = (2e-4, 1e-3)  # rad, of the encoders

Draw = Callable[[Chain, np.random.Generator], Effect]


def _weight(chain: Chain, joint: int) -> float:
    return torque_of_gravity(chain.joints[joint:])


def _some_joint(chain: Chain, rng: np.random.Generator) -> int:
    return int(rng.integers(len(chain.joints)))


def heavy(chain: Chain, rng: np.random.Generator) -> Effect:
    return BodyMass(rng.uniform(1.15, 1.4), f"link{len(chain.joints) - 1}")


def weak(chain: Chain, rng: np.random.Generator) -> Effect:
    return ActionGain(1.0 / rng.uniform(1.15, 1.4))


def payload(chain: Chain, rng: np.random.Generator) -> Effect:
    last = chain.joints[-1]
    return Payload(rng.uniform(0.2, 0.5) * last.mass, z=-last.length, bodies=f"link{len(chain.joints) - 1}")


def dry(chain: Chain, rng: np.random.Generator) -> Effect:
    joint = _some_joint(chain, rng)
    return JointFrictionLoss(rng.uniform(0.04, 0.12) * _weight(chain, joint), f"joint{joint}")


def viscous(chain: Chain, rng: np.random.Generator) -> Effect:
    joint = _some_joint(chain, rng)
    return JointDamping(rng.uniform(0.04, 0.12) * _weight(chain, joint), f"joint{joint}")


def viscous_all(chain: Chain, rng: np.random.Generator) -> Effect:
    return JointDamping(rng.uniform(0.04, 0.12) * _weight(chain, len(chain.joints) - 1))


def late(chain: Chain, rng: np.random.Generator) -> Effect:
    return ActionDelay(rng.uniform(0.01, 0.03))


def zero(chain: Chain, rng: np.random.Generator) -> Effect:
    return ObservationBias(rng.uniform(0.02, 0.06), (_some_joint(chain, rng),))


def torque(chain: Chain, rng: np.random.Generator) -> Effect:
    joint = _some_joint(chain, rng)
    return JointForce(rng.uniform(0.04, 0.12) * _weight(chain, joint), f"joint{joint}")


def play(chain: Chain, rng: np.random.Generator) -> Effect:
    return GearPlay(rng.uniform(0.01, 0.03), (_some_joint(chain, rng),))


def dead_band(chain: Chain, rng: np.random.Generator) -> Effect:
    return ServoDeadBand(rng.uniform(0.01, 0.03), (_some_joint(chain, rng),))


PAIRS: Mapping[str, tuple[Draw, Draw]] = MappingProxyType(
    {
        "mass or gain": (heavy, weak),
        "payload or friction": (payload, dry),
        "delay or damping": (late, viscous_all),
        "dry or viscous": (dry, viscous),
        "zero or torque": (zero, torque),
        "play or dead band": (play, dead_band),
        "one or all": (viscous, viscous_all),
    }
)


@dataclass(frozen=True)
class RivalCase:
    """A machine, its cause, and the noise of its encoders in rad."""

    pair: str
    chain: Chain
    truth: Effect
    noise: float
    seed: int

    @classmethod
    def draw(cls, number: int, rng: np.random.Generator) -> RivalCase:
        """Pairs and numbers of joints in turn; position servos for play and dead band, else every other time."""
        pair = list(PAIRS)[number % len(PAIRS)]
        servos = pair == "play or dead band" or number % 2 == 1
        count = SIZES[number % len(SIZES)]
        chain = Chain.draw(rng, servos, (count, count))
        chain = Chain(tuple(replace(joint, friction=0.0) for joint in chain.joints), servos)
        truth = PAIRS[pair][int(rng.integers(2))](chain, rng)
        return cls(pair, chain, truth, math.exp(rng.uniform(*np.log(NOISE))), int(rng.integers(2**31)))

    @property
    def name(self) -> str:
        """The pair, and the machine."""
        return f"{self.pair}, {len(self.chain.joints)} {'servos' if self.chain.servos else 'motors'}"

    def simulation(self) -> Simulation:
        """The model, which lacks the cause. Encoders measure positions, from which velocities are estimated."""
        names, count, xml = self.chain.names, len(self.chain.joints), self.chain.xml(complete=True, step=STEP)
        observed, units = [*names, *(f"{name}_velocity" for name in names)], ["rad"] * count + ["rad/s"] * count
        state_map = StateMap.of_coordinates(observed, units, range(2 * count), 2 * count)
        return Simulation(lambda: mujoco.MjSpec.from_string(xml), MODEL_STEPS, state_map, name="chain")

    def first_commands(self) -> np.ndarray:
        """Slow and small sines, (ROWS, nu): targets of servos, or the torques that hold such angles."""
        rng, count, times = np.random.default_rng(self.seed), len(self.chain.joints), STEP * np.arange(ROWS)
        angle = 2.0 * np.pi * rng.uniform(*SLOW, count) * times[:, None]
        angles = rng.uniform(*SMALL, count) * np.sin(angle)
        return angles if self.chain.servos else angles * [_weight(self.chain, joint) for joint in range(count)]

    def motion(self, commands: np.ndarray) -> Motion:
        """What the machine does from rest."""
        machine, count = self.simulation().with_effects(self.truth), len(self.chain.joints)
        rest = state_at_rest(machine, np.zeros(2 * count), commands[0])
        return Motion.of(machine, rest, commands)

    def log(self, motion: Motion, seed: int) -> TensorDict:
        """Readings of the encoders in a motion and velocities estimated from them, as transitions, in TED."""
        readings = self.simulation().with_effects(self.truth).observed(motion.states)[:, : len(self.chain.joints)]
        rng = np.random.default_rng([self.seed, seed])
        positions = readings + self.noise * rng.standard_normal(readings.shape)
        estimates = [estimate_velocity(column, [slice(0, len(positions))], STEP) for column in positions.T]
        observed = np.column_stack([positions, *(one.velocity for one in estimates)])
        known = np.flatnonzero(np.isfinite(observed).all(1))
        ted = as_ted(observed[known], motion.actions[known[:-1]])
        std = torch.tensor([0.0] * len(estimates) + [one.std for one in estimates])
        return ted.set("observation_std", std.expand(len(ted), -1).clone())
