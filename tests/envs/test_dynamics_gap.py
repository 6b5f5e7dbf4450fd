"""DynamicsGap on single environments: its changes, what stays unchanged, and its errors."""

import copy
import pickle

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.effects.models import as_bytes
from tests.envs.rollouts import CHEETAH, gapped, rollout
from torchrl_h2o.effects import (
    PAPER_GAPS,
    ActionDelay,
    ActionGain,
    ActionNoise,
    Armature,
    BodyMass,
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


@settings(max_examples=4, deadline=None)
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
    both.rollout(2)  # StepCounter builds envs from clones of the gaps
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


def test_another_gap_on_an_env_that_had_one_is_refused():
    base = GymEnv(CHEETAH)
    env = TransformedEnv(base, DynamicsGap(Gravity(2.0)))
    complaint = r"not among the transforms of this env .*before \(gravity × 2\).*make a new env"
    with pytest.raises(ValueError, match=complaint):
        TransformedEnv(base, DynamicsGap(Gravity(3.0)))
    with pytest.raises(ValueError, match=complaint):
        env.transform = DynamicsGap(Gravity(3.0))
    assert mujoco_model(base).opt.gravity[2] == -19.62


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
    with pytest.raises(TypeError, match=r"expected effects such as Gravity.*got 'gravity'"):
        DynamicsGap("gravity")


def test_a_model_changed_by_hand_is_not_silently_replaced():
    env = GymEnv(CHEETAH)
    mujoco_model(env).opt.gravity[2] = -1.0
    with pytest.raises(ValueError, match=r"changed after loading.*Make the change an effect"):
        TransformedEnv(env, DynamicsGap(BodyMass(2.0)))


def test_a_strength_out_of_bounds_is_refused():
    with pytest.raises(ValueError, match=r"GeomSize: scale = 0 lies outside its bounds"):
        dynamics_gap("big_thigh", 0.0)
