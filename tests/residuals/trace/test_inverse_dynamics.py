"""Effects proposed by a regression of the missing forces, and a search that begins anew with them."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import DOUBLE, double_pendulum, recorded
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    Armature,
    BodyMass,
    CatalogueEntry,
    Gravity,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    ObservationDelay,
    Payload,
)
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.residuals import Split, StateMap, trace_effects
from torchrl_h2o.residuals.measured.missing_force import measured_motion
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.settings import LoopSettings
from torchrl_h2o.residuals.trace.begin import begin_anew, begin_with_forces, replaced_by_forces
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.inverse_dynamics import propose_effects
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import is_possible
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION, JOINTS = double_pendulum(), ("shoulder", "elbow")
FRICTION = (JointFrictionLoss(0.15, "shoulder"), JointFrictionLoss(0.08, "elbow"), JointDamping(0.1, "shoulder"))
MEASURED = recorded(SIMULATION.with_effects(*FRICTION), 2000, noise=0.002)
KINDS = (Armature, JointDamping, JointFrictionLoss, Gravity)
CATALOGUE = tuple(entry for entry in SIMULATION.catalogue() if isinstance(entry.effect, KINDS))


def with_light_lower_link(mass):
    """The double pendulum with another mass of the lower link."""
    upper, lower = DOUBLE.split('<body name="lower"')
    return f'{upper}<body name="lower"' + lower.replace('mass="0.5"', f'mass="{mass}"')


def test_friction_of_each_joint_is_proposed():
    """With windows in which joints rest or turn around, friction would come out 4 % too low."""
    found = propose_effects(SIMULATION, MEASURED, CATALOGUE)
    proposed = {(type(effect), effect.joints): effect for effect in found.effects}
    assert proposed.keys() == {(type(effect), effect.joints) for effect in FRICTION}
    for true in FRICTION:
        (name,) = true.parameters
        assert getattr(proposed[type(true), true.joints], name) == pytest.approx(getattr(true, name), rel=0.02)


@pytest.mark.slow
def test_friction_is_proposed_as_it_acts_in_the_simulator():
    """There it is softer where torques jump, so a regression that takes it for dry finds 0.11 N·m."""
    measured = recorded(SIMULATION.with_effects(JointFrictionLoss(0.15, "elbow")), 2000, noise=0.001, smooth=0.0)
    (friction,) = propose_effects(SIMULATION, measured, CATALOGUE).effects
    assert isinstance(friction, JointFrictionLoss)
    assert friction.torque == pytest.approx(0.15, rel=0.05)


def test_a_payload_is_proposed_with_its_mass():
    damped = SIMULATION.with_effects(JointDamping(1.0))
    measured = recorded(damped.with_effects(Payload(0.2, z=-0.15, bodies="lower")), 2000, noise=0.002)
    trials = ({"mass": 0.05, "x": 0.0, "z": -0.15},)
    (payload,) = propose_effects(damped, measured, [CatalogueEntry(Payload(bodies="lower"), trials)]).effects
    assert (payload.mass, payload.z) == pytest.approx((0.2, -0.15), rel=0.05)


def test_nothing_is_proposed_for_properties_of_the_world_or_of_several_joints():
    entries = [
        CatalogueEntry(Gravity(), ({"scale": 0.8},)),
        CatalogueEntry(JointFrictionLoss(joints="*"), ({"torque": 0.1},)),
    ]
    assert propose_effects(SIMULATION, MEASURED, entries).entries == ()
    assert propose_effects(SIMULATION, MEASURED.part(slice(0, 100)), CATALOGUE).entries == ()


def begun_anew(measured, found, begin=begin_anew, catalogue=CATALOGUE):
    """The search that follows one which has found some effects; None if it goes on with them."""
    rng = np.random.default_rng(0)
    state = SearchState.begin(Problem.pose(SIMULATION, measured), catalogue, rng)
    entries = [entry_of(effect, catalogue) for effect in found]
    with LoopBar(disable=True) as bar:
        return begin(state.with_found(entries, state.refitted(entries, found)), catalogue, rng, bar)


@pytest.mark.slow
def test_a_search_that_has_found_only_heavy_rotors_begins_anew_and_finds_the_friction():
    truth = (JointFrictionLoss(0.1, "shoulder"), JointDamping(1.0, "*"))
    slow = recorded(SIMULATION.with_effects(*truth), 2000, noise=0.002)
    other = begun_anew(slow, (Armature(30.0, "*"),))
    assert other is not None
    model = SIMULATION.with_effects(*other.fit.effects).model
    assert (model.dof_armature < 0.2 * SIMULATION.model.dof_M0).all()
    assert model.dof_frictionloss == pytest.approx([0.1, 0.0], rel=0.15, abs=0.01)
    assert model.dof_damping == pytest.approx([1.0, 1.0], rel=0.15)


@pytest.mark.slow
def test_a_search_begins_again_with_the_effects_that_the_forces_need_together():
    truth = (*FRICTION, BodyMass(1.4, "lower"))
    measured = recorded(SIMULATION.with_effects(*truth), 2000, noise=0.002)
    catalogue = [entry for entry in SIMULATION.catalogue() if isinstance(entry.effect, (*KINDS, BodyMass))]
    for found in [(), (BodyMass(1.7, "lower"), JointFrictionLoss(0.1, "*"))]:
        other = begun_anew(measured, found, begin_with_forces, catalogue)
        assert other is not None
        assert {(type(one), getattr(one, "joints", "")) for one in other.fit.effects} == {
            (type(one), getattr(one, "joints", "")) for one in truth
        }
        (mass,) = (one for one in other.fit.effects if isinstance(one, BodyMass))
        assert mass.scale == pytest.approx(1.4, rel=0.05)
        assert other.rivals.keys() == {entry.name for entry in other.entries}


@pytest.mark.slow
def test_a_search_that_has_found_what_the_forces_need_goes_on():
    assert begun_anew(MEASURED, FRICTION, begin_with_forces) is None


@pytest.mark.slow
def test_a_search_that_explains_the_motion_goes_on():
    assert begun_anew(MEASURED, FRICTION) is None
    assert begun_anew(MEASURED, ()) is None


@pytest.mark.slow
def test_a_search_for_effects_begins_anew_after_its_first_growth():
    """One effect is allowed, and the rotors from which the search begins are one."""
    truth, rotors = (JointFrictionLoss(0.1, "shoulder"), JointDamping(1.0, "*")), Armature(30.0, "*")
    slow = recorded(SIMULATION.with_effects(*truth), 700, noise=0.002)
    few = [entry_of(effect, CATALOGUE) for effect in (rotors, truth[0], *(JointDamping(1.0, j) for j in JOINTS))]
    one = LoopSettings(max_effects=1, rounds=1)
    with LoopBar(disable=True) as bar:
        rng = np.random.default_rng(0)
        trace = trace_effects(SIMULATION, slow, few, rng=rng, progress=bar, known=[rotors], settings=one)
    assert JointFrictionLoss in map(type, trace.fit.effects)
    assert Armature not in map(type, trace.fit.effects)


@pytest.mark.slow
def test_friction_that_the_model_has_can_be_reduced_and_a_rotor_that_it_lacks_cannot():
    """Without these bounds, the missing gravity and the light link would make the rotor's inertia negative."""
    rough, smooth = (SIMULATION.with_effects(JointDamping(damping, "*")) for damping in (0.8, 0.5))
    found = propose_effects(rough, recorded(smooth, 2000, noise=0.002), CATALOGUE)
    model = rough.with_effects(*found.effects).model
    assert model.dof_damping == pytest.approx([0.5, 0.5], rel=0.02)
    assert (model.dof_armature < 0.05 * model.dof_M0).all()
    light = (JointDamping(0.3, "*"), BodyMass(0.6, "lower"), Gravity(1.3))
    found = propose_effects(SIMULATION, recorded(SIMULATION.with_effects(*light), 2000, noise=0.002), CATALOGUE)
    assert found.entries
    assert is_possible(Problem.pose(SIMULATION, MEASURED), found.effects)


def test_nothing_is_proposed_for_an_equal_simulator():
    (elbow,) = (entry for entry in SIMULATION.catalogue() if entry.effect == JointForce(0.0, "elbow"))
    assert propose_effects(SIMULATION, recorded(SIMULATION, 2000, noise=0.002), [elbow]).entries == ()


def test_windows_do_not_cross_runs_nor_reach_unknown_states():
    runs = replace(MEASURED, run=np.arange(2000) // 30)
    motion = measured_motion(SIMULATION, runs, Split.FIT)
    assert motion is not None
    run = np.rint(motion.time / SIMULATION.control_step).astype(int) // 30
    assert (run[:, 0] == run[:, -1]).all()
    late = SIMULATION.with_effects(ObservationDelay(0.02, (2, 3)))
    assert propose_effects(late, runs, CATALOGUE).entries


def test_nothing_is_proposed_if_a_coordinate_is_not_observed_or_actuators_have_a_state():
    slow = recorded(SIMULATION.with_effects(JointDamping(1.0, "*")), 2000, noise=0.002)
    assert propose_effects(SIMULATION, slow, CATALOGUE).entries
    without_shoulder = StateMap.of_coordinates(("e", "v", "w"), ("rad", "rad/s", "rad/s"), (1, 2, 3), num_states=4)
    blind = replace(SIMULATION, state_map=without_shoulder)
    columns = {name: getattr(slow, name)[:, 1:] for name in ("observation", "following")}
    assert propose_effects(blind, replace(slow, **columns), CATALOGUE).entries == ()
    filtered = DOUBLE.replace("<motor ", '<general dyntype="filter" dynprm="0.01" ')
    slow_motors = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(filtered))
    assert propose_effects(slow_motors, slow, slow_motors.catalogue()).entries == ()


def with_noisy_torques(measured, std=0.15, seed=0):
    """The data with noise on the measured torques, N·m, which did not move the joints."""
    return replace(
        measured, action=measured.action + std * np.random.default_rng(seed).normal(size=measured.action.shape)
    )


def by_forces(measured, found):
    """What the forces say after a search that has found some effects; None if these stand."""
    rng = np.random.default_rng(0)
    state = SearchState.begin(Problem.pose(SIMULATION, measured), CATALOGUE, rng)
    entries = [entry_of(effect, CATALOGUE) for effect in found]
    none = tuple({} for _ in found)
    state = state.with_found(entries, Fit(tuple(found), tuple(() for _ in found), 0.0, none))
    with LoopBar(disable=True) as bar:
        return replaced_by_forces(state, CATALOGUE, rng, bar)


def test_effects_that_contradict_noisy_torques_give_way_to_the_friction():
    noisy = with_noisy_torques(MEASURED)
    other = by_forces(noisy, (Armature(0.5, "*"),))
    assert other is not None
    model = SIMULATION.with_effects(*other.fit.effects).model
    assert model.dof_frictionloss == pytest.approx([0.15, 0.08], rel=0.25)
    assert (model.dof_armature < 0.1 * SIMULATION.model.dof_M0).all()
    assert [set(widths) for widths in other.fit.half_widths] == [set(free) for free in other.fit.free]
    assert all(0.0 < width < 0.1 for widths in other.fit.half_widths for width in widths.values())


@pytest.mark.slow
def test_friction_of_which_the_forces_need_far_less_at_one_joint_gives_way():
    """It lowers the missing forces of both joints, and predicts their motion."""
    noisy = with_noisy_torques(MEASURED, 0.02)
    found = (JointFrictionLoss(0.15, "shoulder"), JointDamping(0.1, "shoulder"), JointFrictionLoss(0.14, "elbow"))
    other = by_forces(noisy, found)
    assert other is not None
    model = SIMULATION.with_effects(*other.fit.effects).model
    assert model.dof_frictionloss == pytest.approx([0.15, 0.08], rel=0.1)


@pytest.mark.slow
def test_effects_that_stand_the_test_are_kept():
    assert by_forces(MEASURED, FRICTION) is None
    assert by_forces(with_noisy_torques(MEASURED, 0.02), FRICTION) is None
    assert by_forces(MEASURED, ()) is None


def test_effects_that_leave_only_the_error_of_means_over_windows_are_kept():
    """Without noise, small effects of the kinds that a regression knows would make up for that error."""
    truth = (Gravity(0.8), JointDamping(0.3, "*"))
    measured = recorded(SIMULATION.with_effects(*truth), 2000)
    assert by_forces(measured, truth) is None


@pytest.mark.slow
def test_friction_that_the_data_do_not_have_is_taken_away():
    """Less than none is impossible, so a step that shows how the force changes must lead back from there."""
    rough = SIMULATION.with_effects(JointFrictionLoss(0.05, "shoulder"))
    truth = (JointDamping(0.3, "shoulder"), JointFrictionLoss(0.15, "elbow"))
    found = propose_effects(rough, recorded(SIMULATION.with_effects(*truth), 2000, noise=0.001), CATALOGUE)
    mended = rough.with_effects(*found.effects).model
    assert mended.dof_frictionloss == pytest.approx([0.0, 0.15], abs=0.003)
    assert mended.dof_damping == pytest.approx([0.3, 0.0], abs=0.01)


@pytest.mark.slow
def test_nothing_replaces_a_wrong_effect_if_no_force_is_missing():
    """Noisy torques alone must not make an effect."""
    assert by_forces(with_noisy_torques(recorded(SIMULATION, 2000, noise=0.002)), (Armature(0.5, "*"),)) is None


@pytest.mark.slow
def test_intervals_cover_the_true_friction():
    strong = DOUBLE.replace("0.6 0.6", "2 2").replace("0.3 0.3", "2 2")  # noise beyond a motor's limit would be cut
    simulation = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(strong))
    found = propose_effects(simulation, with_noisy_torques(MEASURED), CATALOGUE)
    index = next(i for i, effect in enumerate(found.effects) if getattr(effect, "joints", "") == "elbow")
    assert isinstance(found.effects[index], JointFrictionLoss)
    assert abs(found.effects[index].torque - 0.08) < 2.0 * found.half_widths[index]["torque"]


@pytest.mark.slow
def test_what_the_model_has_too_much_is_taken_away_to_the_last_digit():
    """A sum that is negative by rounding, as it is with 0.013, would be refused by the model."""
    heavy = SIMULATION.with_effects(Armature(0.013, "*"), JointDamping(0.3, "*"))
    found = propose_effects(heavy, MEASURED, CATALOGUE)
    assert Armature in map(type, found.effects)
    assert is_possible(Problem.pose(heavy, MEASURED), found.effects)
    model = heavy.with_effects(*found.effects).model
    assert (model.dof_armature < 0.05 * SIMULATION.model.dof_M0).all()
    assert model.dof_frictionloss == pytest.approx([0.15, 0.08], rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("other", [ActionGain(0.7), ActionDelay(0.02)])
def test_effects_that_no_regression_proposes_stay_beside_the_friction(other):
    """Without the gain, masses × 1.4 would explain the forces as well."""
    noisy = with_noisy_torques(recorded(SIMULATION.with_effects(*FRICTION, other), 2000, noise=0.002))
    found = by_forces(noisy, (Armature(0.5, "*"), other))
    assert found is not None
    assert found.fit.effects[0] == other
    model = SIMULATION.with_effects(*found.fit.effects).model
    assert model.dof_frictionloss == pytest.approx([0.15, 0.08], rel=0.25)


@pytest.mark.slow
def test_friction_of_a_light_link_is_dry_beside_its_rotor():
    """The solver softens friction of 0.1 N·m on a link of 0.5 g to a viscous one; with its rotor it is dry."""
    simulation = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(with_light_lower_link(0.0005)))
    true = (Armature(0.05, "elbow"), JointDamping(0.02, "elbow"), JointFrictionLoss(0.1, "elbow"))
    measured = recorded(simulation.with_effects(*true), 2000, noise=0.001)
    catalogue = [entry for entry in simulation.catalogue() if isinstance(entry.effect, KINDS)]
    proposed = {type(effect): effect for effect in propose_effects(simulation, measured, catalogue).effects}
    for effect in true:
        (name,) = effect.parameters
        assert getattr(proposed[type(effect)], name) == pytest.approx(getattr(effect, name), rel=0.05)


def without_motor(joint: str):
    """The double pendulum with one motor."""
    xml = re.sub(f'<motor joint="{joint}".*?/>', "", DOUBLE)
    simulation = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(xml))
    assert simulation.model.nu == 1
    return simulation


@pytest.mark.slow
def test_noise_does_not_make_a_link_light_that_no_actuator_moves():
    """Without a mass, no force is missing at the elbow, whatever the noise; earlier, × 0.01 was proposed."""
    simulation = without_motor("elbow")
    measured = recorded(simulation.with_effects(JointDamping(0.3, "shoulder")), 2000, noise=0.02)
    kinds = (BodyMass, JointDamping, JointFrictionLoss)
    catalogue = [entry for entry in simulation.catalogue() if isinstance(entry.effect, kinds)]
    (found,) = propose_effects(simulation, measured, catalogue).effects
    assert (found.joints, found.damping) == ("shoulder", pytest.approx(0.3, rel=0.02))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("without", "moved", "body", "scale"),
    [
        ("shoulder", "elbow", "upper", 1.6),
        ("elbow", "shoulder", "lower", 1.6),
    ],
)
def test_masses_are_found_with_one_motor(without, moved, body, scale):
    """Of an acrobot, the upper link's mass shows at the shoulder alone, which no actuator moves."""
    simulation, damping = without_motor(without), JointDamping(0.1, moved)
    measured = recorded(simulation.with_effects(BodyMass(scale, body), damping), 2000, noise=0.002)
    found = {type(effect): effect for effect in propose_effects(simulation, measured, simulation.catalogue()).effects}
    assert found.keys() == {BodyMass, JointDamping}
    assert (found[BodyMass].bodies, found[BodyMass].scale) == (body, pytest.approx(scale, rel=0.02))


@pytest.mark.parametrize(("true", "kind"), [(Payload(0.4, bodies="cart"), Armature), (BodyMass(0.5, "cart"), BodyMass)])
def test_of_effects_that_are_the_same_the_simplest_is_proposed(true, kind):
    """On a rail, a rotor, the cart's mass and a payload are the same, but a rotor cannot take mass away."""
    xml = """
    <mujoco><option timestep="0.005"/><worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>
    <geom size="0.1" mass="0.8"/></body></worldbody><actuator><motor joint="rail"/></actuator></mujoco>
    """
    state_map = StateMap.of_coordinates(("rail", "rail_velocity"), ("m", "m/s"), (0, 1), num_states=2)
    simulation = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(xml), state_map=state_map)
    measured = recorded(simulation.with_effects(true, JointDamping(0.3, "rail")), 2000, noise=0.001)
    found = propose_effects(simulation, measured, simulation.catalogue()).effects
    assert {type(effect) for effect in found} == {kind, JointDamping}
