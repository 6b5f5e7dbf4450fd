"""Effects proposed by a regression of the missing forces, and a search that begins anew with them."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import Armature, CatalogueEntry, Gravity, JointDamping, JointFrictionLoss, Payload
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.trace.begin import begin_anew, entry_of
from torchrl_h2o.residuals.trace.inverse_dynamics import propose_effects
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION, JOINTS = double_pendulum(), ("shoulder", "elbow")
FRICTION = (JointFrictionLoss(0.15, "shoulder"), JointFrictionLoss(0.08, "elbow"), JointDamping(0.1, "shoulder"))
MEASURED = recorded(SIMULATION.with_effects(*FRICTION), 3000, noise=0.002)
KINDS = (Armature, JointDamping, JointFrictionLoss, Gravity)
CATALOGUE = tuple(entry for entry in SIMULATION.catalogue() if isinstance(entry.effect, KINDS))


def test_friction_of_each_joint_is_proposed():
    proposed = {(type(effect), effect.joints): effect for effect in propose_effects(SIMULATION, MEASURED, CATALOGUE)}
    assert proposed.keys() == {(type(effect), effect.joints) for effect in FRICTION}
    for true in FRICTION:
        (name,) = true.parameters
        assert getattr(proposed[type(true), true.joints], name) == pytest.approx(getattr(true, name), rel=0.25)


def test_a_payload_is_proposed_with_its_mass():
    damped = SIMULATION.with_effects(JointDamping(1.0))
    measured = recorded(damped.with_effects(Payload(0.2, z=-0.15, bodies="lower")), 3000, noise=0.002)
    trials = ({"mass": 0.05, "x": 0.0, "z": -0.15},)
    (payload,) = propose_effects(damped, measured, [CatalogueEntry(Payload(bodies="lower"), trials)])
    assert (payload.mass, payload.z) == pytest.approx((0.2, -0.15), rel=0.05)


def test_nothing_is_proposed_for_properties_of_the_world_or_of_several_joints():
    entries = [
        CatalogueEntry(Gravity(), ({"scale": 0.8},)),
        CatalogueEntry(JointFrictionLoss(joints="*"), ({"torque": 0.1},)),
    ]
    assert propose_effects(SIMULATION, MEASURED, entries) == ()
    assert propose_effects(SIMULATION, MEASURED.part(slice(0, 100)), CATALOGUE) == ()


def begun_anew(measured, found):
    """The search that follows one which has found some effects; None if it goes on with them."""
    rng = np.random.default_rng(0)
    state = SearchState.begin(Problem.pose(SIMULATION, measured), CATALOGUE, rng)
    entries = [entry_of(effect, CATALOGUE) for effect in found]
    with LoopBar(disable=True) as bar:
        return begin_anew(state.with_found(entries, state.refitted(entries, found)), CATALOGUE, rng, bar)


def test_a_search_that_has_found_only_heavy_rotors_begins_anew_and_finds_the_friction():
    truth = (JointFrictionLoss(0.1, "shoulder"), JointDamping(1.0, "*"))
    slow = recorded(SIMULATION.with_effects(*truth), 2000, noise=0.002)
    other = begun_anew(slow, (Armature(30.0, "*"),))
    assert other is not None
    assert not any(isinstance(effect, Armature) for effect in other.fit.effects)
    model = SIMULATION.with_effects(*other.fit.effects).model
    assert model.dof_frictionloss == pytest.approx([0.1, 0.0], rel=0.15, abs=0.01)
    assert model.dof_damping == pytest.approx([1.0, 1.0], rel=0.15)


def test_a_search_that_explains_the_motion_goes_on():
    assert begun_anew(MEASURED, FRICTION) is None
    assert begun_anew(MEASURED, ()) is None


def test_a_search_for_effects_begins_anew_after_its_first_growth():
    """One effect is allowed, and the rotors from which the search begins are one."""
    truth, rotors = (JointFrictionLoss(0.1, "shoulder"), JointDamping(1.0, "*")), Armature(30.0, "*")
    slow = recorded(SIMULATION.with_effects(*truth), 700, noise=0.002)
    few = [entry_of(effect, CATALOGUE) for effect in (rotors, truth[0], *(JointDamping(1.0, j) for j in JOINTS))]
    one = replace(DEFAULTS, trace=replace(DEFAULTS.trace, max_effects=1, rounds=1))
    with LoopBar(disable=True) as bar:
        rng = np.random.default_rng(0)
        trace = trace_effects(SIMULATION, slow, few, rng=rng, progress=bar, known=[rotors], settings=one)
    assert JointFrictionLoss in map(type, trace.fit.effects)
    assert Armature not in map(type, trace.fit.effects)
