"""A force whose terms are effects of the catalogue is reported as these effects."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, JointDamping, JointFrictionLoss, ResidualForce
from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.undeclared.by_catalogue import by_catalogue, effect_of_term

DAMPING = CatalogueEntry(JointDamping(joints="elbow"), ({"damping": 0.05}, {"damping": 0.5}))
FRICTION = CatalogueEntry(JointFrictionLoss(joints="elbow"), ({"torque": 0.01}, {"torque": 0.1}))
FOUND = Part(JointDamping(0.053, joints="elbow"), True, {"damping": (0.05, 0.06)}, alike=(JointDamping(0.053),))


@pytest.fixture(scope="module")
def problem():
    measured = recorded(pendulum().with_effects(JointFrictionLoss(0.06), JointDamping(0.05)), 1200, noise=0.01)
    return Problem.pose(pendulum(), measured)


def with_force(*terms: str) -> tuple[Part, ...]:
    force = ResidualForce(terms)
    return FOUND, Part(force, False, dict.fromkeys(force.parameters, (0.0, 1.0)))


def test_dry_friction_beside_damping_is_named_and_both_get_the_right_values(problem):
    damping, friction = by_catalogue(problem, with_force("torque on elbow: -0.056 · sign(v)"), [DAMPING, FRICTION])
    assert damping.declared
    assert friction.declared
    assert damping.alike == ()  # the alternatives were found without the force
    np.testing.assert_allclose([damping.effect.damping, friction.effect.torque], [0.05, 0.06], rtol=0.03)
    for part, true in ((damping, 0.05), (friction, 0.06)):
        ((low, high),) = part.ci95.values()
        assert low < true < high


def test_a_term_of_an_effect_that_is_already_there_only_moves_its_value(problem):
    parts = by_catalogue(problem, with_force("torque on elbow: -0.01 · v"), [DAMPING, FRICTION])
    assert [type(part.effect) for part in parts] == [JointDamping]


@pytest.mark.parametrize(
    ("terms", "catalogue"),
    [
        (("torque on elbow: 0.1 · sin(7 q)",), [DAMPING, FRICTION]),
        (("torque on elbow: -0.056 · sign(v)", "torque on elbow: 0.1 · sin(7 q)"), [DAMPING, FRICTION]),
        (("torque on elbow: -0.056 · sign(v)",), [DAMPING]),
    ],
    ids=["ripple", "friction and ripple", "friction is not offered"],
)
def test_a_force_with_a_term_that_is_not_in_the_catalogue_stays_a_force(problem, terms, catalogue):
    parts = with_force(*terms)
    assert by_catalogue(problem, parts, catalogue) == parts


@pytest.mark.parametrize(
    ("term", "words"),
    [
        ("torque on hip: 0.5", "constant torque of 0.5 N·m on joints hip"),
        ("torque on hip: -0.5 · v", "damping of joints hip + 0.5 N·m·s/rad"),
        ("torque on hip: -0.5 · q", "stiffness of joints hip + 0.5 N·m/rad"),
        ("torque on hip: -0.5 · sign(v)", "dry friction of joints hip + 0.5 N·m"),
    ],
)
def test_a_simple_term_is_an_effect_on_its_joint(term, words):
    assert effect_of_term(ForceTerm.parse(term)).describe() == words


@pytest.mark.parametrize("term", ["0.5 · v", "0.5 · q", "0.5 · sign(v)", "-0.5 · v^3", "-0.5 · |v| · v", "0.1 · t"])
def test_other_terms_are_none(term):
    assert effect_of_term(ForceTerm.parse(f"torque on hip: {term}")) is None
