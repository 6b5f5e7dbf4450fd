"""A force outside the catalogue is looked for only where it could be added."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import UnknownForce, pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointFrictionLoss
from torchrl_h2o.residuals.explanation import Explanation
from torchrl_h2o.residuals.trace.outcome import Attempt, Trace
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState
from torchrl_h2o.residuals.undeclared import beside_or_instead
from torchrl_h2o.residuals.undeclared.beside_or_instead import add_undeclared_force

GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(joints="elbow"), ({"torque": 0.01}, {"torque": 0.1}))
RIPPLE = UnknownForce(0.2, lambda q, v, t: np.sin(7.0 * q))


@pytest.mark.parametrize(
    ("gravity", "by_forces", "looked_for"), [(0.501, False, False), (0.7, False, True), (0.7, True, False)]
)
def test_a_force_is_looked_for_where_effects_leave_enough_and_the_motion_shows_it(
    monkeypatch, gravity, by_forces, looked_for
):
    """Effects that come from the missing forces mean that noisy torques hide the motion, which a force would fit."""
    simulation, asked = pendulum(), []
    measured = recorded(simulation.with_effects(Gravity(0.5)), 400)
    state = SearchState.begin(Problem.pose(simulation, measured), [GRAVITY], np.random.default_rng(0))
    fitted = replace(state.refitted([GRAVITY], [Gravity(0.5)]), effects=(Gravity(gravity),))
    explanation = Explanation.of(Trace((GRAVITY,), fitted, (), ((),), exact=False, by_forces=by_forces))
    monkeypatch.setattr(beside_or_instead, "find_undeclared", lambda *args, **kwargs: asked.append(1))
    found = add_undeclared_force(simulation, measured, explanation, rng=np.random.default_rng(0))
    assert bool(asked) is looked_for
    assert found.effects == (Gravity(gravity),)


@pytest.mark.slow
def test_a_force_is_looked_for_where_nothing_is_explained():
    simulation = pendulum()
    measured = recorded(simulation.with_effects(RIPPLE), noise=0.002)
    nothing = SearchState.begin(Problem.pose(simulation, measured), [], np.random.default_rng(0)).fit
    found = add_undeclared_force(
        simulation, measured, Explanation.of(Trace((), nothing, (), (), exact=False)), rng=np.random.default_rng(0)
    )
    (force,) = found.effects
    assert force.describe().startswith("torque on joint elbow: ")


@pytest.mark.parametrize("offered", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_dry_friction_is_a_force_only_where_the_catalogue_lacks_it(offered):
    simulation = pendulum()
    measured = recorded(simulation.with_effects(JointFrictionLoss(0.1)), 1200, noise=0.005)
    nothing = SearchState.begin(Problem.pose(simulation, measured), [], np.random.default_rng(0)).fit
    refused = Attempt(
        replace(FRICTION, trials=FRICTION.trials[:1]), nothing, 0, 1.0, 0.5
    )  # with trials of a later round
    trace = Trace((), nothing, (refused,), (), exact=False)
    found = add_undeclared_force(
        simulation,
        measured,
        Explanation.of(trace),
        rng=np.random.default_rng(0),
        catalogue=[FRICTION] if offered else [],
    )
    (part,) = found.parts
    assert part.declared is isinstance(part.effect, JointFrictionLoss) is offered
    assert (refused in found.trace.attempts) is not offered
    if offered:
        np.testing.assert_allclose(part.effect.torque, 0.1, rtol=0.03)
