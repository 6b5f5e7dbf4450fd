"""Negative noise: the remaining noise of the effects before it, and errors if they add too little noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_h2o.effects import ActionGain, ActionNoise, Gravity, ObservationNoise, balanced

ON_FIRST = (0,)
sizes = st.floats(0.1, 5.0)


def stds(*effects) -> list[float]:
    return [effect.std for effect in balanced(effects) if isinstance(effect, ActionNoise)]


def test_effects_without_negative_noise_are_the_very_same():
    effects = [Gravity(2.0), ActionNoise(1.0), ActionNoise(0.0), ActionNoise(0.5, ON_FIRST), ObservationNoise(1.0)]
    after = balanced(effects)
    assert len(after) == len(effects)
    assert all(one is other for one, other in zip(after, effects, strict=True))
    assert balanced([]) == ()


def test_variances_add():
    assert stds(ActionNoise(1.0), ActionNoise(-0.6)) == [0.8, 0.0]
    assert stds(ActionNoise(1.0), ActionNoise(-1.0)) == [0.0, 0.0]


@given(added=st.lists(sizes, min_size=1, max_size=4), share=st.floats(0.0, 1.0))
def test_what_is_left_of_several_is_the_difference_of_the_variances(added, share):
    total = np.sum(np.square(added))
    after = stds(*map(ActionNoise, added), ActionNoise(-np.sqrt(share * total)))
    assert np.sum(np.square(after)) == pytest.approx((1.0 - share) * total, abs=1e-8 * total)
    assert after[-1] == 0.0


@given(first=sizes, second=sizes)
def test_noise_can_be_taken_away_bit_by_bit_to_the_last(first, second):
    total = np.hypot(first, second)
    assert stds(ActionNoise(total), ActionNoise(-first), ActionNoise(-second)) == [0.0, 0.0, 0.0]


def test_only_noise_before_it_on_the_same_actuators_gets_smaller():
    effects = [
        Gravity(2.0),
        ActionNoise(1.0, actuators=(2, 0)),
        ActionNoise(3.0),
        ActionNoise(5.0, actuators=(0,)),
        ObservationNoise(1.0, entries=(0, 2)),
        ActionNoise(-0.6, actuators=(0, 2)),
        ActionNoise(1.0, actuators=(0, 2)),
    ]
    after = balanced(effects)
    assert after[1] == ActionNoise(0.8, actuators=(2, 0))
    assert after[5] == ActionNoise(0.0, actuators=(0, 2))
    assert all(after[i] is effects[i] for i in (0, 2, 3, 4, 6))


def test_noise_is_measured_where_it_is_added_whatever_follows():
    assert stds(ActionNoise(1.0), ActionGain(3.0), ActionNoise(-0.6)) == [0.8, 0.0]


def test_a_fit_that_is_a_little_too_large_takes_all():
    assert stds(ActionNoise(2.0), ActionNoise(-2.0 * np.sqrt(1.009))) == [0.0, 0.0]
    with pytest.raises(ValueError, match="add only 2 on exactly"):
        balanced([ActionNoise(2.0), ActionNoise(-2.0 * np.sqrt(1.011))])


@pytest.mark.parametrize(
    "effects",
    [
        [ActionNoise(-1.0)],
        [ActionNoise(-1.0), ActionNoise(1.0)],
        [ActionNoise(0.5), ActionNoise(-1.0)],
        [ActionNoise(1.0), ActionNoise(-0.8), ActionNoise(-0.8)],
        [ActionNoise(1.0, ON_FIRST), ActionNoise(-1.0)],
        [ActionNoise(1.0), ActionNoise(-1.0, ON_FIRST)],
        [ObservationNoise(1.0), ActionNoise(-1.0)],
    ],
)
def test_noise_that_is_not_there_cannot_be_taken_away(effects):
    with pytest.raises(ValueError, match=r"taken off .*: the effects before it add only .*; put it behind"):
        balanced(effects)


def test_negative_noise_by_itself_cannot_be_executed():
    with pytest.raises(ValueError, match=r"std = -0.5 cannot be executed by itself.*balanced\(effects\)"):
        ActionNoise(-0.5).process(0.05, np.random.default_rng(0))


def test_negative_noise_is_described_as_taken_off():
    assert ActionNoise(-0.5, (0, 2)).describe() == "noise of standard deviation 0.5 taken off actuators 0, 2"
    assert ActionNoise(-0.5, 1).describe({"actuators": "ab"}) == "noise of standard deviation 0.5 taken off actuators b"
    assert ActionNoise(0.5).describe() == "noise of standard deviation 0.5 on all actuators"
