"""Effects on actions, observations and forces."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.effects.models import CART, spec
from torchrl_h2o.effects import (
    ActionBacklash,
    ActionBias,
    ActionDeadBand,
    ActionDelay,
    ActionGain,
    ActionLag,
    ActionNoise,
    ActionSaturation,
    JointForce,
    LinearDrag,
    ObservationBias,
    ObservationDelay,
    ObservationGain,
    ObservationNoise,
    compile_model,
)

DT = 0.005
ALTERING = [
    ActionNoise(0.5),
    ActionDelay(0.0125),
    ActionGain(2.0),
    ObservationNoise(0.5),
    ObservationBias(0.5),
    ActionBias(0.5),
    ActionDeadBand(0.5),
    ActionSaturation(0.5),
    ActionBacklash(0.5),
    ActionLag(0.01),
    ObservationGain(0.5),
    ObservationDelay(0.0125),
]
vectors = arrays(np.float64, 3, elements=st.floats(-1, 1, allow_subnormal=False))


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@given(values=st.lists(vectors, min_size=1, max_size=5), effect=st.sampled_from(ALTERING))
def test_a_neutral_process_passes_values_on_unchanged(values, effect):
    process = type(effect)().process(DT, rng())
    for value in values:
        np.testing.assert_array_equal(process(value), value)


@pytest.mark.parametrize("effect", ALTERING)
def test_a_process_neither_writes_to_its_input_nor_hands_it_out(effect):
    process, value = effect.process(DT, rng()), np.ones(3)
    for _ in range(4):
        process(value)[:] = 7.0
    np.testing.assert_array_equal(value, 1.0)


@given(delay=st.floats(0, 4.5 * DT), commands=st.lists(vectors, min_size=1, max_size=8))
def test_a_delayed_step_has_the_impulse_of_the_delayed_command_signal(delay, commands):
    late = ActionDelay(delay).process(DT, rng())
    for step, command in enumerate(commands):
        executed = late(command)
        # reference: each command is held for a step, zero before the first one; the result is integrated over this step
        start, expected = step - delay / DT, np.zeros(3)
        for index, held in enumerate(commands[: step + 1]):
            expected += held * max(0.0, min(start + 1, index + 1) - max(start, index))
        np.testing.assert_allclose(executed, expected, atol=1e-9)


def test_every_process_starts_with_an_empty_delay_line():
    effect = ActionDelay(DT)
    first = effect.process(DT, rng())
    assert (first(np.ones(1)), first(np.ones(1))) == (0.0, 1.0)
    assert effect.process(DT, rng())(np.ones(1)) == 0.0


def test_a_delay_line_holds_what_was_asked_for_even_if_the_caller_reuses_the_array():
    late, command = ActionDelay(DT).process(DT, rng()), np.ones(1)
    late(command)
    command[:] = 9.0
    assert late(command) == 1.0


@pytest.mark.parametrize("effect", [ActionNoise(0.5), ObservationNoise(0.5)])
def test_noise_has_its_standard_deviation_and_repeats_with_its_seed(effect):
    noisy, again = effect.process(DT, rng()), effect.process(DT, rng())
    samples = np.array([noisy(np.ones(2)) for _ in range(4000)])
    np.testing.assert_allclose(samples.mean(0), 1.0, atol=0.03)
    np.testing.assert_allclose(samples.std(0), 0.5, atol=0.02)
    np.testing.assert_array_equal(samples[0], again(np.ones(2)))
    assert not np.array_equal(samples[0], samples[1])


@pytest.mark.parametrize(
    "effect",
    [
        ActionNoise(1.0, actuators=(1,)),
        ActionGain(2.0, actuators=(1,)),
        ObservationNoise(1.0, entries=(1,)),
        ObservationBias(1.0, entries=(1,)),
        ActionBias(1.0, actuators=(1,)),
        ActionDeadBand(0.5, actuators=(1,)),
        ActionSaturation(0.5, actuators=(1,)),
        ActionBacklash(0.5, actuators=(1,)),
        ActionLag(0.01, actuators=(1,)),
        ActionDelay(0.01, actuators=(1,)),
        ObservationGain(0.5, entries=(1,)),
    ],
)
def test_an_effect_on_named_entries_leaves_the_others(effect):
    altered = effect.process(DT, rng())(np.ones(3))
    np.testing.assert_array_equal(altered[[0, 2]], 1.0)
    assert altered[1] != 1.0
    with pytest.raises(ValueError, match="choose from 0 to 0"):
        effect.process(DT, rng())(np.ones(1))


def cart() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = compile_model(spec(CART))
    data = mujoco.MjData(model)
    data.qpos[1], data.qvel[:] = 0.3, (2.0, -1.0)
    mujoco.mj_forward(model, data)
    return model, data


def test_a_joint_force_acts_on_its_joint_alone():
    model, data = cart()
    np.testing.assert_array_equal(JointForce(3.0, "hinge").process(model, rng())(data), [0.0, 3.0])


def test_drag_takes_the_power_that_its_coefficient_says():
    model, data = cart()
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 2, velocity, 0)
    force = LinearDrag(0.7, bodies="pole").process(model, rng())(data)
    # mjOBJ_BODY: the velocity at the body's centre of mass
    assert force @ data.qvel == pytest.approx(-0.7 * velocity[3:] @ velocity[3:])


@pytest.mark.parametrize("effect", [JointForce(1.0, "knee"), LinearDrag(1.0, "knee")])
def test_a_force_on_what_is_not_there_is_refused(effect):
    with pytest.raises(ValueError, match="named 'knee'; it has"):
        effect.process(cart()[0], rng())
