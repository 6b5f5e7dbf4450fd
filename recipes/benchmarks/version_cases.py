"""Cases with one named gap beside another version of the simulator, which differs a little everywhere."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import mujoco
import numpy as np
from cases import Case, Family
from drawn_cases import TRIES, is_visible, plain
from scoring import parameter_error, reduction
from undeclared_effects import OtherVersion

from torchrl_h2o.effects import BodyMass, Effect, GeomFriction, Gravity, JointDamping, JointRange
from torchrl_h2o.residuals import Report

SYSTEMS = ("HalfCheetah", "Walker2d", "Hopper")
WITHIN = 0.1  # relative error of the gap's value
STRONGER, NARROWER = (1.3, 2.0), (0.1, 0.6)  # factors of a gap
MORE_DAMPING = (1.0, 50.0)  # in dampings of the joint, which are small in Walker2d


def _factor(rng: np.random.Generator) -> float:
    return float(rng.uniform(*STRONGER)) ** float(rng.choice([-1, 1]))


def _joint(model: mujoco.MjModel, rng: np.random.Generator) -> str:
    return model.joint(int(rng.choice(np.flatnonzero(model.jnt_limited)))).name


def _body(model: mujoco.MjModel, rng: np.random.Generator) -> str:
    return model.body(int(rng.integers(1, model.nbody))).name


def _damping(model: mujoco.MjModel, rng: np.random.Generator) -> Effect:
    joint = _joint(model, rng)
    return JointDamping(float(model.joint(joint).damping[0] * np.exp(rng.uniform(*np.log(MORE_DAMPING)))), joint)


GAPS: Mapping[str, Callable[[mujoco.MjModel, np.random.Generator], Effect]] = MappingProxyType(
    {
        "gravity": lambda model, rng: Gravity(_factor(rng)),
        "range": lambda model, rng: JointRange(float(rng.uniform(*NARROWER)), _joint(model, rng)),
        "mass": lambda model, rng: BodyMass(_factor(rng), _body(model, rng)),
        "friction": lambda model, rng: GeomFriction(_factor(rng)),
        "damping": _damping,
    }
)


def versions(number: int, rng: np.random.Generator) -> Case:
    """Draw one visible gap beside another version."""
    system, gap = SYSTEMS[number % len(SYSTEMS)], list(GAPS)[number % len(GAPS)]
    simulation, measured = plain(system, int(rng.integers(2**31)))
    for _ in range(TRIES):
        effect = GAPS[gap](simulation.model, rng)
        if is_visible(effect, simulation, measured):
            break
    else:
        raise RuntimeError(f"versions {number}: no {gap} that can be seen in {TRIES} tries; draw anew")
    effects = (effect, OtherVersion(int(rng.integers(1, 10**6))))
    return Case(
        name=f"{system} {gap}",
        system=system,
        judge=judge_version,
        truth=effects,
        in_reality=effects,
        seed=int(rng.integers(2**31)),
    )


def judge_version(report: Report, case: Case) -> dict:
    """Passed if the gap is found within 10 %, whatever else stands for the other version."""
    error = parameter_error(report, case.truth[:1], case.simulation())
    return {"ok": error <= WITHIN, "parameter_error": error, "reduction": reduction(report)}


VERSIONS = Family(versions, 10, 9, "the gap within 10 %, beside small differences everywhere", stream=12)
