"""Cases of arms with position servos: friction and a rotor in each joint, and one further cause."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from cases import Case, Family
from chains import MODEL_STEPS, torque_of_gravity
from drawn_cases import TRIES
from joint_case import JointCase
from servos import STEP, Arm, Servo

from torchrl_h2o.effects import (
    ActionDelay,
    ActionLag,
    ActionLead,
    Armature,
    BodyCentreOfMass,
    BodyInertia,
    BodyMass,
    Effect,
    GearPlay,
    JointDamping,
    JointFrictionLoss,
    LoadFriction,
    ObservationDelay,
    Payload,
    ServoDamping,
    ServoDeadBand,
    ServoStiffness,
    StribeckFriction,
    TorqueSpeedLine,
)
from torchrl_h2o.residuals import Report

NOISE = (0.001, 0.003)  # of the encoders, shares of the signals' standard deviations
ROWS = 3000  # 30 s
SEEN, IN_ROWS = 3.0, 0.1  # change of a position, in its noise, that a cause makes in at least this share of the rows
LOOKED_AT = 1000  # rows, 10 s, in which a cause is to be visible
COUNTS = (1, 1, 3)  # joints, in turn
#: what every joint has, so that no cause is named by it
USUAL = (JointFrictionLoss, JointDamping, ServoDamping, Armature)
#: kinds of effects that name each cause; one of each group must be found
KINDS: Mapping[str, tuple[tuple[type[Effect], ...], ...]] = {
    "M1": (),
    "M3": ((LoadFriction,),),
    "M4": ((LoadFriction,), (StribeckFriction,)),
    "play": ((GearPlay, ServoDeadBand),),
    "lead": ((ActionLead,),),
    "sag": ((TorqueSpeedLine,),),
    "delay": ((ActionDelay, ActionLag, ObservationDelay),),
    "gain": ((ServoStiffness,),),
    "lag": ((ActionLag, ActionDelay, ObservationDelay),),
    "dead": ((ServoDeadBand, GearPlay),),
    "box": ((BodyCentreOfMass, BodyMass, BodyInertia, Payload),),
}
#: ranges of the parameters of a servo that each cause changes; their logarithms are drawn uniformly
RANGES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "M1": {},
    "M3": {"load": (0.05, 0.25)},
    "M4": {
        "load": (0.03, 0.15),
        "rest": (0.02, 0.1),  # in largest torques of gravity
        "rest_load": (0.05, 0.15),
        "speed": (0.1, 2.0),
        "exponent": (1.0, 2.0),
    },
    "play": {"play": (0.01, 0.04)},
    "lead": {"lead": (0.01, 0.04)},
    "sag": {"stall": (0.8, 1.5), "no_load": (1.5, 4.0)},  # the first in largest torques of gravity
    "delay": {"delay": (0.005, 0.02)},
    "gain": {"gain": (0.6, 0.9)},
    "lag": {"lag": (0.01, 0.05)},
    "dead": {"dead": (0.01, 0.04)},
    "box": {"load_mass": (0.3, 1.0), "load_place": (0.3, 0.9), "load_offset": (0.4, 0.8)},  # the first in link masses
}
CAUSES = ("M1", "M3", "M4", "play", "lead", "sag", "delay")
DRIVES = ("gain", "lag", "dead", "box")
ON_ONE_BUS = ("delay", "lag")  # causes that all servos have with the same values


@dataclass(frozen=True, kw_only=True)
class ServoCase(JointCase):
    """A case with the log of an arm.

    Args:
        cause: a key of :data:`RANGES`.
    """

    machine: Arm
    cause: str

    @property
    def words(self) -> str:
        last = self.machine.servos[-1]
        told = ", ".join(f"{name} {getattr(last, name):.3g}" for name in RANGES[self.cause])
        return f"{self.cause} ({told})" if told else self.cause


def with_cause(arm: Arm, cause: str, rng: np.random.Generator) -> Arm:
    """Put a cause into all servos of an arm, with the same values but for scatter; a box on the last link alone."""
    drawn = {name: math.exp(rng.uniform(*np.log(ends))) for name, ends in RANGES[cause].items()}
    servos = []
    for index, servo in enumerate(arm.servos):
        weight = torque_of_gravity(arm.servos[index:])
        own = {name: value * (1.0 if cause in ON_ONE_BUS else rng.uniform(0.9, 1.1)) for name, value in drawn.items()}
        own |= {name: weight * own[name] for name in ("rest", "stall") if name in own}
        own |= {name: servo.mass * own[name] for name in ("load_mass",) if name in own}
        is_without = cause == "box" and index < len(arm.servos) - 1
        servos.append(servo if is_without else replace(servo, **own))
    return Arm(tuple(servos))


def servo(number: int, rng: np.random.Generator, causes: Sequence[str] = CAUSES) -> ServoCase:
    """Each cause in turn, in an arm in which it is visible; in every other turn, logs have positions alone."""
    cause = causes[number % len(causes)]
    noise, seed = float(rng.uniform(*NOISE)), int(rng.integers(2**31))
    for _ in range(TRIES):
        plain = Arm.draw(rng, COUNTS[number % len(COUNTS)])
        arm = with_cause(plain, cause, rng)
        if cause == "M1" or is_visible(arm, plain, noise, seed):
            break
    else:
        raise RuntimeError(f"servos {number}: no {cause} that can be seen in {TRIES} tries; draw anew")
    return ServoCase(
        name=f"{cause} {len(arm.servos)} {number}",
        system="arm",
        judge=judge_servo,
        noise=noise,
        truth=effects_of(arm),
        seed=seed,
        transitions=ROWS,
        machine=arm,
        cause=cause,
        velocities=number // len(causes) % 2 == 0,
    )


def is_visible(arm: Arm, plain: Arm, noise: float, seed: int) -> bool:
    """Whether an arm moves otherwise than without its cause, by more than the noise of a position.

    Args:
        arm: the arm with its cause.
        plain: the arm without it.
        noise: standard deviation of the noise, as a share of each position's.
        seed: of the run.
    """
    (moved, _), (before, _) = (one.record(LOOKED_AT, seed) for one in (arm, plain))
    change = np.abs(moved - before) > SEEN * noise * before.std(0)
    return bool(change[:, : len(arm.servos)].mean(0).max() >= IN_ROWS)


def effects_of(arm: Arm) -> tuple[Effect, ...]:
    """The effects of the library that stand for what an arm's model lacks."""
    found: list[Effect] = []
    for index, (name, one) in enumerate(zip(arm.names, arm.servos, strict=True)):
        drawn = (
            JointFrictionLoss(one.friction, name),
            JointDamping(one.damping, name),
            Armature(one.rotor, name),
            LoadFriction(one.load, joints=name),
            GearPlay(one.play, (index,)),
            ActionLead(one.lead, (index,)),
            TorqueSpeedLine(one.stall, one.no_load, (index,)),
            ActionDelay(one.delay, (index,)),
            ServoStiffness(one.gain, (index,)),
            ActionLag(one.lag, (index,)),
            ServoDeadBand(one.dead, (index,)),
        )
        found += [effect for effect in drawn if not effect.is_neutral]
        if one.load_mass:
            x, z = one.load_offset * one.length, -one.load_place * one.length
            found.append(Payload(one.load_mass, x, z, 0.5 * x, bodies=f"link{index}"))
        if one.rest:
            found.append(StribeckFriction(one.rest, one.speed, one.rest_load, exponent=one.exponent, joints=name))
    return tuple(found)


def control(number: int, rng: np.random.Generator) -> ServoCase:
    """The arm of a drawn servo without its cause."""
    drawn = servo(number, rng)
    plain = {name: Servo.__dict__[name] for ranges in RANGES.values() for name in ranges}
    arm = Arm(tuple(replace(one, **plain) for one in drawn.machine.servos))
    return replace(drawn, machine=arm, truth=effects_of(arm), cause="M1", name=f"without {drawn.name}")


def named_causes(report: Report) -> set[str]:
    """Causes that a report names, beside friction, damping and rotors."""
    alike = [group.effects for group in report.indistinguishable if set(group.effects) & set(report.effects)]
    found = {type(effect) for effects in (report.effects, *alike) for effect in effects}
    return {
        cause
        for cause, groups in KINDS.items()
        if groups and all(any(kind in found for kind in group) for group in groups)
    }


def judge_servo(report: Report, case: Case) -> dict:
    """Passed if the cause is named, and no effect that belongs to another cause is put in.

    Lateness of less than a physics step of the model counts as none.
    """
    assert isinstance(case, ServoCase)
    own = {*(kind for group in KINDS[case.cause] for kind in group), *USUAL}
    if len(case.machine.servos) == 1:
        own.add(BodyInertia)  # of the only link: the same as a rotor
    others = [effect for effect in report.effects if type(effect) not in own and not _is_of_a_step(effect)]
    named = named_causes(report)
    is_right = (case.cause in named or case.cause == "M1") and not others
    return {
        "ok": is_right,
        "wrong_and_recommended": bool(report.recommended and not is_right),
        "others": ", ".join(effect.describe() for effect in others),
    }


def _is_of_a_step(effect: Effect) -> bool:
    """Whether an effect makes up for the model's physics steps, which are ten times as long as those of reality."""
    late = isinstance(effect, KINDS["delay"][0])
    return late and all(parameter.value <= STEP / MODEL_STEPS for parameter in effect.parameters.values())


_NAMED = "the cause named beside friction and rotors, and no other"
SERVOS = Family(servo, 20, 17, _NAMED, stream=13)
SERVO_CONTROLS = Family(control, 20, 20, "friction and rotors alone", stream=SERVOS.stream)
SERVO_DRIVES = Family(partial(servo, causes=DRIVES), 12, 10, _NAMED, stream=14)
