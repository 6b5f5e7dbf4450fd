"""Inverse dynamics of the residual return the force that acted."""

import numpy as np

from tests.residuals.pendulum import UnknownForce, pendulum, recorded
from torchrl_h2o.effects import JointForce
from torchrl_h2o.residuals.forces.inverse_force import force_response, residual_forces, step_path


def test_constant_force_is_read_back():
    simulation = pendulum()
    measured = recorded(simulation.with_effects(JointForce(0.3)), transitions=300)
    forces = residual_forces(simulation, measured, measured.windows(1))
    np.testing.assert_allclose(forces.force, 0.3, rtol=0.01)
    assert (forces.weight > 0.0).all()


def test_force_follows_a_law_of_the_position():
    simulation = pendulum()
    measured = recorded(simulation.with_effects(UnknownForce(0.3, lambda q, v, t: np.sin(2.0 * q))), transitions=300)
    starts = measured.windows(1)
    forces = residual_forces(simulation, measured, starts).force[:, 0]
    mean = np.sin(2.0 * step_path(simulation, measured, starts).qpos[..., 0]).mean(1)
    np.testing.assert_allclose(forces, 0.3 * mean, atol=0.01)


def test_path_of_a_step_starts_as_measured_and_goes_by_physics_steps():
    simulation = pendulum()
    measured = recorded(simulation, transitions=300)
    path = step_path(simulation, measured, measured.windows(1))
    assert path.qpos.shape == (300, 2, 1)
    np.testing.assert_allclose(path.qpos[:, 0, 0], measured.observation[:, 0])
    np.testing.assert_allclose(np.diff(path.time[0]), 0.01)


def test_response_of_a_hinge_is_time_over_inertia():
    simulation = pendulum()
    measured = recorded(simulation, transitions=50)
    response = force_response(simulation, measured, measured.windows(1))
    expected = simulation.control_step / simulation.model.dof_M0[0]
    np.testing.assert_allclose(response[:, 1, 0], expected, rtol=0.05)  # damping and gravity reduce it slightly


def test_row_that_diverged_has_no_weight():
    simulation = pendulum()
    measured = recorded(simulation, transitions=60)
    residual = np.full((60, 2), 0.1) * np.random.default_rng(0).standard_normal((60, 2))
    residual[7] = np.nan
    forces = residual_forces(simulation, measured, measured.windows(1), residual=residual)
    assert forces.weight[7, 0] == 0.0
    assert np.isfinite(forces.force).all()
