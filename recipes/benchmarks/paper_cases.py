"""The paper's sixteen gaps: the simulator has a gap, the data come from the unmodified task."""

import numpy as np
from cases import Case, Family
from scoring import is_named_first, parameter_error, reduction

from torchrl_h2o.effects import (
    PAPER_GAPS,
    ActionNoise,
    Effect,
    GeomFriction,
    GeomLength,
    GeomSize,
    Gravity,
    JointRange,
    JointSpring,
    paper_gap,
)
from torchrl_h2o.residuals import Report

GAPS = [(task, gap) for gap, entry in PAPER_GAPS.items() for task in entry.tasks]
SENSOR_NOISE = 0.01
WITHIN, NOISE_WITHIN = 0.02, 0.1  # relative error of a parameter
GONE = 0.99  # reduction of the held-out one-step error


def what_mends(gap: str) -> tuple[Effect, ...]:
    """The effects that undo a gap of the paper."""
    strength = PAPER_GAPS[gap].strength
    if gap == "soft_feet":  # a spring of zero stiffness cannot be scaled back
        return JointSpring(120.0, joints="bfoot"), JointSpring(60.0, joints="ffoot")
    if gap == "joint_noise":  # only the simulator has noise
        return (ActionNoise(-strength),)
    made = {
        "gravity": lambda scale: Gravity(scale),
        "friction": lambda scale: GeomFriction(scale),
        "big_thigh": lambda scale: GeomSize(scale, geoms="*thigh*"),
        "small_thigh": lambda scale: GeomSize(scale, geoms="*thigh*"),
        "broken_thigh": lambda scale: JointRange(scale, joints="*thigh*/*"),
        "flexible_thigh": lambda scale: JointRange(scale, joints="*thigh*/*"),
        "long_torso": lambda scale: GeomLength(scale, geoms="torso"),
    }
    return (made[gap](1.0 / strength),)


def paper_case(number: int, rng: np.random.Generator, noise: float = 0.0) -> Case:
    """One of the sixteen cases; only the recording is random."""
    task, gap = GAPS[number]
    return Case(
        name=f"{task} {gap}",
        system=task,
        judge=judge_named if noise else judge_exactly,
        truth=what_mends(gap),
        in_simulator=(paper_gap(gap),),
        noise=noise,
        seed=int(rng.integers(2**31)),
    )


def judge_exactly(report: Report, case: Case) -> dict:
    """Passed if the effect is named first with its value and the error is removed."""
    scores = judge_named(report, case)
    is_noise = isinstance(case.truth[0], ActionNoise)  # noise is a distribution, so correcting it removes no error
    right = scores["parameter_error"] <= (NOISE_WITHIN if is_noise else WITHIN)
    return scores | {"ok": scores["ok"] and right and (is_noise or scores["reduction"] >= GONE)}


def judge_named(report: Report, case: Case) -> dict:
    """Passed if the effect is named first."""
    simulation = case.simulation()
    return {
        "ok": is_named_first(report, case.truth, simulation),
        "parameter_error": parameter_error(report, case.truth, simulation),
        "reduction": reduction(report),
    }


PAPER = Family(paper_case, len(GAPS), 16, "named first, parameter within 2 %, error down by 99 %", stream=2)
PAPER_WITH_NOISE = Family(
    lambda number, rng: paper_case(number, rng, SENSOR_NOISE),
    len(GAPS),
    15,
    "named first under 1 % of sensor noise",
    stream=3,
)
