"""Arms with position servos: the truth explains their logs, and what a report must name."""

from dataclasses import replace

import numpy as np
import pytest
from cases import draw_case
from running import FAMILIES
from servo_cases import CAUSES, USUAL, is_visible
from servos import Arm

from tests.recipes.benchmarks.made_up import report
from torchrl_h2o.effects import ActionDelay, Armature, JointFrictionLoss, LoadFriction, StribeckFriction

SEED, ROWS = 5, 600
FAST = [("servos", 1), ("servos", 3), ("servos", 4), ("servo_drives", 2), ("servo_drives", 3)]
SLOW = [*(("servos", n) for n in (2, 5, 6, 8, 9, 10, 11, 13)), *(("servo_drives", n) for n in (0, 1, 4, 5, 6, 7))]


@pytest.mark.parametrize(("family", "number"), [*FAST, *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOW)])
def test_the_further_cause_explains_what_friction_and_rotors_leave(family, number):
    """The library did not simulate the log; its physics steps are ten times as long."""
    case = draw_case(FAMILIES, family, number, SEED)
    simulation, (states, targets) = case.simulation(), case.machine.record(ROWS, case.seed)

    def error(effects):
        machine = simulation.with_effects(*effects)
        run = machine.rollout(states[:1], machine.executed(targets)[None])[0]
        return np.sqrt(((run - states[1:])[:, : len(case.machine.servos)] ** 2).mean())

    usual = [effect for effect in case.truth if isinstance(effect, USUAL)]
    assert len(usual) < len(case.truth)
    assert error(case.truth) < 0.9 * error(usual)


@pytest.mark.parametrize("number", [*(0, 3), *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 4, 5, 6))])
def test_each_cause_is_drawn_in_turn_and_a_control_has_none(number):
    case, plain = (draw_case(FAMILIES, family, number, SEED) for family in ("servos", "servo_controls"))
    assert case.cause == CAUSES[number]
    assert plain.seed == case.seed
    assert all(isinstance(effect, USUAL) for effect in plain.truth)
    assert [one.friction for one in plain.machine.servos] == [one.friction for one in case.machine.servos]


def test_a_play_that_moves_the_arm_less_than_the_noise_is_not_drawn():
    plain = draw_case(FAMILIES, "servo_controls", 0, SEED).machine
    seen = [
        is_visible(Arm(tuple(replace(one, play=play) for one in plain.servos)), plain, noise=0.002, seed=0)
        for play in (0.001, 0.2)
    ]
    assert seen == [False, True]


@pytest.mark.parametrize(
    ("found", "is_right"),
    [
        ((LoadFriction(0.1, joints="joint0"), JointFrictionLoss(0.1), Armature(0.1)), True),
        ((LoadFriction(0.1), ActionDelay(0.001)), True),  # less than a physics step of the model
        ((LoadFriction(0.1), ActionDelay(0.02)), False),
        ((JointFrictionLoss(0.1), Armature(0.1)), False),
        ((LoadFriction(0.1), StribeckFriction(0.1)), False),
    ],
)
def test_a_report_must_name_the_cause_and_no_other(found, is_right):
    case = replace(draw_case(FAMILIES, "servos", 1, SEED))
    assert case.cause == "M3"
    assert case.judge(report(*found), case)["ok"] == is_right


def test_friction_at_rest_belongs_to_m4_beside_that_of_the_load():
    case = draw_case(FAMILIES, "servos", 2, SEED)
    both = LoadFriction(0.1), StribeckFriction(0.1)
    assert case.judge(report(*both), case)["ok"]
    assert not any(case.judge(report(one), case)["ok"] for one in both)
