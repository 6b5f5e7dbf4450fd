"""Angles counted from elsewhere, encoders that slip, and rotors that a model lacks, in logs of a motored arm."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.data.audit.recorded import XML, arm, changed, measured, recording
from torchrl_h2o.data import audit
from torchrl_h2o.effects import Armature, JointFrictionLoss
from torchrl_h2o.residuals import Simulation, StateMap


def test_zero_on_the_other_side_of_the_turn(good, simulation):
    (found,) = audit(changed(good, lambda rows: rows - np.array([np.pi, 0, 0, 0])), simulation).severe
    words = found.words
    assert re.search("if the zero of shoulder is shifted by -?3.1", words)  # both are half a turn
    assert "half a turn" in words


@pytest.mark.parametrize(("from_row", "size"), [(800, 1.2), pytest.param(1500, -0.9, marks=pytest.mark.slow)])
def test_an_encoder_that_slips_is_found_with_its_rows(good, simulation, from_row, size):
    slipped = changed(good, lambda rows: rows + size * np.outer(np.arange(len(rows)) >= from_row, [1, 0, 0, 0]))
    (found,) = audit(slipped, simulation).severe
    assert f"the zero of shoulder is shifted by {size:.1f}"[:-1] in found.words
    assert "slipped" in found.words
    assert found.rows.ranges[0][0] == pytest.approx(from_row, abs=60)


def test_rotors_that_a_model_lacks_are_no_fault_of_the_actions(simulation):
    """Without them the simulator moves several times too much, as if the actions acted 320 ms late."""
    found = audit(recording(Armature(0.05)), simulation)
    assert found.severe == found.warnings == ()
    assert any("far better with rotors on its joints" in finding.words for finding in found.findings)


@pytest.mark.parametrize("friction", [(), (JointFrictionLoss(1.0, "shoulder"), JointFrictionLoss(0.3, "elbow"))])
def test_rotors_of_sixty_times_the_inertia_of_their_links_are_no_other_run_either(simulation, friction):
    """As in the wrist of a robot arm, behind a gear of 100 : 1."""
    rng, time = np.random.default_rng(1), 0.01 * np.arange(2000)
    rates = 0.2 * np.pi * np.arange(1, 6)
    waves = np.sin(rates[:, None, None] * time[:, None] + rng.uniform(0.0, 2.0 * np.pi, (5, 1, 2)))
    action = (rng.uniform(0.3, 1.0, (5, 1, 2)) * waves).sum(0) * [40.0, 15.0]
    real = simulation.with_effects(Armature(4.7, "shoulder"), Armature(0.35, "elbow"), *friction)
    rows = np.vstack([np.zeros(4), real.rollout(np.zeros((1, 4)), action[None])[0]])
    found = audit(measured(rows, action), simulation)
    assert found.severe == ()
    assert any("far better with rotors on its joints" in finding.words for finding in found.findings)


def test_a_joint_without_a_name_gets_no_rotor():
    xml = XML.replace(' name="elbow"', "").replace('<motor name="m2" joint="elbow"/>', "")
    simulation = replace(arm(), spec=lambda: mujoco.MjSpec.from_string(xml))
    real = simulation.with_effects(Armature(0.3, "shoulder"))
    action = 0.5 * np.random.default_rng(0).standard_normal((2000, 1)).cumsum(0) / 10.0
    rows = np.vstack([np.zeros(4), real.rollout(np.zeros((1, 4)), action[None])[0]])
    assert audit(measured(rows, action), simulation).severe == ()


@pytest.mark.parametrize("begins", [1000, pytest.param(1500, marks=pytest.mark.slow)])
def test_a_force_that_begins_in_the_middle_is_no_slipped_encoder(begins):
    """A pendulum alone, whose constant force looks like another zero as long as it hardly swings."""
    xml = (
        '<mujoco><option timestep="0.005"/><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.05"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/></body></worldbody>'
        '<actuator><motor name="m" joint="hinge"/></actuator></mujoco>'
    )
    names = ("hinge", "hinge_velocity")
    state_map = StateMap.of_coordinates(names, ("rad", "rad/s"), (0, 1), num_states=2)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(xml), 2, state_map, (), "pendulum")
    rng = np.random.default_rng(0)
    action = np.zeros((2000, 1))
    for row in range(1, 2000):
        action[row] = 0.9 * action[row - 1] + 0.2 * rng.standard_normal()
    force = 1.5 * (np.arange(2000) >= begins)[:, None]
    observed = np.vstack([np.zeros(2), simulation.rollout(np.zeros((1, 2)), (action + force)[None])[0]])
    observed += 0.01 * observed.std(0) * rng.standard_normal(observed.shape)
    assert [f.words for f in audit(measured(observed, action), simulation).severe] == []
