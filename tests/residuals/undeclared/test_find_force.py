"""A force outside the catalogue is found from data and described, and only where it lowers the held-out loss."""

import numpy as np
import pytest

from tests.residuals.pendulum import UnknownForce, pendulum, recorded
from torchrl_h2o.effects import ActionSaturation
from torchrl_h2o.residuals import Split, residuals
from torchrl_h2o.residuals.undeclared.find_force import find_undeclared

LAWS = {
    "torque ripple": (0.2, lambda q, v, t: np.sin(7.0 * q + 0.5)),
    "wind": (-0.002, lambda q, v, t: v**3),
    "a spring to a moving point": (-0.5, lambda q, v, t: q - 0.4 * np.sin(2.3 * t)),
    "a force that starts late": (0.2, lambda q, v, t: (t >= 9.7) + 0.0 * q),
    "friction that depends on position": (-0.08, lambda q, v, t: np.sign(v) * (1.0 + 0.8 * np.cos(5.0 * q))),
}
FAST = "a force that starts late"


@pytest.mark.parametrize("name", [FAST, *(pytest.param(law, marks=pytest.mark.slow) for law in LAWS if law != FAST)])
def test_force_that_no_catalogue_holds_is_found(name):
    size, law = LAWS[name]
    simulation, truth = pendulum(), UnknownForce(size, law)
    measured = recorded(simulation.with_effects(truth), noise=0.01)
    found = find_undeclared(simulation, measured)
    left = residuals(simulation.with_effects(truth), measured, measured.windows(1, split=Split.REPORT))[:, 0]
    least = np.sqrt((left**2).mean(0))
    explained = (found.error_before - found.error_after) / (found.error_before - least)
    assert explained[1] > 0.8


def test_ripple_is_described_with_its_frequency_and_interval():
    simulation = pendulum()
    truth = UnknownForce(0.2, lambda q, v, t: np.sin(7.0 * q))
    measured = recorded(simulation.with_effects(truth), noise=0.002)
    found = find_undeclared(simulation, measured)
    (term,) = found.effect.parsed
    assert term.factors[-1].function == "sin"
    low, high = found.ci95["frequency_1"]
    assert low < 7.0 < high
    assert high - low < 0.2
    assert found.effect.describe().startswith("torque on joint elbow: ")


def test_noise_alone_is_no_effect():
    simulation = pendulum()
    assert find_undeclared(simulation, recorded(simulation, noise=0.01)) is None


def test_perfect_simulator_lacks_nothing():
    simulation = pendulum()
    assert find_undeclared(simulation, recorded(simulation)) is None


def test_force_that_ceases_before_the_selection_data_is_not_kept():
    """The force explains the fitted rows but increases the error of the rows of the selection."""
    simulation = pendulum()
    burst = UnknownForce(0.2, lambda q, v, t: (t < 15.0) * np.sin(5.0 * q))
    assert find_undeclared(simulation, recorded(simulation.with_effects(burst), noise=0.01)) is None


@pytest.mark.slow
def test_a_weak_drift_shows_only_in_long_windows():
    """One step ahead, the sensors' noise hides it."""
    drift = UnknownForce(0.03, lambda q, v, t: t / 40.0 + 0.0 * q)
    simulation = pendulum()
    measured = recorded(simulation.with_effects(drift), 2000, noise=0.02)
    assert find_undeclared(simulation, measured) is None
    found = find_undeclared(simulation, measured, 25)
    assert found is not None
    assert [term.split(": ")[1].split(" · ")[1] for term in found.effect.terms] == ["t"]


@pytest.mark.slow
def test_no_power_of_a_control_is_beside_its_saturation():
    """Both explain the same; the data would leave the values of both open."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionSaturation(0.4)), noise=0.002)
    beside = find_undeclared(simulation.with_effects(ActionSaturation(0.5)), measured)
    alone = find_undeclared(simulation, measured)
    assert "a0" in alone.effect.describe()
    assert beside is None or "a0" not in beside.effect.describe()
