"""Simulation: rollouts of many states equal MuJoCo's steps of each; effects; divergence is marked."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.pendulum import UnknownForce, double_pendulum, pendulum
from torchrl_h2o.effects import (
    ActionDelay,
    ActionNoise,
    BodyMass,
    Gravity,
    JointDamping,
    LinearDrag,
    LoadFriction,
    ObservationBias,
    ObservationDelay,
    ObservationGain,
)
from torchrl_h2o.envs import DynamicsGap, physics
from torchrl_h2o.residuals import Simulation

PULL = UnknownForce(0.2, lambda q, v, t: np.sin(7.0 * q) - 0.1 * v + np.cos(3.0 * t))


def drawn(batch=7, horizon=5, seed=0):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((batch, 2)), rng.uniform(-1.0, 1.0, (batch, horizon, 1)), rng.uniform(0.0, 9.0, batch)


@pytest.mark.parametrize("effects", [(), (Gravity(1.5), PULL), (LinearDrag(0.3),)], ids=["plain", "force", "drag"])
def test_a_rollout_is_what_mujoco_makes_of_each_state_alone(effects):
    simulation = pendulum().with_effects(*effects)
    states, actions, time = drawn()
    reached = simulation.rollout(states, actions, time=time)
    forces = [e.process(simulation.model, np.random.default_rng(0)) for e in effects if not isinstance(e, Gravity)]
    for b in range(len(states)):
        data = mujoco.MjData(simulation.model)
        data.qpos[:], data.qvel[:], data.time = states[b, :1], states[b, 1:], time[b]
        for h in range(actions.shape[1]):
            data.ctrl[:] = actions[b, h]
            for _ in range(simulation.frame_skip):
                mujoco.mj_forward(simulation.model, data)
                data.qfrc_applied[:] = sum((force(data) for force in forces), np.zeros(1))
                mujoco.mj_step(simulation.model, data)
            np.testing.assert_allclose(reached[b, h], [*data.qpos, *data.qvel], atol=1e-12)


@pytest.mark.parametrize("effects", [(), (PULL,)], ids=["free", "forced"])
def test_a_rollout_in_chunks_is_the_rollout_at_once(effects, monkeypatch):
    simulation = pendulum().with_effects(*effects)
    states, actions, time = drawn(batch=50)
    applied = np.random.default_rng(1).standard_normal((50, 5, 1))
    at_once = simulation.rollout(states, actions, time=time, applied=applied)
    monkeypatch.setattr("torchrl_h2o.residuals.simulation.simulation._ROLLOUT_NUMBERS", 100)
    np.testing.assert_array_equal(simulation.rollout(states, actions, time=time, applied=applied), at_once)


@pytest.mark.parametrize("effects", [(), (PULL,)], ids=["free", "forced"])
def test_a_small_rollout_uses_no_threads_and_gives_the_same_states(effects, monkeypatch):
    simulation = pendulum().with_effects(*effects)
    states, actions, time = drawn()
    alone = simulation.rollout(states, actions, time=time)
    monkeypatch.setattr(physics, "ALONE", None)
    with pytest.raises(AttributeError):
        simulation.rollout(states, actions, time=time)
    monkeypatch.setattr(physics, "_FEW", 0)
    np.testing.assert_array_equal(simulation.rollout(states, actions, time=time), alone)


def test_simulations_are_equal_if_source_and_effects_are():
    simulation = pendulum()
    assert simulation.with_effects(Gravity(2.0)) == simulation.with_effects(Gravity(2.0))
    assert hash(simulation.with_effects(Gravity(2.0))) == hash(simulation.with_effects(Gravity(2.0)))
    assert simulation.with_effects(Gravity(2.0)) != simulation.with_effects(Gravity(2.1))
    assert simulation != pendulum()
    assert simulation != replace(simulation, frame_skip=2 * simulation.frame_skip)


def test_a_rollout_of_no_states_is_empty():
    assert pendulum().rollout(np.zeros((0, 2)), np.zeros((0, 3, 1))).shape == (0, 3, 2)


@pytest.mark.parametrize("effects", [(), (PULL,)], ids=["free", "forced"])
def test_what_diverges_is_nan_from_there_on_and_spoils_no_other(effects):
    simulation = pendulum().with_effects(*effects)
    states, actions, time = drawn(batch=3)
    alone = simulation.rollout(states[::2], actions[::2], time=time[::2])
    applied = np.zeros((3, 5, 1))
    applied[1, 2] = 1e15
    reached = simulation.rollout(states, actions, time=time, applied=applied)
    assert np.isfinite(reached[1, :2]).all()
    assert np.isnan(reached[1, 2:]).all()
    np.testing.assert_array_equal(reached[::2], alone)


def test_divergence_writes_no_warning(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pendulum().rollout(np.full((1, 2), 1e12), np.zeros((1, 3, 1)))
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


def test_threads_step_the_same_model_at_once():
    """The finite differences of a fit run in threads, also with effects that leave the model as it is."""
    simulation = pendulum()
    simulations = [simulation.with_effects(replace(PULL, size=0.01 * i)) for i in range(12)]
    states, actions, time = drawn(batch=200)

    def reached(one):
        return one.rollout(states, actions, time=time)

    one_by_one = list(map(reached, simulations))
    with ThreadPoolExecutor(4) as threads:
        np.testing.assert_array_equal(list(threads.map(reached, simulations)), one_by_one)


def test_divergence_in_threads_writes_no_warning_and_leaves_the_handler(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = mujoco.get_mju_user_warning()
    with ThreadPoolExecutor(4) as threads:
        far = np.full((100, 2), 1e12)
        list(threads.map(lambda _: pendulum().rollout(far, np.zeros((100, 3, 1))), range(8)))
    assert mujoco.get_mju_user_warning() is before
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


def test_applied_forces_act_beside_those_of_effects():
    states, actions, time = drawn()
    twice = UnknownForce(0.4, PULL.law)
    both = pendulum().with_effects(PULL, PULL).rollout(states, actions, time=time)
    np.testing.assert_allclose(pendulum().with_effects(twice).rollout(states, actions, time=time), both, atol=1e-12)
    constant = UnknownForce(0.3, lambda q, v, t: 1.0 + 0.0 * q)
    applied = np.full((7, 5, 1), 0.3)
    for others in ((), (PULL,)):
        inside = pendulum().with_effects(*others, constant).rollout(states, actions, time=time)
        outside = pendulum().with_effects(*others).rollout(states, actions, time=time, applied=applied)
        np.testing.assert_allclose(inside, outside, atol=1e-12)


def test_effects_of_an_env_come_with_it_and_more_are_put_behind():
    env = TransformedEnv(GymEnv("HalfCheetah-v5"), DynamicsGap(Gravity(2.0)))
    simulation = Simulation.from_env(env).with_effects(BodyMass(2.0, bodies="torso"))
    assert [type(effect) for effect in simulation.effects] == [Gravity, BodyMass]
    assert simulation.model.opt.gravity[2] == pytest.approx(-19.62)
    assert simulation.control_step == pytest.approx(0.05)
    assert simulation.name == "HalfCheetah-v5"


def test_actions_are_executed_in_the_order_of_effects():
    actions = np.arange(1.0, 6.0)[:, None]
    late = pendulum().with_effects(ActionDelay(0.04))
    np.testing.assert_allclose(late.executed(actions)[2:], actions[:-2])
    np.testing.assert_array_equal(actions[:, 0], np.arange(1.0, 6.0))


def test_sensors_that_are_all_late_are_actions_that_are_late():
    actions = np.random.default_rng(0).standard_normal((20, 1))
    sensors, action = pendulum().with_effects(ObservationDelay(0.03)), pendulum().with_effects(ActionDelay(0.03))
    np.testing.assert_array_equal(sensors.executed(actions), action.executed(actions))
    observed = np.random.default_rng(0).standard_normal((20, 2))
    np.testing.assert_array_equal(sensors.true_observations(observed), observed)


def test_noise_that_is_taken_away_is_not_executed():
    actions = np.zeros((4000, 1))
    simulation = pendulum().with_effects(ActionNoise(1.0), ActionNoise(-0.8))
    assert simulation.executed(actions, np.random.default_rng(0)).std() == pytest.approx(0.6, rel=0.05)


def test_true_observations_undo_the_sensors_in_reverse():
    observed = np.random.default_rng(0).standard_normal((20, 2))
    sensors = (ObservationGain(0.5, entries=(1,)), ObservationBias(0.1, entries=(1,)))
    seen = observed
    for sensor in sensors:
        seen = sensor.process(0.02, np.random.default_rng(0))(seen)
    np.testing.assert_allclose(pendulum().with_effects(*sensors).true_observations(seen), observed, atol=1e-12)


def test_the_catalogue_is_that_of_the_model_with_its_effects():
    def trials(simulation, name):
        return next(entry.trials for entry in simulation.catalogue() if entry.name == name)

    plain, heavy = (trials(simulation, "Payload world/*") for simulation in (pendulum(), mended(BodyMass(4.0))))
    assert [trial["mass"] for trial in heavy] == pytest.approx([4.0 * trial["mass"] for trial in plain])
    damping = [trials(simulation, "JointDamping elbow") for simulation in (pendulum(), mended(JointDamping(-0.1)))]
    assert [any(trial["damping"] < 0.0 for trial in found) for found in damping] == [
        True,
        False,
    ]  # no damping is left to remove


def mended(*effects):
    return pendulum().with_effects(*effects)


def test_friction_that_depends_on_the_state_is_that_of_each_of_many_states():
    simulation, rng = double_pendulum().with_effects(LoadFriction(0.3, joints="elbow")), np.random.default_rng(0)
    states, actions = rng.normal(size=(300, 4)), 0.2 * rng.normal(size=(300, 2, 2))
    together = simulation.rollout(states, actions)
    for index in (0, 127, 128, 299):
        alone = simulation.rollout(states[index : index + 1], actions[index : index + 1])
        np.testing.assert_allclose(together[index], alone[0], atol=1e-12)
    assert np.abs(together - double_pendulum().rollout(states, actions)).max() > 1e-3
