"""Effects on whole runs and on many states at once, compared with their step-by-step result."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from tests.effects.models import CART, spec
from torchrl_h2o.effects import (
    ActionBacklash,
    ActionBias,
    ActionDeadBand,
    ActionDelay,
    ActionEffect,
    ActionGain,
    ActionLag,
    ActionNoise,
    ActionSaturation,
    JointForce,
    LinearDrag,
    ObservationBias,
    ObservationDelay,
    ObservationEffect,
    ObservationGain,
    ObservationNoise,
    QuadraticDrag,
    compile_model,
)
from torchrl_h2o.effects.states import States

DT = 0.005
ON_ACTIONS = [
    ActionNoise(0.5),
    ActionGain(2.0),
    ActionBias(0.3),
    ActionDeadBand(0.2),
    ActionSaturation(0.4),
    ActionBacklash(0.5),
    ActionDelay(0.4 * DT),
    ActionDelay(2.0 * DT),
    ActionDelay(30.25 * DT),
    ActionLag(0.01 * DT),
    ActionLag(1e-300),
    ActionLag(5e-324),
    ActionLag(3.0 * DT),
    ActionLag(10.0),
]
FORCES = [JointForce(3.0, "hinge"), LinearDrag(0.7), QuadraticDrag(0.7, bodies="pole")]


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def stepwise(effect: ActionEffect | ObservationEffect, values: np.ndarray) -> np.ndarray:
    process = effect.process(DT, rng())
    return np.array([process(value) for value in values]).reshape(values.shape)


def some_of(effect: ActionEffect) -> ActionEffect:
    return type(effect)(**{**vars(effect), "actuators": (0,)})


@given(
    effect=st.sampled_from(ON_ACTIONS + [some_of(effect) for effect in ON_ACTIONS]),
    actions=arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=40), elements=st.floats(-1, 1)),
)
def test_a_run_is_what_the_steps_are(effect, actions):
    before = actions.copy()
    executed = effect.run(actions, DT, rng())
    np.testing.assert_allclose(executed, stepwise(effect, actions), atol=1e-12)
    np.testing.assert_array_equal(actions, before)
    assert not np.shares_memory(executed, actions)


@pytest.mark.parametrize("effect", ON_ACTIONS)
def test_a_run_without_a_step_stays_one(effect):
    assert effect.run(np.zeros((0, 2)), DT, rng()).shape == (0, 2)


@pytest.mark.parametrize("effect", ON_ACTIONS)
def test_a_neutral_effect_leaves_a_run_unchanged(effect):
    actions = rng().uniform(-1, 1, (50, 3))
    np.testing.assert_array_equal(type(effect)().run(actions, DT, rng()), actions)


def test_a_lag_has_the_impulse_of_the_differential_equation():
    commands, constant, fine = rng().uniform(-1, 1, 8), 1.7 * DT, 20000
    executed = ActionLag(constant).run(commands[:, None], DT, rng())[:, 0]
    drive, means = 0.0, []
    for command in commands:
        within = np.empty(fine)
        for i in range(fine):
            drive += DT / fine * (command - drive) / constant
            within[i] = drive
        means.append(within.mean())
    np.testing.assert_allclose(executed, means, atol=1e-4)


def test_a_lag_has_followed_63_percent_after_its_time_constant():
    fine = ActionLag(1.0).run(np.ones((2000, 1)), 0.001, rng())[:, 0]
    assert fine[999] == pytest.approx(1 - np.exp(-1), abs=1e-3)


@given(commands=arrays(np.float64, 30, elements=st.floats(-1, 1)), width=st.floats(0, 1))
def test_backlash_moves_only_when_it_is_pushed(commands, width):
    executed = ActionBacklash(width).run(commands[:, None], DT, rng())[:, 0]
    assert (np.abs(executed - commands) <= width / 2 + 1e-12).all()
    moves = np.diff(executed, prepend=0.0)
    pushed = np.isclose(np.abs(executed - commands), width / 2)
    assert pushed[moves != 0.0].all()
    # the executed action lags: while it increases, it lies below the command
    assert ((executed <= commands + 1e-12) | (moves <= 0.0)).all()


def test_a_dead_band_takes_its_width_off_and_saturation_the_rest():
    commands = np.array([[-1.0], [-0.1], [0.0], [0.15], [0.5]])
    np.testing.assert_allclose(ActionDeadBand(0.2).run(commands, DT, rng())[:, 0], [-0.8, 0, 0, 0, 0.3])
    np.testing.assert_allclose(ActionSaturation(0.4).run(commands, DT, rng())[:, 0], [-0.4, -0.1, 0, 0.15, 0.4])
    np.testing.assert_array_equal(ActionSaturation(0.0).run(commands, DT, rng()), 0.0)


@pytest.mark.parametrize(
    "effect",
    [
        ObservationGain(1.7),
        ObservationGain(-0.3, entries=(1,)),
        ObservationBias(0.4, entries=(0, 2)),
        ObservationDelay(0.0),
        ObservationDelay(3.0 * DT),
        ObservationDelay(2.0 * DT, entries=(1,)),
        ObservationNoise(0.0),
    ],
)
def test_what_is_restored_is_what_was_true(effect):
    true = rng().uniform(-1, 1, (40, 3))
    reported = stepwise(effect, true)
    restored = effect.restore(reported, DT)
    known = np.isfinite(restored)
    assert known[:30].all()
    np.testing.assert_allclose(restored[known], true[known], atol=1e-12)
    assert not np.shares_memory(restored, reported)


@given(delay=st.floats(0, 6 * DT))
def test_what_changes_evenly_is_restored_after_a_delay_of_any_time(delay):
    true = np.outer(np.arange(20.0), [1.0, -2.0])
    effect = ObservationDelay(delay)
    restored = effect.restore(stepwise(effect, true), DT)
    np.testing.assert_allclose(restored[8:13], true[8:13], atol=1e-9)
    lost = np.isnan(restored[:, 0])
    assert lost.sum() == np.ceil(delay / DT)
    assert not lost[: 20 - lost.sum()].any()


def test_a_delayed_sensor_reports_the_first_reading_until_another_arrives():
    readings = np.array([[5.0], [6.0], [8.0], [8.0]])
    reported = stepwise(ObservationDelay(1.5 * DT), readings)[:, 0]
    np.testing.assert_allclose(reported, [5.0, 5.0, 5.5, 7.0])


def test_nothing_is_known_of_a_sensor_that_reads_zero():
    restored = ObservationGain(0.0, entries=(0,)).restore(np.ones((2, 2)), DT)
    assert np.isnan(restored[:, 0]).all()
    np.testing.assert_array_equal(restored[:, 1], 1.0)


@pytest.mark.parametrize("effect", FORCES)
def test_forces_on_many_states_are_those_on_each(effect):
    model, draw = compile_model(spec(CART)), rng()
    qpos, qvel = draw.normal(size=(5, model.nq)), draw.normal(size=(5, model.nv))
    together = effect.batched(model)(States(qpos, qvel, np.zeros((5, 0)), np.zeros((5, 0)), np.arange(5.0)))
    assert together.shape == (5, model.nv)
    force, data = effect.process(model, rng()), mujoco.MjData(model)
    for i in range(5):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(together[i], force(data), atol=1e-12)


def test_quadratic_drag_lets_a_body_fall_at_its_terminal_velocity():
    ball = '<mujoco><worldbody><body pos="0 0 5"><freejoint/><geom size=".1" mass="2"/></body></worldbody></mujoco>'
    model = compile_model(mujoco.MjSpec.from_string(ball))
    data = mujoco.MjData(model)
    data.qvel[2] = -np.sqrt(2.0 * 9.81 / 0.5)
    mujoco.mj_forward(model, data)
    force = QuadraticDrag(0.5).process(model, rng())(data)
    np.testing.assert_allclose(force[:3], [0, 0, 2.0 * 9.81])
