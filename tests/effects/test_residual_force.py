"""ResidualForce: the force equals its text form and is preserved by JSON."""

import json
import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.models import CART
from torchrl_h2o.effects import ResidualForce
from torchrl_h2o.effects.force.term import Factor, ForceTerm
from torchrl_h2o.effects.serialisation import effect_from_dict, effect_to_dict
from torchrl_h2o.effects.states import States

FREE = """<mujoco><worldbody><body><freejoint name="root"/><geom size="1"/></body></worldbody></mujoco>"""
MOTORED = CART.replace("</mujoco>", '<actuator><motor joint="slider"/><motor joint="hinge"/></actuator></mujoco>')
TERMS = (
    "torque on hinge: 0.4 · sin(7 q)",
    "torque on hinge: -0.2 · sign(v) · sin(1.5 q - 0.3)",
    "force on slider: -0.02 · v^3",
    "force on slider: 1.5 · step(t - 2)",
    "force on slider: 3 · |a1| · a1",
    "force on slider: 0.25",
)


def by_hand(q, v, a, t) -> list[float]:
    slider = -0.02 * v[0] ** 3 + 1.5 * (t >= 2.0) + 3 * abs(a[1]) * a[1] + 0.25
    return [slider, 0.4 * math.sin(7 * q[1]) - 0.2 * np.sign(v[1]) * math.sin(1.5 * q[1] - 0.3)]


def test_force_is_the_one_that_its_terms_read():
    model = mujoco.MjModel.from_xml_string(MOTORED)
    rng = np.random.default_rng(0)
    q, v, a = rng.standard_normal((3, 50, 2))
    t = rng.uniform(0.0, 4.0, 50)
    force = ResidualForce(TERMS).batched(model)(States(q, v, np.zeros((50, 0)), a, t))
    np.testing.assert_allclose(force, [by_hand(*row) for row in zip(q, v, a, t, strict=True)])


def test_force_in_one_state_is_the_batched_one():
    model = mujoco.MjModel.from_xml_string(MOTORED)
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl, data.time = (0.1, 0.2), (-0.3, 0.4), (0.5, 0.6), 2.5
    force = ResidualForce(TERMS).process(model, np.random.default_rng(0))(data)
    np.testing.assert_allclose(force, by_hand(data.qpos, data.qvel, data.ctrl, 2.5))


def test_words_have_the_units_of_hinges_and_slides():
    assert [term.words() for term in ResidualForce(TERMS).parsed] == [
        "torque on joint hinge: 0.4 N·m · sin(7 q)",
        "torque on joint hinge: -0.2 N·m · sign(v) · sin(1.5 q - 0.3)",
        "force on joint slider: -0.02 N·s³/m³ · v³",
        "force on joint slider: 1.5 N · step(t - 2)",
        "force on joint slider: 3 N · |a1| · a1",
        "force on joint slider: 0.25 N",
    ]
    assert ForceTerm.parse("torque on hinge: 1 · q · v").unit == "N·m·s/rad²"
    assert ForceTerm.parse("force on slider: 1 · q · t^2").unit == "N/(m·s²)"


def test_effect_survives_a_json_file():
    effect = ResidualForce(TERMS)
    assert effect_from_dict(json.loads(json.dumps(effect_to_dict(effect)))) == effect


numbers = st.floats(-1e6, 1e6, allow_nan=False)
factors = st.one_of(
    st.builds(Factor, st.just("power"), st.sampled_from(["q", "v", "t", "a0", "a12"]), st.integers(1, 9)),
    st.builds(Factor, st.sampled_from(["size", "sign"]), st.sampled_from(["q", "v", "a3"])),
    st.builds(Factor, st.just("sin"), st.sampled_from(["q", "v", "t"]), st.just(1), st.tuples(numbers, numbers)),
    st.builds(Factor, st.just("step"), st.just("t"), st.just(1), st.tuples(st.floats(0.0, 1e6))),
)


@given(
    st.builds(
        ForceTerm,
        st.sampled_from(["elbow", "left arm: 2", "joint_0"]),
        numbers,
        st.lists(factors, max_size=3).map(tuple),
        st.booleans(),
    )
)
def test_every_term_reads_back_from_its_text(term):
    assert ForceTerm.parse(str(term)) == term


def test_parameters_are_replaced_by_name():
    effect = ResidualForce(TERMS[:2])
    assert list(effect.parameters) == [
        "coefficient_1", "frequency_1", "phase_1", "coefficient_2", "frequency_2", "phase_2"
    ]  # fmt: skip
    changed = effect.with_parameters({"coefficient_1": 0.0, "frequency_2": 2.5})
    assert changed.terms == ("torque on hinge: 0 · sin(7 q)", "torque on hinge: -0.2 · sign(v) · sin(2.5 q - 0.3)")
    with pytest.raises(ValueError, match="no parameter 'k'"):
        effect.with_parameters({"k": 1.0})


def test_effect_is_neutral_when_all_coefficients_are_zero():
    assert ResidualForce().is_neutral
    assert ResidualForce(("torque on hinge: 0 · sin(7 q)",)).is_neutral
    assert not ResidualForce(TERMS).is_neutral


@pytest.mark.parametrize(
    "text", ["torque on hinge: x", "hinge: 1", "torque on hinge: 1 · exp(q)", "torque on hinge: 1 · q^22", "q · q"]
)
def test_text_that_is_no_term_is_refused(text):
    with pytest.raises(ValueError, match="write it like"):
        ResidualForce((text,))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("torque on elbow: 1", "no joint named 'elbow'; it has slider, hinge"),
        ("torque on slider: 1", "takes a force"),
        ("force on hinge: 1", "takes a torque"),
        ("torque on hinge: 1 · a2", "counted from 0"),
    ],
)
def test_what_the_model_lacks_is_named(text, complaint):
    with pytest.raises(ValueError, match=complaint):
        ResidualForce((text,)).batched(mujoco.MjModel.from_xml_string(MOTORED))


def test_free_joint_has_named_axes_and_rotations_have_no_position():
    model = mujoco.MjModel.from_xml_string(FREE)
    states = States(np.arange(7.0)[None], np.arange(6.0)[None], np.zeros((1, 0)), np.zeros((1, 0)), np.zeros(1))
    drag = ResidualForce(("force on root_z: 2 · q", "torque on root_pitch: -1 · v"))
    np.testing.assert_array_equal(drag.batched(model)(states), [[0, 0, 4, 0, -4, 0]])
    with pytest.raises(ValueError, match="no position"):
        ResidualForce(("torque on root_pitch: 1 · q",)).batched(model)
