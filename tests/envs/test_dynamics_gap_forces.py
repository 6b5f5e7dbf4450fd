"""Forces of DynamicsGap, on a user-defined task with its own MJCF."""

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box
from torchrl.envs import Compose, GymWrapper, TransformedEnv

from tests.effects.models import CART
from tests.envs.own_effects import ControlForce, Gust
from torchrl_h2o.effects import BodyMass, JointForce, LinearDrag
from torchrl_h2o.envs import DynamicsGap, mujoco_model


class Cart(MujocoEnv):
    """A user-defined task with its own MJCF; observes x and its velocity."""

    metadata = {"render_modes": [], "render_fps": 100}  # noqa: RUF012

    def __init__(self, path: str):
        super().__init__(path, 5, Box(-np.inf, np.inf, (4,), np.float64))
        self.init_qpos[:] = (0.25, 0.0)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self.state_vector(), 0.0, False, False, {}

    def reset_model(self):
        self.set_state(self.init_qpos, self.init_qvel)
        return self.state_vector()


CART_XML = CART.replace("<worldbody>", '<option timestep=".002" gravity="0 0 0"/><worldbody>')
CART_XML = CART_XML.replace(
    "</mujoco>",
    '<actuator><motor joint="slider" ctrlrange="-1 1"/></actuator></mujoco>',
)


@pytest.fixture
def cart(tmp_path) -> GymWrapper:
    path = tmp_path / "cart.xml"
    path.write_text(CART_XML)
    return GymWrapper(Cart(str(path)))


def stepped_cart(force: Callable[[float], float], start: float) -> tuple[float, float]:
    """Returns x and v after one action of zero, with the force on the slider set at every physics step."""
    model = mujoco.MjModel.from_xml_string(CART_XML)
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 0.25, start
    for _ in range(5):
        data.qfrc_applied[0] = force(data.qvel[0])
        mujoco.mj_step(model, data)
    return data.qpos[0], data.qvel[0]


@pytest.mark.parametrize(
    ("effects", "force"),
    [
        ([JointForce(2.0, "slider"), JointForce(1.0, "slider")], lambda v: 3.0),
        ([LinearDrag(60.0, "cart")], lambda v: -60.0 * v),
        ([LinearDrag(60.0, "cart"), JointForce(2.0, "slider")], lambda v: 2.0 - 60.0 * v),
    ],
)
def test_forces_are_summed_anew_at_every_physics_step(cart, effects, force):
    env = TransformedEnv(cart, Compose(*map(DynamicsGap, effects)))
    reset = env.reset()
    cart._env.unwrapped.data.qvel[0] = 1.0
    state = env.step(reset.set("action", torch.zeros(1)))["next", "observation"]
    assert (state[0].item(), state[2].item()) == pytest.approx(stepped_cart(force, 1.0), rel=1e-12)


def test_a_force_sees_the_bodies_where_they_are(cart):
    effect = LinearDrag(20.0, "pole")
    env = TransformedEnv(cart, DynamicsGap(effect))
    reset = env.reset()
    cart._env.unwrapped.data.qvel[:] = 1.0, 20.0  # the pole turns by 0.2 rad per action
    state = env.step(reset.set("action", torch.zeros(1)))["next", "observation"]
    model = mujoco.MjModel.from_xml_string(CART_XML)
    data, current = mujoco.MjData(model), mujoco.MjData(model)
    drag = effect.process(model, np.random.default_rng(0))
    data.qpos[0], data.qvel[:] = 0.25, (1.0, 20.0)
    for _ in range(5):
        current.qpos[:], current.qvel[:] = data.qpos, data.qvel
        mujoco.mj_forward(model, current)
        data.qfrc_applied[:] = drag(current)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(state, [*data.qpos, *data.qvel], rtol=1e-12)


def test_a_force_sees_the_control_of_its_own_step(cart):
    env = TransformedEnv(cart, DynamicsGap(ControlForce(2.0)))
    doubled = env.step(env.reset().set("action", torch.ones(1)))["next", "observation"]
    expected = stepped_cart(lambda v: 1.0 + 2.0, 0.0)  # the motor's 1 N and the force
    assert (doubled[0].item(), doubled[2].item()) == pytest.approx(expected, rel=1e-12)


def test_a_force_is_made_anew_at_every_reset_and_lasts_for_the_episode(cart):
    log = []
    env = TransformedEnv(cart, DynamicsGap(Gust(1.0, seen=(log,))))
    log.clear()  # removes the entries of the trial episode
    torch.manual_seed(0)
    env.rollout(2)
    first = log.copy()
    assert [calls for _, calls in first] == list(range(1, 11))
    assert len({gust for gust, _ in first}) == 1
    log.clear()
    env.rollout(2)
    assert log[0][1] == 1
    assert log[0][0] != first[0][0]
    log.clear()
    torch.manual_seed(0)
    env.rollout(2)
    assert log == first


def test_a_task_of_ones_own_keeps_its_start(cart):
    env = TransformedEnv(cart, DynamicsGap(BodyMass(2.0, bodies="pole")))
    assert env.reset()["observation"][0] == 0.25
    assert mujoco_model(env).body("pole").mass == pytest.approx(1.0)


def test_the_file_of_the_model_is_not_written(cart, tmp_path):
    TransformedEnv(cart, DynamicsGap(BodyMass(2.0))).rollout(2)
    assert (tmp_path / "cart.xml").read_text() == CART_XML
    assert [path.name for path in tmp_path.iterdir()] == ["cart.xml"]
