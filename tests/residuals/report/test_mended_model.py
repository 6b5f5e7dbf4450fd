"""mended.xml: a simulation of the file with the effects that it lacks predicts what the mended simulation does."""

import mujoco
import numpy as np
import pytest
from torchrl.envs import GymEnv

from tests.residuals.pendulum import UnknownForce, pendulum
from torchrl_h2o.effects import (
    ActionBias,
    ActionDelay,
    ActionGain,
    ActionLag,
    ActionNoise,
    BodyCentreOfMass,
    BodyInertia,
    BodyMass,
    ContactSoftness,
    GeomFriction,
    GeomLength,
    Gravity,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    JointRange,
    JointRest,
    JointStiffness,
    ObservationBias,
    Payload,
    ResidualForce,
    RollingResistance,
    Timestep,
)
from torchrl_h2o.envs import WheelLeggedEnv, mujoco_model
from torchrl_h2o.residuals import Simulation
from torchrl_h2o.residuals.report.mended_model import save_mended_model

RIPPLE = ResidualForce(("torque on elbow: 0.41 · sin(7 q)",))
CASES = {
    "pendulum, gain and offset": (pendulum, [JointDamping(0.2), BodyMass(1.3), ActionGain(0.7), ActionBias(0.1)], 0),
    "pendulum, delay and force": (pendulum, [ActionGain(1.7), ActionDelay(0.013), JointFrictionLoss(0.1), RIPPLE], 2),
    "HalfCheetah, joints and actuators": (
        lambda: Simulation.from_env(GymEnv("HalfCheetah-v5")),
        [
            Gravity(1.2),
            JointStiffness(0.8, "*thigh*"),
            JointRest(0.1, "bthigh"),
            JointRange(0.8, "*thigh*"),
            ActionBias(0.2, (1,)),
            ActionGain(1.4, (0, 1)),
            ActionLag(0.02),
            JointForce(3.0, "rootx"),
        ],
        3,  # the offset comes before a lag
    ),
    "HalfCheetah, bodies and geoms": (
        lambda: Simulation.from_env(GymEnv("HalfCheetah-v5")),
        [
            GeomLength(1.1, "torso"),
            GeomFriction(0.5),
            ContactSoftness(1.5),
            BodyMass(1.3, "torso"),
            Timestep(1.1),
            BodyInertia(1.2, "torso"),
            Payload(1.0, x=0.1, bodies="torso"),
        ],
        0,
    ),
    "wheel-legged robot": (
        lambda: Simulation.from_env(WheelLeggedEnv()).with_effects(Gravity(1.1)),
        [
            JointDamping(0.01, "axle"),
            JointFrictionLoss(0.02, "axle"),
            BodyCentreOfMass(0.01, 0.02, bodies="torso"),
            RollingResistance(0.001, "*wheel*"),
            ActionGain(0.8),
            ActionDelay(0.006),
            ObservationBias(0.01, (0,)),
        ],
        2,
    ),
}


def one_step(simulation, count=300):
    """Observations after one step from random states under random actions within the control ranges."""
    rng, model = np.random.default_rng(0), simulation.model
    state_map = simulation.state_map
    states = state_map.offset + 0.3 * rng.standard_normal((count, len(state_map.offset)))
    actions = rng.uniform(*model.actuator_ctrlrange.T, (count, model.nu))
    executed = simulation.executed(actions)[:, None]
    return simulation.observed(simulation.rollout(states, executed))[:, 0]


@pytest.mark.parametrize("case", CASES)
def test_the_file_predicts_what_the_mended_simulation_does(case, tmp_path):
    make, effects, num_left = CASES[case]
    simulation = make()
    mended = save_mended_model(simulation, effects, tmp_path)
    assert (mended.file, len(mended.left_out)) == ("mended.xml", num_left)
    of_file = Simulation(
        lambda: mujoco.MjSpec.from_file(str(tmp_path / mended.file)),
        simulation.frame_skip,
        simulation.state_map,
        mended.effects,
    )
    expected, before = one_step(simulation.with_effects(*effects)), one_step(simulation)
    np.testing.assert_allclose(one_step(of_file), expected, rtol=0.0, atol=1e-10)
    assert np.nanmax(np.abs(expected - before)) > 0.1


def test_a_simulation_draws_no_textures_and_the_file_has_those_of_the_model(tmp_path):
    simulation = Simulation.from_env(GymEnv("HalfCheetah-v5"))
    assert simulation.model.ntexdata < 100
    save_mended_model(simulation, [Gravity(1.2)], tmp_path)
    drawn = mujoco.MjModel.from_xml_path(str(tmp_path / "mended.xml"))
    assert drawn.ntexdata == mujoco_model(GymEnv("HalfCheetah-v5")).ntexdata > 1e5


def test_what_is_left_out_is_described_with_the_units_of_the_joint(tmp_path):
    simulation = Simulation.from_env(GymEnv("HalfCheetah-v5"))
    mended = save_mended_model(simulation, [JointForce(6.72, "rootx"), ActionNoise(0.1, (0,))], tmp_path)
    words = [left.words for left in mended.left_out]
    assert words[0] == "constant force of 6.72 N on joints rootx"
    assert "actuators" in words[1]
    assert all(left.reason for left in mended.left_out)


def test_a_model_that_cannot_be_written_is_no_failure_of_the_report(tmp_path):
    gone = Simulation(pendulum().spec, 2, pendulum().state_map)
    mended = save_mended_model(gone, [JointDamping(0.1, "wrist")], tmp_path)
    assert mended.file is None
    assert "wrist" in mended.failure
    assert mended.effects == (JointDamping(0.1, "wrist"),)
    assert not (tmp_path / "mended.xml").exists()


def test_an_effect_of_ones_own_is_left_out(tmp_path):
    own = UnknownForce(0.3, lambda q, v, t: q**2)
    assert save_mended_model(pendulum(), [ActionGain(0.7), own], tmp_path).effects == (ActionGain(0.7), own)
