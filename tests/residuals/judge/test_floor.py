"""The floor is the error that remains after a network has explained what it can."""

import numpy as np
import torch

from tests.residuals.pendulum import UnknownForce, pendulum, recorded
from torchrl_h2o.residuals import Split, residuals
from torchrl_h2o.residuals.judge.held_out_error import explainable_floor


def held_out_error(simulation, measured) -> np.ndarray:
    return np.sqrt((residuals(simulation, measured, measured.windows(1, split=Split.REPORT))[:, 0] ** 2).mean(0))


def test_floor_of_an_unknown_force_lies_near_the_noise():
    simulation = pendulum()
    truth = UnknownForce(0.3, lambda q, v, t: np.sin(2.0 * q))
    measured = recorded(simulation.with_effects(truth), noise=0.003)
    floor, noise = explainable_floor(simulation, measured), held_out_error(simulation.with_effects(truth), measured)
    assert floor[1] < noise[1] + 0.3 * (held_out_error(simulation, measured)[1] - noise[1])
    assert floor[1] > 0.8 * noise[1]


def test_floor_of_mere_noise_is_the_residual_itself():
    simulation = pendulum()
    measured = recorded(simulation, noise=0.01)
    before = held_out_error(simulation, measured)
    floor = explainable_floor(simulation, measured)
    assert (floor <= before).all()
    np.testing.assert_allclose(floor, before, rtol=0.05)


def test_floor_leaves_the_random_generator_of_torch_alone():
    simulation = pendulum()
    measured = recorded(simulation, transitions=300, noise=0.01)
    before = torch.get_rng_state()
    first = explainable_floor(simulation, measured)
    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(first, explainable_floor(simulation, measured))


def test_floor_is_below_rare_errors_that_a_network_learns():
    """A force acts beyond an angle that the arm seldom reaches, and is the whole error."""
    simulation = pendulum()
    stop = UnknownForce(0.5, lambda q, v, t: -np.sign(q) * (np.abs(q) > 1.2))
    measured = recorded(simulation.with_effects(stop), 4000)
    assert explainable_floor(simulation, measured)[1] < 0.85 * held_out_error(simulation, measured)[1]
