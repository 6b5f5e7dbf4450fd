"""The robot of close_the_loop's default run, recorded for 2.5 s with other random numbers, and without any effect."""

import numpy as np
from cases import Case, Family
from scoring import is_exact_set, parameter_error, reduction, says_nothing_is_missing

from torchrl_h2o.effects import ActionDelay, BodyMass, JointFrictionLoss, RollingResistance
from torchrl_h2o.residuals import Report

#: the effects of ``reality`` in torchrl_h2o/config/env/wheel_legged.yaml
EFFECTS = (
    RollingResistance(0.003, geoms="*_wheel"),
    JointFrictionLoss(0.12, joints="axle"),
    ActionDelay(0.0125),
    BodyMass(1.2, bodies="torso"),
)
ROWS = 500  # at 200 Hz
RECORDINGS = 5
WITHIN = 0.05  # relative error of a parameter


def robot(number: int, rng: np.random.Generator) -> Case:
    """The four effects; in the last case none, as a control."""
    present = EFFECTS if number < RECORDINGS else ()
    return Case(
        name=f"robot {number}" if present else "robot without effects",
        system="wheel_legged",
        judge=judge_robot if present else judge_control,
        truth=present,
        in_reality=present,
        seed=int(rng.integers(2**31)),
        transitions=ROWS,
        episode=ROWS,
    )


def judge_robot(report: Report, case: Case) -> dict:
    """Passed if exactly these effects, or their groups, are found, with values within 5 %."""
    simulation = case.simulation()
    error = parameter_error(report, case.truth, simulation)
    exact = is_exact_set(report, case.truth, simulation)
    return {"ok": exact and error <= WITHIN, "parameter_error": error, "reduction": reduction(report)}


def judge_control(report: Report, case: Case) -> dict:
    """Passed if nothing is found in data of the simulator itself."""
    return {"ok": says_nothing_is_missing(report)}


ROBOT = Family(robot, RECORDINGS + 1, RECORDINGS + 1, "the four effects within 5 %; nothing in the control", stream=8)
