"""Terms of a force that are effects of the catalogue are named so."""

import pytest

from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.residuals.forces.candidates import effect_of_term


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
