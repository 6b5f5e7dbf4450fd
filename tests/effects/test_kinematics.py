"""Jacobians and drag for many positions at once are those of MuJoCo at each position."""

import mujoco
import numpy as np
import pytest
from torchrl.envs import GymEnv

from torchrl_h2o.effects import LinearDrag, QuadraticDrag
from torchrl_h2o.effects.force.kinematics import com_jacobians
from torchrl_h2o.effects.states import States
from torchrl_h2o.envs import mujoco_model

MIXED = """
<mujoco>
  <worldbody>
    <body pos="0.1 0.2 1" euler="10 20 30">
      <joint type="slide" axis="1 1 0" ref="0.3"/>
      <joint type="hinge" axis="0 1 1" pos="0.1 0 0.2" ref="20"/>
      <geom type="capsule" fromto="0 0 0 0.3 0.1 -0.5" size="0.03"/>
      <body pos="0.3 0.1 -0.5">
        <joint type="ball" pos="0 0.05 0"/>
        <geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0.1"/>
        <body pos="0 0 -0.4" quat="0.7 0.1 0.2 0.3"><geom type="sphere" size="0.1"/></body>
      </body>
    </body>
    <body name="ball"><freejoint/><geom type="box" size="0.1 0.2 0.3" pos="0.2 0.1 0"/></body>
  </worldbody>
</mujoco>
"""


def models():
    yield pytest.param(mujoco.MjModel.from_xml_string(MIXED), id="all kinds of joints")
    for task in ("HalfCheetah-v5", "Ant-v5", "Humanoid-v5"):
        yield pytest.param(mujoco_model(GymEnv(task)), id=task)


def random_states(model, count=5):
    rng = np.random.default_rng(0)
    qpos = model.qpos0 + rng.normal(0.0, 0.7, (count, model.nq))  # quaternions are not of unit length
    return qpos, rng.normal(0.0, 2.0, (count, model.nv))


@pytest.mark.parametrize("model", models())
def test_jacobians_are_those_of_mujoco(model):
    qpos, _ = random_states(model)
    bodies = list(range(model.nbody))[::-1]
    together = com_jacobians(model, bodies)(qpos)
    data, one = mujoco.MjData(model), np.zeros((3, model.nv))
    for position, jacobians in zip(qpos, together, strict=True):
        data.qpos = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for body, jacobian in zip(bodies, jacobians, strict=True):
            mujoco.mj_jacBodyCom(model, data, one, None, body)
            np.testing.assert_allclose(jacobian, one, atol=1e-12)


@pytest.mark.parametrize("effect", [LinearDrag(0.4), QuadraticDrag(0.3)])
@pytest.mark.parametrize("model", models())
def test_drag_of_many_states_is_that_of_each(model, effect):
    qpos, qvel = random_states(model)
    together = effect.batched(model)(States(qpos, qvel, np.zeros((5, 0)), np.zeros((5, model.nu)), np.zeros(5)))
    force, data = effect.process(model, np.random.default_rng(0)), mujoco.MjData(model)
    for position, velocity, own in zip(qpos, qvel, together, strict=True):
        data.qpos, data.qvel = position, velocity
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        np.testing.assert_allclose(own, force(data), rtol=1e-9, atol=1e-9)
