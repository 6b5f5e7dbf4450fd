"""Fits recover the parameters of one and two effects, with valid intervals, from any start."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import UnknownForce, double_pendulum, pendulum, recorded
from torchrl_h2o.effects import ActionDelay, Armature, Gravity, JointDamping, JointFrictionLoss, ObservationGain
from torchrl_h2o.residuals import Measured
from torchrl_h2o.residuals.trace.fit import fit
from torchrl_h2o.residuals.trace.model_bounds import lowest_value
from torchrl_h2o.residuals.trace.problem import Problem, losses

SIMULATION = pendulum()


def pose(*truth, rows=600, horizon=1, noise=0.0):
    measured = recorded(SIMULATION.with_effects(*truth), rows, noise=noise)
    return Problem.pose(SIMULATION, measured, horizon)


def fitted(problem, *start, **kwargs):
    free = [(next(iter(effect.parameters)),) for effect in start]
    return fit(problem, start, free, problem.measured.windows(problem.horizon, problem.horizon), **kwargs)


@pytest.mark.parametrize(
    ("truth", "start", "horizon"),
    [
        (Gravity(1.3), Gravity(1.05), 1),
        (JointFrictionLoss(0.05), JointFrictionLoss(0.01), 5),
        (ActionDelay(0.013), ActionDelay(0.006), 1),
        (ActionDelay(0.013), ActionDelay(0.006), 5),
    ],
)
def test_the_parameter_of_an_effect_comes_back(truth, start, horizon):
    (found,) = fitted(pose(truth, horizon=horizon), start).effects
    (name,) = truth.parameters
    assert found.parameters[name].value == pytest.approx(truth.parameters[name].value, rel=0.01)


def test_the_parameters_of_two_effects_come_back():
    found = fitted(pose(Gravity(1.3), JointDamping(0.15)), Gravity(1.05), JointDamping(0.05)).effects
    assert found[0].scale == pytest.approx(1.3, rel=0.01)
    assert found[1].damping == pytest.approx(0.15, rel=0.01)


def test_the_gain_of_a_sensor_comes_back():
    """The start states of the windows are read by the same sensor."""
    real = recorded(SIMULATION, 600)
    seen = replace(real, observation=real.observation * [1.0, 0.8], following=real.following * [1.0, 0.8])
    (found,) = fitted(Problem.pose(SIMULATION, seen), ObservationGain(0.9, entries=(1,))).effects
    assert found.scale == pytest.approx(0.8, rel=0.01)


def test_a_few_transitions_that_were_pushed_do_not_move_a_fit():
    real = recorded(SIMULATION.with_effects(Gravity(1.3)), 600)
    pushed = np.random.default_rng(0).permutation(600)[:18]
    following = real.following.copy()
    following[pushed, 1] += 5.0 * np.sign(np.sin(real.observation[pushed, 0]))  # as if there were no gravity
    (found,) = fitted(Problem.pose(SIMULATION, replace(real, following=following)), Gravity(1.05)).effects
    assert found.scale == pytest.approx(1.3, rel=0.01)


def outcomes_scattered(measured: Measured, std: float, rng: np.random.Generator) -> Measured:
    return replace(measured, following=measured.following + std * rng.standard_normal(measured.following.shape))


@pytest.mark.slow
def test_the_95_percent_interval_holds_the_truth_in_95_percent_of_the_draws():
    rng, holds = np.random.default_rng(0), []
    real = recorded(SIMULATION.with_effects(Gravity(1.2), JointDamping(0.05)), 300)
    for _ in range(40):
        result = fitted(Problem.pose(SIMULATION, outcomes_scattered(real, 0.03, rng)), Gravity(1.1), JointDamping(0.03))
        for index, (name, truth) in enumerate((("scale", 1.2), ("damping", 0.05))):
            low, high = result.ci95(index)[name]
            holds.append(low < truth < high)
    assert 0.9 < np.mean(holds) < 1.0  # intervals that always hold would be too wide


def test_values_that_the_model_cannot_have_do_not_stop_a_fit():
    """The best fit, -0.11, would make the joint's total damping of 0.1 N·m·s/rad negative."""
    pushed_on = UnknownForce(0.11, lambda q, v, t: v)
    result = fitted(pose(pushed_on, rows=300), JointDamping(-0.03))
    assert result.effects[0].damping == pytest.approx(-0.1, rel=0.01)
    assert np.isfinite(result.loss)


def test_bounds_of_a_parameter_are_kept_by_its_value_and_its_interval():
    """The best fit would be a negative delay."""
    real = recorded(SIMULATION, 300)
    early = replace(real, action=np.vstack([np.zeros((1, 1)), real.action[:-1]]))
    result = fitted(Problem.pose(SIMULATION, early), ActionDelay(0.006))
    assert result.effects[0].delay == pytest.approx(0.0, abs=1e-3)
    assert result.half_widths[0]["delay"] > result.effects[0].delay
    assert result.ci95(0)["delay"][0] == 0.0


def test_other_parameters_and_the_effects_that_were_given_stay_as_they_are():
    problem, start = pose(Gravity(1.3), rows=300), (Gravity(1.1), JointDamping(0.01))
    result = fit(problem, start, [("scale",), ()], problem.measured.windows(1))
    assert result.effects[1] == start[1]
    assert start[0] == Gravity(1.1)
    assert result.ci95(1) == {}


def test_a_fit_prints_nothing(capsys):
    fitted(pose(Gravity(1.3), rows=250), Gravity(1.1))
    assert capsys.readouterr().out == ""


def test_residuals_of_what_diverges_are_large_but_finite():
    problem = pose(rows=250)
    blown_up = UnknownForce(10.0, lambda q, v, t: np.full_like(q, 1e14))
    residual = problem.residual([blown_up], problem.measured.windows(1))
    assert np.isfinite(residual).all()
    assert np.abs(residual).max() == 1e3


def test_only_rounding_is_left_of_the_right_simulator_in_single_precision():
    def posed(truth):
        real = recorded(SIMULATION.with_effects(truth), 300)
        single = {name: getattr(real, name).astype(np.float32).astype(float) for name in ("observation", "following")}
        return Problem.pose(SIMULATION, replace(real, **single))

    assert posed(Gravity(1.0)).within_rounding
    assert not posed(Gravity(1.001)).within_rounding


def test_a_large_residual_counts_less_than_its_square():
    residual = np.array([0.0, 0.01, 100.0]).reshape(3, 1, 1)
    assert losses(residual) == pytest.approx([0.0, 1e-4, 198.0], rel=0.01)
    assert losses(-residual) == pytest.approx(losses(residual))


def test_a_fit_that_takes_all_of_the_models_damping_away_still_moves_the_other_values():
    """Beyond the model's own damping, every step is rejected; a fit that does not know this stays where it began."""
    problem = pose(JointDamping(-0.1), Armature(0.02))
    damping, armature = fitted(problem, JointDamping(-0.1), Armature(0.08)).effects
    assert damping.damping == pytest.approx(-0.1, abs=2e-3)
    assert armature.inertia == pytest.approx(0.02, rel=0.05)
    assert fitted(pose(), JointDamping(-0.05)).effects[0].damping >= -0.1


def test_what_may_be_taken_away_depends_on_the_effects_beside_it():
    model = double_pendulum().with_effects(JointDamping(0.3, "shoulder"), JointDamping(0.1, "elbow")).model
    assert lowest_value(JointDamping(), model) == pytest.approx(-0.1)
    assert lowest_value(JointDamping(0.0, "shoulder"), model) == pytest.approx(-0.3)
    assert lowest_value(JointDamping(0.0, "shoulder"), model, [JointDamping(-0.1)]) == pytest.approx(-0.2)
    assert lowest_value(JointDamping(0.0, "shoulder"), model, [Armature(-0.1)]) == pytest.approx(-0.3)
    assert lowest_value(Gravity(), model) == -np.inf
