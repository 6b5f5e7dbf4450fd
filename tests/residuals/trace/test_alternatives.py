"""Alternatives to an effect: which of them count as equally good."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionDelay, CatalogueEntry, ObservationBias, ObservationDelay
from torchrl_h2o.residuals.trace.alternatives import _is_equivalent, _rivals, _sketched_rivals
from torchrl_h2o.residuals.trace.outcome import Attempt
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import Lead
from torchrl_h2o.residuals.trace.state import SearchState

LATE = CatalogueEntry(ActionDelay(), ({"delay": 0.01},))
SENSORS = CatalogueEntry(ObservationDelay(), ({"delay": 0.01},))


@pytest.fixture(scope="module")
def state():
    """A search that has found late motors, and nothing is left but rounding."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionDelay(0.013)), 400)
    begun = SearchState.begin(Problem.pose(simulation, measured), [LATE, SENSORS], np.random.default_rng(0))
    fitted = begun.refitted([LATE], [ActionDelay(0.013)])
    return replace(begun.with_found([LATE], fitted), exact=True)


@pytest.mark.parametrize(("delay", "equivalent"), [(0.013, True), (0.0131, False)])
def test_where_only_rounding_is_left_an_alternative_that_leaves_rounding_is_as_good(state, delay, equivalent):
    """A single row in which a wheel lands may make the difference of two roundings significant."""
    fitted = replace(state.fit, effects=(ObservationDelay(delay),))
    significantly_worse = Attempt(SENSORS, fitted, 0, loss=1e-3, p_value=0.0)
    assert _is_equivalent(state, significantly_worse, 0.0, 1.0) is equivalent
    assert not _is_equivalent(replace(state, exact=False), significantly_worse, 0.0, 1.0)


def test_an_entry_with_the_effects_parameters_starts_from_the_effects_values(state):
    """The screening that gave the first values knew fewer effects; a fit from there may end beside the best values."""
    far = Lead(SENSORS, ObservationDelay(0.5), promise=1.0, trial={"delay": 0.5}, change=np.zeros(1))
    state = replace(state, rivals={state.entries[0].name: [far]})
    ((_, sketch),) = _sketched_rivals(state, 0)
    assert sketch is not None
    assert sketch.effects[0].parameters["delay"].value == pytest.approx(0.013, rel=1e-4)


def test_entries_that_change_the_residual_alike_are_alternatives_whatever_they_promise(state):
    """The inertia of a body that turns about one axis is the rotor inertia of its joint, but its trials are smaller."""
    rules = state.settings.trace
    rng = np.random.default_rng(0)
    change = rng.standard_normal(50)
    own = Lead(LATE, ActionDelay(0.01), promise=0.5, trial={"delay": 0.01}, change=change)
    alike = Lead(SENSORS, ObservationDelay(0.01), promise=0.01, trial={"delay": 0.01}, change=-0.1 * change)
    others = []
    for index, promise in enumerate(np.linspace(0.9, 0.4, rules.nearest_rivals + rules.top_rivals)):
        entry = CatalogueEntry(ObservationBias(entries=(index,)), ({"bias": 1.0},))
        others.append(Lead(entry, ObservationBias(1.0), float(promise), {}, rng.standard_normal(50)))

    def tried(lead):
        return {rival.entry.name for rival in _rivals(replace(state, rivals={LATE.name: [*others, own, lead]}), 0)}

    assert SENSORS.name in tried(alike)
    assert SENSORS.name not in tried(replace(alike, change=rng.standard_normal(50)))
