"""DynamicsGap on single environments: what it changes, what it leaves, when it complains."""

import copy
import pickle
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, GymEnv, GymWrapper, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.effects.models import CART, as_bytes
from torchrl_h2o.effects import (
    PAPER_GAPS,
    ActionDelay,
    ActionGain,
    ActionNoise,
    Armature,
    BodyMass,
    Effect,
    GeomSize,
    Gravity,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    LinearDrag,
    ObservationBias,
    ObservationNoise,
)
from torchrl_h2o.envs import DynamicsGap, dynamics_gap, mujoco_model

CHEETAH = "HalfCheetah-v5"
NEUTRAL = [
    Gravity(),
    GeomSize(),
    BodyMass(),
    Armature(),
    JointDamping(),
    JointFrictionLoss(),
    ActionNoise(),
    ActionDelay(),
    ActionGain(),
    JointForce(),
    LinearDrag(),
    ObservationNoise(),
    ObservationBias(),
]


def gapped(*effects: Effect, task: str = CHEETAH) -> TransformedEnv:
    return TransformedEnv(GymEnv(task), DynamicsGap(*effects))


def rollout(env: EnvBase, steps: int = 10, seed: int = 0) -> TensorDict:
    torch.manual_seed(seed)
    env.set_seed(seed)
    env.set_seed(seed)  # Gymnasium tasks draw their first state from the seed of the last reset
    return env.rollout(steps, break_when_any_done=False)


def test_the_model_is_changed_when_the_gap_is_put_on():
    env = gapped(Gravity(2.0))
    assert mujoco_model(env).opt.gravity[2] == -19.62
    assert mujoco_model(env) is env.base_env._env.unwrapped.model
    appended = TransformedEnv(GymEnv(CHEETAH)).append_transform(DynamicsGap(Gravity(3.0)))
    assert mujoco_model(appended).opt.gravity[2] == pytest.approx(-29.43)


def test_a_reset_does_not_compile_the_model_again():
    env = gapped(Gravity(2.0))
    model = mujoco_model(env)
    env.reset()
    assert mujoco_model(env) is model


def test_the_simulator_steps_with_the_changed_model():
    heavy, light = rollout(gapped(Gravity(2.0))), rollout(GymEnv(CHEETAH))
    torch.testing.assert_close(heavy["observation"][0], light["observation"][0])
    torch.testing.assert_close(heavy["action"], light["action"])
    assert (heavy["next", "observation"] - light["next", "observation"]).abs().max() > 0.1


@settings(max_examples=10, deadline=None)
@example(effects=NEUTRAL, seed=0)
@given(effects=st.lists(st.sampled_from(NEUTRAL), max_size=5), seed=st.integers(0, 2**16))
def test_neutral_effects_leave_every_bit_of_a_rollout(effects, seed):
    expected, actual = rollout(GymEnv(CHEETAH), seed=seed), rollout(gapped(*effects), seed=seed)
    assert (expected == actual).all()


def test_two_envs_in_one_process_do_not_touch_each_other():
    untouched, expected = GymEnv(CHEETAH), rollout(GymEnv(CHEETAH))
    model = as_bytes(mujoco_model(untouched))
    heavy, light = gapped(Gravity(2.0), JointForce(5.0)), gapped(Gravity(0.5))
    rollout(heavy)
    rollout(light)
    assert as_bytes(mujoco_model(untouched)) == model
    assert (rollout(untouched) == expected).all()
    assert (rollout(GymEnv(CHEETAH)) == expected).all()
    assert [mujoco_model(env).opt.gravity[2] for env in (heavy, light)] == [-19.62, -4.905]


@pytest.mark.parametrize(("task", "name"), [(task, name) for name, gap in PAPER_GAPS.items() for task in gap.tasks])
def test_specs_hold_with_every_gap_of_the_paper(task, name):
    check_env_specs(TransformedEnv(GymEnv(f"{task}-v5"), dynamics_gap(name)))


@pytest.mark.parametrize("task", ["Hopper-v5", "Ant-v5"])
@pytest.mark.parametrize("name", ["gravity", "friction", "joint_noise"])
def test_specs_hold_on_other_tasks_that_have_the_effect(task, name):
    check_env_specs(TransformedEnv(GymEnv(task), dynamics_gap(name)))


# ------------------------------------------------------------------------------ composition
def test_gaps_compose_and_are_counted_once():
    both = TransformedEnv(
        GymEnv(CHEETAH),
        Compose(DynamicsGap(Gravity(2.0)), StepCounter(), DynamicsGap(Gravity(1.5))),
    )
    assert mujoco_model(both).opt.gravity[2] == pytest.approx(3 * -9.81)
    both.rollout(2)  # StepCounter builds envs of clones of the gaps above it
    wrapped = TransformedEnv(both, StepCounter(step_count_key="again"), auto_unwrap=True)
    wrapped.rollout(2)
    nested = TransformedEnv(wrapped, DynamicsGap(Gravity(0.5)), auto_unwrap=False)
    nested.rollout(2)
    assert mujoco_model(nested).opt.gravity[2] == pytest.approx(1.5 * -9.81)


def test_a_gap_and_its_clone_on_one_env_are_refused():
    gap = DynamicsGap(Gravity(2.0))
    env = TransformedEnv(GymEnv(CHEETAH), Compose(gap, gap.clone()))
    with pytest.raises(ValueError, match="make a second DynamicsGap"):
        env.reset()
    assert mujoco_model(TransformedEnv(GymEnv(CHEETAH), gap.clone())).opt.gravity[2] == -19.62


def test_a_gap_is_picklable_before_it_is_put_on():
    gap = pickle.loads(pickle.dumps(DynamicsGap(Gravity(2.0), ActionDelay(0.05))))
    env = TransformedEnv(GymEnv(CHEETAH), gap)
    env.rollout(2)
    assert mujoco_model(env).opt.gravity[2] == -19.62


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copied_env_keeps_its_gaps(duplicate):
    env = gapped(Gravity(2.0), JointForce(5.0), ActionDelay(0.02))
    env.append_transform(DynamicsGap(Gravity(1.5)))
    env.rollout(2)
    twin = duplicate(env)
    assert (rollout(twin) == rollout(env)).all()
    assert mujoco_model(twin).opt.gravity[2] == pytest.approx(3 * -9.81)
    assert mujoco_model(twin) is not mujoco_model(env)


def test_a_gap_in_a_replay_buffer_alters_nothing():
    gap = DynamicsGap(ActionNoise(1.0), ObservationNoise(1.0))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4), transform=gap, batch_size=4)
    data = TensorDict({"action": torch.ones(4, 2), "observation": torch.ones(4, 3)}, [4])
    buffer.extend(data)
    assert (buffer.sample().select("action", "observation") == 1).all()


# ------------------------------------------------------------- actions and observations
class Executed(GymEnv):
    """Remembers the actions that reach the simulator."""

    def read_action(self, action):
        self.executed = [*getattr(self, "executed", []), action.clone()]
        return super().read_action(action)


def test_the_simulator_executes_the_altered_action_and_the_data_keep_the_one_asked_for():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, DynamicsGap(ActionGain(3.0), ActionDelay(0.5 * 0.05)))
    asked = rollout(env, 5)["action"]
    assert env.action_spec.is_in(asked[0])
    previous = torch.cat([torch.zeros_like(asked[:1]), asked[:-1]])
    torch.testing.assert_close(torch.stack(base.executed[-5:]), 1.5 * asked + 1.5 * previous)


def test_noise_may_leave_the_bounds_and_mujoco_clamps():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, dynamics_gap("joint_noise"))
    data = rollout(env, 50)
    executed = torch.stack(base.executed[-50:])
    assert (executed.abs() > 1).any()
    assert data["action"].abs().max() <= 1
    noise = executed - data["action"]
    assert noise.std() == pytest.approx(1.0, abs=0.1)
    assert noise.mean() == pytest.approx(0.0, abs=0.1)


def test_randomness_repeats_with_torchs_generator():
    env = gapped(ActionNoise(1.0), ObservationNoise(0.1))
    first = rollout(env)
    assert (rollout(env) == first).all()
    env.set_seed(0)
    state = torch.get_rng_state()
    env.set_seed(0)
    second = env.rollout(5)
    env.set_seed(0)
    torch.set_rng_state(state)
    assert (env.rollout(5) == second).all()
    assert not (second == first[:5]).all()


def test_a_gap_without_randomness_draws_no_random_numbers():
    torch.manual_seed(0)
    env = gapped(Gravity(2.0), JointForce(1.0), ActionDelay(0.02), ObservationBias(1.0))
    state = torch.get_rng_state()
    env.reset()
    assert torch.equal(torch.get_rng_state(), state)


def test_a_delay_line_is_empty_again_after_a_reset():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, DynamicsGap(ActionDelay(0.05)))
    for _ in range(2):
        reset = env.reset()
        for expected in (0.0, 1.0):
            env.step(reset.set("action", torch.ones(6)))
            torch.testing.assert_close(base.executed[-1], torch.full((6,), expected))


def test_a_clone_has_a_delay_line_of_its_own():
    env = gapped(gap := ActionDelay(0.05))
    env.step(env.reset().set("action", torch.ones(6)))
    base = Executed(CHEETAH)
    twin = TransformedEnv(base, env.transform.clone())
    twin.step(base.reset().set("action", torch.ones(6)))  # no reset that would empty the line
    torch.testing.assert_close(base.executed[-1], torch.zeros(6))
    assert twin.transform.effects == (gap,)


def test_the_delay_knows_frames_that_torchrl_skips():
    base = Executed(CHEETAH, frame_skip=2)
    env = TransformedEnv(base, DynamicsGap(ActionDelay(0.05)))  # half a step of 0.1 s
    env.step(env.reset().set("action", torch.ones(6)))
    torch.testing.assert_close(base.executed[-1], torch.full((6,), 0.5))


def test_the_first_and_the_next_observations_are_altered():
    true, biased = rollout(GymEnv(CHEETAH)), rollout(gapped(ObservationBias(0.5, entries=(3,))))
    offset = torch.zeros(17, dtype=torch.float64)
    offset[3] = 0.5
    for key in ("observation", ("next", "observation")):
        torch.testing.assert_close(biased[key], true[key] + offset)


# ------------------------------------------------------------------------------------ forces
class Cart(MujocoEnv):
    """A task of one's own, from its own file; x and its velocity."""

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
    """x and v after one action of zero, with the force on the slider set every physics step."""
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
    cart._env.unwrapped.data.qvel[:] = 1.0, 20.0  # the pole turns by 0.2 rad an action
    state = env.step(reset.set("action", torch.zeros(1)))["next", "observation"]
    model = mujoco.MjModel.from_xml_string(CART_XML)
    data, current = mujoco.MjData(model), mujoco.MjData(model)
    data.qpos[0], data.qvel[:] = 0.25, (1.0, 20.0)
    for _ in range(5):
        current.qpos[:], current.qvel[:] = data.qpos, data.qvel
        mujoco.mj_forward(model, current)
        data.qfrc_applied[:] = effect.generalised_force(model, current)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(state, [*data.qpos, *data.qvel], rtol=1e-12)


def test_a_task_of_ones_own_keeps_its_start(cart):
    env = TransformedEnv(cart, DynamicsGap(BodyMass(2.0, bodies="pole")))
    assert env.reset()["observation"][0] == 0.25
    assert mujoco_model(env).body("pole").mass == pytest.approx(1.0)


def test_the_file_of_the_model_is_not_written(cart, tmp_path):
    TransformedEnv(cart, DynamicsGap(BodyMass(2.0))).rollout(2)
    assert (tmp_path / "cart.xml").read_text() == CART_XML
    assert [path.name for path in tmp_path.iterdir()] == ["cart.xml"]


# ------------------------------------------------------------------------------------ errors
def test_a_gap_that_the_task_does_not_have_leaves_the_env_as_it_was():
    base, expected = GymEnv("Walker2d-v5"), rollout(GymEnv("Walker2d-v5"))
    for name in ("soft_feet", "long_torso"):
        with pytest.raises(ValueError, match="cannot be put into model 'walker2d'"):
            TransformedEnv(base, dynamics_gap(name))
    with pytest.raises(ValueError, match="no joint named 'knee'"):
        TransformedEnv(base, DynamicsGap(Gravity(2.0), JointForce(1.0, "knee")))
    with pytest.raises(ValueError, match="choose from 0 to 5"):
        TransformedEnv(base, DynamicsGap(Gravity(2.0), ActionNoise(1.0, actuators=(6,))))
    assert (rollout(base) == expected).all()


def test_an_env_without_mujoco_is_refused():
    with pytest.raises(ValueError, match=r"Pendulum-v1.* does not run on MuJoCo; choose"):
        TransformedEnv(GymEnv("Pendulum-v1"), dynamics_gap("gravity"))


def test_what_is_no_effect_is_refused():
    with pytest.raises(TypeError, match=r"takes effects such as Gravity.*got 'gravity'"):
        DynamicsGap("gravity")


def test_a_model_changed_by_hand_is_not_silently_replaced():
    env = GymEnv(CHEETAH)
    mujoco_model(env).opt.gravity[2] = -1.0
    with pytest.raises(ValueError, match=r"changed after loading.*Make the change an effect"):
        TransformedEnv(env, DynamicsGap(BodyMass(2.0)))


def test_a_strength_out_of_bounds_is_refused():
    with pytest.raises(ValueError, match=r"GeomSize: scale = 0 lies outside its bounds"):
        dynamics_gap("big_thigh", 0.0)
