"""Explanations: catalogue effects, a force beside or instead of them, and action noise of data or simulator."""

import numpy as np
import pytest

from tests.residuals.pendulum import UnknownForce, pendulum, recorded
from torchrl_h2o.effects import ActionNoise, CatalogueEntry, Gravity, JointForce, JointFrictionLoss
from torchrl_h2o.effects.states import States
from torchrl_h2o.residuals import Evidence, explain
from torchrl_h2o.residuals.progress import OTHERS, LoopBar, OutOfTimeError

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))
CONSTANT = CatalogueEntry(JointForce(0.0, ("elbow",)), ({"torque": -0.1}, {"torque": 0.1}))
RIPPLE = UnknownForce(0.2, lambda q, v, t: np.sin(7.0 * q))


class EndsBeforeAlternatives(LoopBar):
    """A bar that raises an error where the search for alternatives would begin."""

    def __init__(self, error):
        super().__init__(disable=True)
        self.error = error

    def stage(self, name):
        super().stage(name)
        if name == OTHERS:
            raise self.error


def explained(
    *truth,
    simulation=SIMULATION,
    catalogue=(GRAVITY, FRICTION),
    rows=2000,
    noise=0.0,
    bar=None,
    so_far=lambda explanation: None,
):
    measured = recorded(SIMULATION.with_effects(*truth), rows, noise=noise)
    with bar or LoopBar(disable=True) as progress:
        evidence = Evidence(simulation, measured, undisturbed=measured, suspected=())
        return explain(evidence, catalogue, progress=progress, so_far=lambda found, stage: so_far(found))


@pytest.mark.slow
def test_a_force_that_nobody_declared_stands_beside_declared_effects():
    gravity, ripple = explained(Gravity(1.3), RIPPLE, rows=2500).parts
    assert (gravity.declared, ripple.declared) == (True, False)
    assert gravity.effect.scale == pytest.approx(1.3, rel=0.02)
    q = np.linspace(-3.0, 3.0, 50)[:, None]
    force = ripple.effect.batched(SIMULATION.model)(States(q, 0.0 * q, 0.0 * q, 0.0 * q, 0.0 * q[:, 0]))
    np.testing.assert_allclose(force, 0.2 * np.sin(7.0 * q), atol=0.04)


@pytest.mark.slow
def test_a_force_stands_in_the_place_of_effects_that_it_explains_better():
    """The explanation is the force alone; friction and gravity of the catalogue do not explain a part of the ripple."""
    (part,) = explained(RIPPLE, rows=1200).parts
    assert not part.declared
    assert part.effect.parameters["frequency_1"].value == pytest.approx(7.0, rel=0.01)


@pytest.mark.slow
def test_a_force_that_starts_late_is_not_called_one_that_was_always_there():
    """No term beside the catalogue's constant force fits the residual; a step in time replaces this force."""
    late = UnknownForce(0.2, lambda q, v, t: (t >= 8.0) + 0.0 * q)
    (part,) = explained(late, catalogue=[CONSTANT], rows=2500).parts
    assert not part.declared
    (term,) = part.effect.parsed
    assert term.factors[0].function == "step"
    assert term.factors[0].numbers[0] == pytest.approx(8.0, abs=0.03)


def test_an_error_in_the_search_leaves_what_was_found_before():
    bar = EndsBeforeAlternatives(np.linalg.LinAlgError("Singular matrix"))
    explanation = explained(Gravity(1.3), rows=1000, bar=bar)
    assert explanation.effects[0].scale == pytest.approx(1.3, rel=0.02)
    assert "further effects failed: Singular matrix" in explanation.failures[0]


def test_what_was_found_when_the_time_was_up_is_the_explanation():
    handed = []
    bar = EndsBeforeAlternatives(OutOfTimeError(OTHERS))
    explanation = explained(Gravity(1.3), RIPPLE, rows=800, noise=0.002, bar=bar, so_far=handed.append)
    assert explanation.ended_in == OTHERS
    assert explanation.parts
    assert [part.effect.describe().split(":")[0] for part in explanation.parts] == [
        part.effect.describe().split(":")[0] for part in handed[-1].parts
    ]
    assert all(part.ci95 for part in explanation.parts)  # there was time for a last fit
    assert not explanation.failures


def test_where_the_catalogue_explains_all_no_force_is_made():
    explanation = explained(Gravity(1.3), rows=800)
    assert [part.declared for part in explanation.parts] == [True]


@pytest.mark.slow
def test_intervals_hold_the_parameters_that_were_fitted():
    (part,) = explained(Gravity(1.3), noise=0.002).parts
    low, high = part.ci95["scale"]
    assert low < part.effect.scale < high


@pytest.mark.slow
def test_noise_of_the_action_stands_behind_what_else_is_missing():
    parts = explained(Gravity(2.0), ActionNoise(0.2), rows=3000).parts
    assert [type(part.effect) for part in parts] == [Gravity, ActionNoise]
    assert parts[0].effect.scale == pytest.approx(2.0, rel=0.05)
    assert parts[1].effect.std == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize(
    ("own", "missing"), [(0.1, np.sqrt(0.3**2 - 0.1**2)), pytest.param(0.5, -0.4, marks=pytest.mark.slow)]
)
def test_noise_is_what_the_simulator_has_too_little_or_too_much(own, missing):
    simulation = SIMULATION.with_effects(ActionNoise(own))
    (part,) = explained(ActionNoise(0.3), simulation=simulation, catalogue=[GRAVITY]).parts
    assert part.effect.std == pytest.approx(missing, rel=0.15)
    low, high = part.ci95["std"]
    assert low < missing < high


@pytest.mark.slow
def test_noise_that_both_have_is_no_effect():
    simulation = SIMULATION.with_effects(ActionNoise(0.3))
    assert explained(ActionNoise(0.3), simulation=simulation, catalogue=[GRAVITY]).parts == ()
