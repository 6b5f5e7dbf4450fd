"""Cases of machines with many joints, each of which has friction, damping and a rotor, and whose drives are late."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np
from cases import Case, Family
from chains import Chain
from joint_case import JointCase

from torchrl_h2o.effects import (
    ActionDelay,
    ActionLag,
    Armature,
    JointDamping,
    JointFrictionLoss,
    ObservationDelay,
    selection,
)
from torchrl_h2o.residuals import Report
from torchrl_h2o.residuals.report.contents import FoundEffect

NOISE = (0.001, 0.003)  # of the encoders, shares of the signals' standard deviations
KINDS = {JointFrictionLoss: "torque", JointDamping: "damping", Armature: "inertia"}  # and their parameters
WITHIN, WITHIN_DELAY = 0.25, 0.001  # relative error of a joint's values; error of the delay in s


def dense(number: int, rng: np.random.Generator) -> JointCase:
    """Torque motors and position servos in turn; every other log of servos has positions alone."""
    chain = Chain.draw(rng, servos=number % 2 == 1)
    truth = tuple(
        effect
        for name, joint in zip(chain.names, chain.joints, strict=True)
        for effect in (
            JointFrictionLoss(joint.friction, name),
            JointDamping(joint.damping, name),
            Armature(joint.rotor, name),
        )
    )
    return JointCase(
        name=f"{len(chain.joints)} {'servos' if chain.servos else 'motors'} {number}",
        system="chain",
        judge=judge_dense,
        truth=(*truth, ActionDelay(chain.delay)),
        noise=float(rng.uniform(*NOISE)),
        seed=int(rng.integers(2**31)),
        machine=chain,
        velocities=number % 4 != 1,
    )


def judge_dense(report: Report, case: Case) -> dict:
    """Passed if each joint's values are right within 25 % or in their 95 % interval, and the delay within 1 ms."""
    model = case.simulation().model
    wrong, errors = 0, []
    for kind, name in KINDS.items():
        true = np.array([e.parameters[name].value for e in case.truth if isinstance(e, kind)])
        value, low, high = _on_joints([f for f in report.found if isinstance(f.effect, kind)], name, model)
        error = np.abs(value / true - 1.0)
        wrong += int(((error > WITHIN) & ((true < low) | (high < true))).sum())
        errors.append(float(error.max()))
    late = float(np.abs(_delay_errors(report, case, model.nu)).max())
    return {"ok": not wrong and late <= WITHIN_DELAY, "parameter_error": max(errors), "wrong": wrong, "late": late}


def _on_joints(found: Iterable[FoundEffect], name: str, model: mujoco.MjModel) -> np.ndarray:
    """A parameter, and the ends of its interval, summed over the effects on each joint, (3, nv)."""
    sums = np.zeros((3, model.nv))
    for one in found:
        value = one.effect.parameters[name].value
        ends = one.ci95.get(name, (value, value))
        sums[:, selection.joint_dofs(model, one.effect.joints)] += np.array([[value], [ends[0]], [ends[1]]])
    return sums


def _delay_errors(report: Report, case: Case, count: int) -> np.ndarray:
    """Errors of each actuator's delay in s.

    Late sensors and late motors are the same in such a log, and so are a delay and a filter of a fraction of a step.
    """
    found = np.zeros(count)
    for effect in report.effects:
        if isinstance(effect, ActionDelay | ActionLag):
            late = effect.delay if isinstance(effect, ActionDelay) else effect.time_constant
            found[slice(None) if effect.actuators is None else list(effect.actuators)] += late
        elif isinstance(effect, ObservationDelay) and effect.entries is None:
            found += effect.delay
    (true,) = (effect.delay for effect in case.truth if isinstance(effect, ActionDelay))
    return found - true


DENSE = Family(
    dense,
    20,
    18,
    "each joint's friction, damping and rotor within 25 % or its interval, the delay within 1 ms",
    stream=11,
)
