"""Properties of all effects: validated parameters, neutral values and descriptions."""

import dataclasses
import math
import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.every_effect import EFFECTS, KINDS
from torchrl_h2o.effects import (
    ActionBias,
    ActionGain,
    ActionNoise,
    ActionSaturation,
    BodyMass,
    GeomSize,
    Gravity,
    JointDamping,
    ObservationBias,
    ObservationNoise,
    paper_gap,
)


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_without_arguments_is_neutral_and_of_one_kind(effect):
    assert effect().is_neutral
    assert sum(issubclass(effect, kind) for kind in KINDS) == 1


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_off_its_neutral_value_says_so_in_words_with_units(effect):
    for name, parameter in effect().parameters.items():
        off = [effect(**{name: bound}) for bound in parameter.bounds if bound != parameter.neutral]
        assert all(changed.is_neutral == (name not in (effect.amounts or (name,))) for changed in off)
        # a description may word a negative value differently
        assert all(str(changed.parameters[name]).lstrip("-") in changed.describe() for changed in off)
        assert len({changed.describe() for changed in [effect(), *off]}) == 1 + len(off)


@given(effect=st.sampled_from([effect for effect in EFFECTS if effect().parameters]), data=st.data())
def test_every_value_within_the_bounds_is_taken_and_none_outside(effect, data):
    name, parameter = next(iter(effect().parameters.items()))
    low, high = parameter.bounds
    inside = data.draw(st.floats(low, high))
    assert getattr(effect(**{name: inside}), name) == inside
    too_low = st.floats(max_value=low, exclude_max=True)
    too_high = st.floats(min_value=high, exclude_min=True) if high < math.inf else st.nothing()
    outside = data.draw(too_low | too_high | st.just(math.nan))
    with pytest.raises(ValueError, match=f"{effect.__name__}: {name} = .*choose"):
        effect(**{name: outside})


def test_a_value_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match=r"Gravity: scale = 'twice' is not a number"):
        Gravity("twice")


def test_an_effect_is_a_frozen_value():
    effect = GeomSize(2, geoms=["a", "b"])  # a list, as from a configuration file
    assert effect == GeomSize(2.0, geoms=("a", "b"))
    assert hash(effect) == hash(GeomSize(2.0, geoms=("a", "b")))
    assert pickle.loads(pickle.dumps(effect)) == effect
    assert dataclasses.replace(effect, scale=3.0) == GeomSize(3.0, geoms=("a", "b"))
    with pytest.raises(dataclasses.FrozenInstanceError):
        effect.scale = 1.0


def test_one_index_selects_as_a_tuple_of_one_does():
    assert ActionNoise(1.0, actuators=1) == ActionNoise(1.0, actuators=[np.int64(1)])
    assert ActionNoise(1.0, actuators=1).actuators == (1,)
    assert ActionNoise(1.0, actuators=None).actuators is None


@pytest.mark.parametrize("names", [(), "", 0, ("torso", 1), ("",), None])
def test_what_selects_no_names_is_refused(names):
    with pytest.raises(ValueError, match=r"BodyMass: bodies = .* selects nothing by name; give"):
        BodyMass(2.0, bodies=names)


@pytest.mark.parametrize("indices", [(), "0", "", (0, "1"), True, 1.0, -1, (0, -1)])
def test_what_selects_no_indices_is_refused(indices):
    with pytest.raises(ValueError, match=r"ActionNoise: actuators = .* selects nothing by index; give"):
        ActionNoise(1.0, actuators=indices)


def test_words_name_what_the_effect_acts_on():
    assert JointDamping(0.5).describe() == "damping of all joints + 0.5 N·m·s/rad"
    assert GeomSize(2.0, geoms=("a*", "b")).describe() == "size of geoms a*, b × 2"
    bias = ObservationBias(1, entries=(0, 2))
    assert bias.describe() == "bias of 1 on entries 0, 2 of the observation"
    assert bias.describe({"entries": ["x", "y", "z"]}) == "bias of 1 on entries x, z of the observation"
    assert bias.describe({"entries": ["x"]}) == "bias of 1 on entries x, 2 of the observation"


def test_an_unknown_gap_is_answered_with_the_nine_names():
    with pytest.raises(ValueError, match=r"no gap named 'graviti'.*gravity, friction, joint_noise"):
        paper_gap("graviti")


def test_a_gap_of_strength_zero_is_not_one_of_the_default_strength():
    assert paper_gap("gravity", 0.0).scale == 0.0
    with pytest.raises(ValueError, match=r"Gravity: scale = -1 lies outside"):
        paper_gap("gravity", -1.0)


def test_effects_need_no_torch():
    code = "import sys, torchrl_h2o.effects; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (ActionSaturation(3.8), "saturation at 3.8 V of all actuators"),
        (ActionBias(0.1, (1,)), "bias of 0.1 V on actuators motor"),
        (ObservationBias(0.1, (0,)), "bias of 0.1 rad on entries angle of the observation"),
        (ObservationNoise(0.1), "noise of standard deviation 0.1 on all entries of the observation"),  # rad and rad/s
        (ActionGain(0.5), "all actuators × 0.5"),
        (ActionSaturation(3.8, (4,)), "saturation at 3.8 of actuators 4"),  # there is none
    ],
)
def test_what_is_added_to_a_signal_or_limits_it_has_the_signals_unit(effect, words):
    names = {
        **{"entries": ["angle", "rate"], "entry_units": ["rad", "rad/s"]},
        **{"actuators": ["pump", "motor"], "actuator_units": ["V", "V"]},
    }
    assert effect.describe(names) == words
